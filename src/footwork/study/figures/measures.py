"""Figures of what was measured on finished runs: hand-overs, switching, grids, profiles."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from footwork.arena import DIRECTIONS
from footwork.statistics import Effect, Floats, contrast, generator_for, iqm, profile_band
from footwork.study.association import ASSOCIATIONS, OF_MASTERS, OF_SUB_POLICIES, seed_pairs, strength
from footwork.study.claims import CLAIMS, Setting
from footwork.study.experiments import (
    ANNEALED,
    ANNEALED_MASTERS,
    FLAT_GRIDS,
    GRIDS,
    INTERLEAVED_WITHOUT,
    INTERLEAVED_WITHOUT_MASTERS,
    KINDS,
    LIGHT_WITH_BONUS,
    MORE_REGULARISED_MASTERS,
    PAPER_MASTERS_VARIED,
    SCHEDULES,
    Grid,
    find_row,
    grids_of,
)
from footwork.study.figures.style import (
    Look,
    empty,
    interval_marks,
    label_of,
    legend_below,
    look_of,
    panels,
    seeds_of,
)
from footwork.study.judging import Finding, judge
from footwork.study.measure import TRANSITIONS
from footwork.study.metrics import METRICS
from footwork.study.results import Results, seeds_in_words

_ARROWS = dict(zip(DIRECTIONS, ("→", "↑", "←", "↓"), strict=True))


def handover_maps(results: Results, rows: tuple[str, ...]) -> Any:
    """Share of hand-overs that succeed, from each direction to each, and the mean speed after."""
    figure, axes = panels(-(-len(rows) // 4), 4, 2.2, layout="compressed")
    image = None
    measured = {row: results.measurements(row, TRANSITIONS) for row in rows}
    for ax, (row, entries) in zip(axes.flat, measured.items(), strict=False):
        ax.grid(False)
        ax.set_title(f"{row.partition('walker/')[2]}\n{seeds_in_words(len(entries))}", fontsize=8)
        if not entries:
            ax.axis("off")
            empty(ax, "no finished runs yet")
            continue
        success, speed = _cells(entries, "success"), _cells(entries, "speed_mps")
        image = ax.imshow(success, vmin=0, vmax=1, cmap="cividis")  # one scale: engines and ants are compared
        for i in range(4):
            for j in range(4):
                colour = "white" if success[i, j] < 0.5 else "black"
                text = f"{100 * success[i, j]:.0f}\n{speed[i, j]:z.1f}"
                ax.text(j, i, text, ha="center", va="center", color=colour, fontsize=7, linespacing=1.0)
        ax.set_xticks(range(4), list(_ARROWS.values()))
        ax.set_yticks(range(4), list(_ARROWS.values()))
        ax.set_xlabel("to")
        ax.set_ylabel("from")
    for ax in axes.flat[len(rows) :]:
        ax.axis("off")
    if image is not None:
        figure.colorbar(image, ax=axes, label="hand-overs that succeed", shrink=0.6)
    return figure


def _cells(entries: list[dict[str, Any]], name: str) -> Floats:
    """A number of the hand-over matrix [4, 4], interquartile mean over seeds."""
    return iqm([[[cell[name] for cell in line] for line in entry["handover"]] for entry in entries], axis=0)


def switching(results: Results, rows: tuple[str, ...]) -> Any:
    """Speed per option and share of idle options and of ants on their backs, against the time between switches."""
    names = {
        "speed_mps": "speed per option (m/s)",
        "idle": "share of idle options",
        "upside_down": "share upside down at the end",
    }
    figure, axes = panels(1, 3, 3.2)
    there = {row: entries for row in rows if (entries := results.measurements(row, TRANSITIONS))}
    apart = np.geomspace(0.9, 1.1, len(there)) if len(there) > 1 else [1.0]  # bars beside each other
    differ = len({len(entries) for entries in there.values()}) > 1
    for ax, (name, words) in zip(axes[0], names.items(), strict=True):
        lowest = 0.0
        for (row, entries), shift in zip(there.items(), apart, strict=False):
            periods = sorted({int(k) for entry in entries for k in entry["switching"]})
            values = [[e["switching"][str(k)][name] for e in entries if str(k) in e["switching"]] for k in periods]
            generators = [generator_for(f"switching {row} {name} {k}") for k in periods]
            effects = [contrast([v], (1,), generator) for v, generator in zip(values, generators, strict=True)]
            label = label_of(row) + (f" ({seeds_in_words(len(entries))})" if differ else "")
            interval_marks(ax, np.multiply(periods, shift), effects, look_of(row), label)
            lowest = min(lowest, *(effect.low for effect in effects))  # an ant may be driven back
        ax.set_title(words)
        ax.set_xlabel(f"control steps between switches\n{seeds_of(results, there)}")
        ax.set_xscale("log")
        ax.set_xticks([25, 50, 100, 200], ["25", "50", "100", "200"])
        ax.minorticks_off()
        top = ax.get_ylim()[1] if name == "speed_mps" else max(ax.get_ylim()[1], 0.1)  # one ant is no tower
        ax.set_ylim(lowest - 0.02 * top, top)
        if not ax.get_legend_handles_labels()[0]:
            empty(ax, "no finished runs yet")
    legend_below(figure, list(axes[0]))
    return figure


def _points(results: Results, grid: Grid, metric: str) -> tuple[list[Any], list[Effect]]:
    """Values of a grid's field that have runs, and the metric there."""
    found = [(value, results.middle(row, metric)) for value, row in grid.points().items()]
    there = [(value, effect) for value, effect in found if effect is not None]
    return [value for value, _ in there], [effect for _, effect in there]


def grid_panels(results: Results, grids: tuple[Grid, ...], metrics: tuple[str, ...], height: float) -> Any:
    """A column per grid that has runs of several values, a line of panels per metric."""
    grids = tuple(grid for grid in grids if len(_points(results, grid, metrics[0])[0]) > 1)
    if not grids:
        figure, axes = panels(1, 1, height)
        axes[0, 0].axis("off")
        empty(axes[0, 0], "no finished runs yet of other values than the rows' own")
        return figure
    figure, axes = panels(len(metrics), len(grids), height)
    for line, metric in zip(axes, metrics, strict=True):
        limits = _limits(METRICS[metric].is_share, [e for grid in grids for e in _points(results, grid, metric)[1]])
        for ax, grid in zip(line, grids, strict=True):
            values, effects = _points(results, grid, metric)
            x = values if all(isinstance(v, int | float) for v in values) else list(range(len(values)))
            interval_marks(ax, x, effects, Look("#0072B2", "o"), grid.name)
            if x is values:
                ax.set_xscale("log")
            counts = [len(results.samples(grid.points()[value])) for value in values]
            ax.set_xticks(x, [f"{v}\n{n}" for v, n in zip(values, counts, strict=True)])
            ax.minorticks_off()
            ax.set_ylim(limits)
            ax.tick_params(labelleft=ax is line[0])
            if metric == metrics[0]:
                ax.set_title(grid.name.removeprefix("ablation/"))
            if metric == metrics[-1]:
                ax.set_xlabel(f"{grid.words};\nbelow: seeds")
        line[0].set_ylabel(_wrapped(_axis_words(metric), round(11 * height)))  # no longer than a panel is high
    return figure


def _limits(is_share: bool, effects: Sequence[Effect]) -> tuple[float, float]:
    """Of an axis with these points: from 0, all of it if they are shares, and below where a way was lost."""
    low = min((e.low for e in effects), default=0.0)
    high = 1.0 if is_share else max((e.high for e in effects), default=1.0)
    margin = 0.05 * (high - min(low, 0.0))
    return (min(low, 0.0) - margin if is_share or low < 0 else 0.0), high + margin


def _axis_words(metric: str) -> str:
    """What a metric is, with its unit unless it is a share."""
    one = METRICS[metric]
    return one.words if one.is_share else f"{one.words} ({one.unit})"


def _wrapped(words: str, width: int = 26) -> str:
    lines = [""]
    for word in re.split(r"(?<!\d) ", words):  # a number stays with its unit
        lines = [*lines[:-1], f"{lines[-1]} {word}".strip()] if len(lines[-1]) + len(word) < width else [*lines, word]
    return "\n".join(lines)


def rows_of_grids(what: str) -> tuple[str, ...]:
    """The points of the grids of one field, ``k`` or ``t``."""
    return tuple(dict.fromkeys(row for grid in grids_of(what) for row in grid.points().values()))


def k_grids(results: Results, rows: tuple[str, ...]) -> Any:
    """What the length k of an option does to a master."""
    return grid_panels(results, grids_of("k"), ("success", "way"), 2.4)


def t_grids(results: Results, rows: tuple[str, ...]) -> Any:
    """What the length t of each regulariser does to sub-policies."""
    return grid_panels(results, grids_of("t"), ("handover", "moving", "upside down", "speed"), 1.9)


class _Line(NamedTuple):
    """Rows of sub-policies that belong together: the lengths of a regulariser, or one row (of length None)."""

    name: str
    look: Look
    points: dict[Any, str]


def _lines_of_kinds() -> tuple[_Line, ...]:
    lengths = {grid.base: grid.points() for grid in grids_of("t")}
    own = {kind: f"walker/{kind}" for kind in KINDS}
    annealed = {row.name.rpartition("/")[2]: row.name for row in ANNEALED}
    interleaved = look_of("interleaved")
    return (
        *(_Line(kind, look_of(kind), lengths.get(row, {None: row})) for kind, row in own.items()),
        *(_Line(kind, look_of(kind), {None: row}) for kind, row in annealed.items()),
        *(
            _Line(
                f"without {row.name.rpartition('/')[2].replace('-', ' ')}",
                interleaved._replace(mark=mark),
                {None: row.name},
            )
            for row, mark in zip(INTERLEAVED_WITHOUT, "dP*s", strict=True)
        ),
    )


# What :func:`safety_against_speed` reads.
LENGTHS_AND_KINDS: tuple[str, ...] = tuple(
    dict.fromkeys(row for line in _lines_of_kinds() for row in line.points.values())
)


def safety_against_speed(results: Results, rows: tuple[str, ...]) -> Any:
    """Idle options and ants on their backs under random switching, against the speed straight on."""
    prefix = _prefix_of(rows)
    figure, axes = panels(1, 2, 4.4)
    for ax, metric in zip(axes[0], ("idle", "upside down"), strict=True):
        for name, look, points in _lines_of_kinds():
            there = [(length, prefix + row) for length, row in points.items() if prefix + row in rows]
            found = [(length, row, results.middle(row, "speed"), results.middle(row, metric)) for length, row in there]
            whole = [(length, row, x, y) for length, row, x, y in found if x is not None and y is not None]
            if not whole:
                continue
            face = look.colour if find_row(whole[0][1]).ppo.anneal_updates is None else "white"
            for _, _, x, y in whole:
                ax.plot([x.low, x.high], [y.estimate] * 2, color=look.colour, lw=1.3, alpha=0.5)
                ax.plot([x.estimate] * 2, [y.low, y.high], color=look.colour, lw=1.3, alpha=0.5)
            for length, _, x, y in dict.fromkeys((whole[0], whole[-1])):  # the others lie between, in order
                if length is None:
                    continue
                at, style = (x.estimate, y.estimate), {"fontsize": 6.5, "color": look.colour}
                ax.annotate(f"{length}", at, (4, 3), textcoords="offset points", **style)
            ax.plot(
                [x.estimate for *_, x, _ in whole],
                [y.estimate for *_, y in whole],
                **{"color": look.colour, "marker": look.mark, "mfc": face, "ms": 5, "lw": 0.8},
                label=name,
            )
        if not ax.lines:
            empty(ax, "no finished runs yet")
            continue
        ax.set_xlabel(_axis_words("speed"))
        ax.set_ylabel(_wrapped(METRICS[metric].words, 44))
        ax.set_ylim(-0.02, max(ax.get_ylim()[1], 0.1))  # one ant is no tower
        ax.set_xlim(0, None)
    axes[0, 0].plot([], [], ls="", marker="o", color="#444444", mfc="white", ms=5, label="(white: annealed)")
    legend_below(figure, list(axes[0]), columns=4)
    return figure


def _prefix_of(rows: tuple[str, ...]) -> str:
    """The engine or ant of rows among which are sub-policies, as their addresses begin: ``light/``."""
    return next(row for row in rows if "walker/" in row).partition("walker/")[0]


def comparisons(results: Results, rows: tuple[str, ...]) -> Any:
    """B, k, the potential, flat policies' learning, annealing, interleaving, the ant: rows side by side."""
    tasks = [row for grid in _COMPARED_GRIDS if "walker" not in grid.base for row in grid.points().values()]
    walkers = [row for grid in _COMPARED_GRIDS if "walker" in grid.base for row in grid.points().values()]
    lines = (
        (
            "B, k, the potential, how flat policies learn: masters, flat policies",
            [*tasks, *_VARIED],
            ("way", "route", "success"),
        ),
        (
            "B, the entropy bonus, annealing, parts of interleaving, the ant: sub-policies",
            [*walkers, *_ANNEALED, *_WITHOUT, _WITH_BONUS, *(row for row in _OF_ANTS if find_row(row).is_walker)],
            ("handover", "moving", "speed"),
        ),
        (
            "annealing, more regularisation, parts of interleaving, the ant: masters",
            [
                *_ANNEALED_MASTERS,
                *_MORE_REGULARISED_MASTERS,
                *_WITHOUT_MASTERS,
                *(row for row in _OF_ANTS if not find_row(row).is_walker),
            ],
            ("way", "route", "success"),
        ),
    )
    heights = [len(set(names)) + 2 for _, names, _ in lines]
    figure, axes = panels(3, 3, round(0.16 * sum(heights) / 3, 1))  # inches, so that no name touches the next
    axes[0, 0].get_gridspec().set_height_ratios(heights)
    for line, (title, names, metrics) in zip(axes, lines, strict=True):
        for ax, metric in zip(line, metrics, strict=True):
            _dots(ax, results, metric, list(dict.fromkeys(names)), named=ax is line[0])
        line[0].set_title(" ")  # keeps the height for one that is wider than its panel
        line[0].annotate(
            title, (0, 1), (0, 6), xycoords="axes fraction", textcoords="offset points", fontsize=8
        ).set_in_layout(False)
    return figure


_COMPARED_GRIDS = tuple(
    grid
    for grid in GRIDS
    if grid.field in ("ppo.minibatch_size", "task.potential", "ppo.ent_coef") or grid.name in FLAT_GRIDS
)
_OF_ANTS = tuple(
    f"{ant}{row}"
    for place, annealed in (("walker", "ablation/annealed"), ("maze/hrl", "ablation/maze/hrl-annealed"))
    for row in (f"{place}/plain", f"{annealed}/plain", f"{place}/interleaved")
    for ant in ("", "light/")
)
_WITH_BONUS = LIGHT_WITH_BONUS.name
_ANNEALED = tuple(row for one in ANNEALED for row in (one.name.replace("ablation/annealed", "walker"), one.name))
_ANNEALED_MASTERS = tuple(
    row
    for one in ANNEALED_MASTERS
    if "/maze/" in one.name
    for row in (one.name.removeprefix("ablation/").replace("-annealed", ""), one.name)
)
_VARIED = tuple(
    row
    for one in PAPER_MASTERS_VARIED
    for _, place, _, kind in (one.name.split("/"),)
    for row in (f"{place}/paper/{kind}", one.name)
)
_WITHOUT = ("walker/interleaved", *(row.name for row in INTERLEAVED_WITHOUT))
_WITHOUT_MASTERS = (
    "maze/hrl/interleaved",
    *(row.name for row in INTERLEAVED_WITHOUT_MASTERS if "/maze/" in row.name),
)
_MORE_REGULARISED_MASTERS = tuple(row.name for row in MORE_REGULARISED_MASTERS if "/maze/" in row.name)
# What :func:`comparisons` reads.
COMPARED: tuple[str, ...] = tuple(
    dict.fromkeys(
        (
            *(row for grid in _COMPARED_GRIDS for row in grid.points().values()),
            *_VARIED,
            *_ANNEALED,
            *_ANNEALED_MASTERS,
            *_WITHOUT,
            *_WITHOUT_MASTERS,
            *_MORE_REGULARISED_MASTERS,
            _WITH_BONUS,
            *_OF_ANTS,
        )
    )
)


def _dots(ax: Any, results: Results, metric: str, rows: list[str], named: bool) -> None:
    """A metric of several rows, one line each; names, and numbers of seeds, stand left of the first panel."""
    names = []
    for y, row in enumerate(rows):
        names.append(f"{row.replace('ablation/', '')} ({len(results.scores(row, metric))})")
        e = results.middle(row, metric)
        if e is not None:
            ax.plot([e.low, e.high], [y, y], color="#0072B2", lw=2, solid_capstyle="butt")
            ax.plot(e.estimate, y, "o", color="#0072B2", ms=4)
        elif metric != "route" or "bandit/" not in row:  # a way around walls needs walls
            ax.text(
                0.03, y, "no runs yet", va="center", fontsize=6, color="#888888", transform=ax.get_yaxis_transform()
            )
    ax.set_yticks(range(len(rows)), names if named else [""] * len(rows), fontsize=6.5)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    low, high = ax.get_xlim()
    ax.set_xlim(
        min(low, -0.03) if METRICS[metric].is_share else min(low, 0.0), 1.03 if METRICS[metric].is_share else high
    )
    ax.set_xlabel(_wrapped(_axis_words(metric), 28), fontsize=7)


def masters_by_handovers(results: Results, rows: tuple[str, ...]) -> Any:
    """A point per seed: how well its sub-policies hand over, and how often the master on them arrives."""
    prefix = _prefix_of(rows)
    there = [one for one in ASSOCIATIONS if any(row.startswith(f"{prefix}{one.place}/") for row in rows)]
    there = [one for one in there if seed_pairs(results, one, prefix)] or there
    figure, axes = panels(1, len(there), 3.0, share_y=True)
    for ax, association in zip(axes[0], there, strict=True):
        found = seed_pairs(results, association, prefix)
        for kind, pairs in found.items():
            look = look_of(kind)
            ax.plot(*pairs.T, ls="", marker=look.mark, color=look.colour, ms=4.5, alpha=0.75, mew=0, label=kind)
        effect = strength(results, association, prefix)
        rho = f"ρ = {effect.estimate:.2f} [{effect.low:.2f}, {effect.high:.2f}]" if effect else "ρ: -"
        ax.set_title(f"{association.words}\n{rho}" if found else association.words)
        ax.set_xlabel(_wrapped(METRICS[OF_SUB_POLICIES].words))
        if not found:
            empty(ax, "no finished runs yet")
    axes[0, 0].set_ylabel(_wrapped(METRICS[OF_MASTERS].words))
    legend_below(figure, list(axes[0]), columns=4)
    return figure


# What :func:`cost_of_penalties` reads.
PENALISED_OR_NOT: tuple[str, ...] = tuple(
    f"{place}/{schedule}{penalised}/{kind}"
    for place in ("bandit", "maze")
    for schedule in SCHEDULES
    for kind in KINDS
    for penalised in ("", "-penalised")
)
_PENALTIES = next(claim for claim in CLAIMS if claim.number == 13)


def cost_of_penalties(results: Results, rows: tuple[str, ...]) -> Any:
    """What penalties in a master's reward change, seed by seed on the same sub-policies, on each kind of them."""
    metrics = ("way", "success")
    figure, axes = panels(2, len(SCHEDULES) * len(metrics), 2.3)
    found = {schedule: judge(results, _PENALTIES, Setting("", schedule)).findings for schedule in SCHEDULES}
    for line, place in zip(axes, ("bandit", "maze"), strict=True):
        columns = [(schedule, metric) for schedule in SCHEDULES for metric in metrics]
        for ax, (schedule, metric) in zip(line, columns, strict=True):
            there = {
                f.rows[1].rpartition("/")[2]: f
                for f in found[schedule]
                if f.contrast.metric == metric and f.rows[1].startswith(f"{place}/") and f.effect is not None
            }
            _differences(ax, there, line[0] is ax, metric == metrics[0])
            ax.set_xlabel(_wrapped(f"{METRICS[metric].words} (points)", 22), fontsize=7)
            if metric == metrics[0]:
                ax.set_title(f"Ant{place.capitalize()}: {SCHEDULES[schedule]}", fontsize=8, loc="left")
    return figure


def _differences(ax: Any, there: dict[str, Finding], named: bool, counted: bool) -> None:
    """A line per kind of sub-policies: a difference in points with its interval; left of it the kind, and its seeds."""
    for y, kind in enumerate(KINDS):
        if kind in there and (e := there[kind].effect) is not None:
            look = look_of(kind)
            ax.plot([100 * e.low, 100 * e.high], [y, y], color=look.colour, lw=1.3, alpha=0.5)
            ax.plot(100 * e.estimate, y, marker=look.mark, color=look.colour, ms=4.5)
    seeds = [f"({there[kind].seeds[0] if kind in there else 0})" for kind in KINDS]
    names = [f"{kind} {count}" if named else count for kind, count in zip(KINDS, seeds, strict=True)]
    ax.set_yticks(range(len(KINDS)), names if counted else [""] * len(KINDS), fontsize=6.5)
    ax.set_ylim(len(KINDS) - 0.5, -0.5)
    if ax.lines:
        low, high = ax.get_xlim()
        ax.set_xlim(min(low, -10.0), max(high, 10.0))  # a tenth of a point is no cost
    else:
        empty(ax, "no finished runs yet")
    ax.axvline(0.0, color="#444444", lw=0.8, zorder=0)


def profiles(results: Results, rows: tuple[str, ...]) -> Any:
    """Share of runs (seeds) that get farther than each share of the way."""
    figure, axes = panels(1, 2, 3.3, share_y=True)
    thresholds = np.linspace(0.0, 1.0, 201)
    for ax, place in zip(axes[0], ("bandit", "maze"), strict=True):
        mine = [row for row in rows if f"/{place}/" in f"/{row}"]
        for number, row in enumerate(mine):
            scores = results.scores(row, "way")
            if not len(scores):
                continue
            look = look_of(row)
            middle, (low, high) = profile_band(scores, thresholds, generator_for(f"profile {row}"))
            style = {"color": look.colour, "marker": look.mark, "ms": 4.0, "markevery": (3 * number, 25)}
            ax.step(thresholds, middle, lw=1.4, label=label_of(row), where="post", **style)
            ax.fill_between(thresholds, low, high, step="post", color=look.colour, alpha=0.10, lw=0)
        if not ax.get_legend_handles_labels()[0]:
            empty(ax, "no finished runs yet")
        ax.set_title(f"Ant{place.capitalize()}")
        seeds = seeds_of(results, mine)
        ax.set_xlabel("share of the way, τ" + (f"; {seeds}" if seeds else ""))
        ax.set_ylim(-0.02, 1.02)
    axes[0, 0].set_ylabel("share of runs with way > τ")
    legend_below(figure, list(axes[0]))
    return figure
