"""Figures of what was measured on finished runs: hand-overs, switching, grids, profiles."""

from __future__ import annotations

from typing import Any

import numpy as np

from footwork.arena import DIRECTIONS
from footwork.statistics import Effect, contrast, generator_for, performance_profile
from footwork.study.experiments import ANNEALED, GRIDS, Grid
from footwork.study.figures.style import Look, empty, interval_marks, labels_of, legend_below, look_of, panels
from footwork.study.measure import TRANSITIONS
from footwork.study.results import METRICS, Results, seeds_in_words

_ARROWS = dict(zip(DIRECTIONS, ("→", "↑", "←", "↓"), strict=True))


def handover_maps(results: Results, rows: tuple[str, ...]) -> Any:
    """Share of hand-overs that succeed, from each direction to each, and the mean speed after."""
    figure, axes = panels(-(-len(rows) // 4), 4, 2.2, layout="compressed")
    image = None
    for ax, row in zip(axes.flat, rows, strict=False):
        entries = results.measurements(row, TRANSITIONS)
        ax.grid(False)
        ax.set_title(f"{row.removeprefix('walker/')}\n{seeds_in_words(len(entries))}", fontsize=8)
        if not entries:
            ax.axis("off")
            empty(ax, "no finished runs yet")
            continue
        success = np.mean([[[c["success"] for c in line] for line in e["handover"]] for e in entries], axis=0)
        speed = np.mean([[[c["speed_mps"] for c in line] for line in e["handover"]] for e in entries], axis=0)
        image = ax.imshow(success, vmin=0, vmax=1, cmap="cividis")
        for i in range(4):
            for j in range(4):
                colour = "white" if success[i, j] < 0.55 else "black"
                text = f"{100 * success[i, j]:.0f}\n{speed[i, j]:.1f}"
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


def switching(results: Results, rows: tuple[str, ...]) -> Any:
    """Speed per option and share of idle options and of ants on their backs, against the time between switches."""
    names = {
        "speed_mps": "speed per option (m/s)",
        "idle": "share of idle options",
        "upside_down": "share upside down at the end",
    }
    figure, axes = panels(1, 3, 3.2)
    labels = labels_of(results, rows)
    apart = np.geomspace(0.9, 1.1, len(rows))  # bars of rows beside each other, not over each other
    for ax, (name, words) in zip(axes[0], names.items(), strict=True):
        for row, shift in zip(rows, apart, strict=True):
            entries = results.measurements(row, TRANSITIONS)
            if not entries:
                continue
            periods = sorted({int(k) for entry in entries for k in entry["switching"]})
            values = [[e["switching"][str(k)][name] for e in entries if str(k) in e["switching"]] for k in periods]
            effects = [_effect(v, f"switching {row} {name} {k}") for k, v in zip(periods, values, strict=True)]
            interval_marks(ax, np.multiply(periods, shift), effects, look_of(row), labels[row])
        ax.set_title(words)
        ax.set_xlabel("control steps between switches")
        ax.set_xscale("log")
        ax.set_xticks([25, 50, 100, 200], ["25", "50", "100", "200"])
        ax.minorticks_off()
        ax.set_ylim(bottom=0)
        if not ax.get_legend_handles_labels()[0]:
            empty(ax, "no finished runs yet")
    legend_below(figure, list(axes[0]))
    return figure


def _effect(values: Any, name: str) -> Effect:
    return contrast([values], (1,), generator_for(name))


def _points(results: Results, grid: Grid, metric: str) -> tuple[list[Any], list[Effect]]:
    """Values of a grid's field that have runs, and the metric there."""
    found = [(value, results.scores(row, metric)) for value, row in grid.points().items()]
    found = [(value, scores) for value, scores in found if len(scores)]
    return [v for v, _ in found], [_effect(s, f"grid {grid.name} {metric} {v}") for v, s in found]


def grid_panels(results: Results, grids: tuple[Grid, ...], metrics: tuple[str, ...], height: float) -> Any:
    """A column per grid, a line of panels per metric."""
    figure, axes = panels(len(metrics), len(grids), height)
    for line, metric in zip(axes, metrics, strict=True):
        highest = max((e.high for grid in grids for e in _points(results, grid, metric)[1]), default=1.0)
        for ax, grid in zip(line, grids, strict=True):
            values, effects = _points(results, grid, metric)
            x = values if all(isinstance(v, int | float) for v in values) else list(range(len(values)))
            if values:
                interval_marks(ax, x, effects, Look("#0072B2", "-", "o"), grid.name)
            if x is values and values:
                ax.set_xscale("log")
            counts = [len(results.samples(grid.points()[value])) for value in values]
            ax.set_xticks(x, [f"{v}\n{n}" for v, n in zip(values, counts, strict=True)])
            ax.minorticks_off()
            if not values:
                empty(ax, "no finished\nruns yet")
            ax.set_ylim((-0.05, 1.05) if METRICS[metric].percent else (0.0, 1.1 * highest))
            ax.set_title(grid.name.removeprefix("ablation/"))
            ax.set_xlabel(f"{grid.words};\nbelow: seeds")
        line[0].set_ylabel(_wrapped(METRICS[metric].words))
    return figure


def _wrapped(words: str, width: int = 26) -> str:
    lines = [""]
    for word in words.split():
        lines = [*lines[:-1], f"{lines[-1]} {word}".strip()] if len(lines[-1]) + len(word) < width else [*lines, word]
    return "\n".join(lines)


def rows_of_grids(what: str) -> tuple[str, ...]:
    """The points of the grids of one field, ``k`` or ``t``."""
    return tuple(dict.fromkeys(row for grid in _grids(what) for row in grid.points().values()))


def _grids(what: str) -> tuple[Grid, ...]:
    return tuple(grid for grid in GRIDS if grid.name.rpartition("/")[2].partition("-")[0] == what)


def k_grids(results: Results, rows: tuple[str, ...]) -> Any:
    """What the length k of an option does to a master."""
    return grid_panels(results, _grids("k"), ("success", "way"), 2.4)


def t_grids(results: Results, rows: tuple[str, ...]) -> Any:
    """What the length t of each regulariser does to sub-policies."""
    return grid_panels(results, _grids("t"), ("handover", "speed"), 2.3)


def comparisons(results: Results, rows: tuple[str, ...]) -> Any:
    """B as a number or as a size, the potential, the heavy and the light ant: rows side by side."""
    figure, axes = panels(3, 1, 2.0)
    axes[0, 0].get_gridspec().set_height_ratios((7, 12, 4))
    fields = [g for g in GRIDS if g.field in ("ppo.minibatch_size", "task.potential") and "walker" not in g.base]
    masters = [row for grid in fields for row in grid.points().values()]
    walkers = [row for grid in GRIDS if grid.base == "walker/plain" for row in grid.points().values()]
    _dots(axes[0, 0], results, "way", masters)
    _dots(axes[1, 0], results, "handover", [*walkers, *_ANNEALED, *(row for row in _OF_ANTS if "walker/" in row)])
    _dots(axes[2, 0], results, "way", [row for row in _OF_ANTS if "walker/" not in row])
    titles = ("B and the potential: masters", "B, annealing and the ant: hand-overs", "the ant: masters")
    for ax, title in zip(axes[:, 0], titles, strict=True):
        ax.set_title(title)
    return figure


_OF_ANTS = tuple(
    f"{ant}{row}"
    for row in ("walker/plain", "walker/interleaved", "maze/hrl/plain", "maze/hrl/interleaved")
    for ant in ("", "light/")
)
_ANNEALED = tuple(row for one in ANNEALED for row in (one.name.replace("ablation/annealed", "walker"), one.name))
# What :func:`comparisons` reads.
COMPARED: tuple[str, ...] = tuple(
    dict.fromkeys(
        (
            *(
                row
                for grid in GRIDS
                if grid.field in ("ppo.minibatch_size", "task.potential")
                for row in grid.points().values()
            ),
            *_ANNEALED,
            *_OF_ANTS,
        )
    )
)


def _dots(ax: Any, results: Results, metric: str, rows: list[str]) -> None:
    """A metric of several rows, one line each."""
    names = list(dict.fromkeys(rows))
    for y, row in enumerate(names):
        scores = results.scores(row, metric)
        if len(scores):
            ax.text(1.06, y, f"n = {len(scores)}", va="center", fontsize=6.5, color="#555555")
            e = _effect(scores, f"dots {row} {metric}")
            ax.plot([e.low, e.high], [y, y], color="#0072B2", lw=2, solid_capstyle="butt")
            ax.plot(e.estimate, y, "o", color="#0072B2", ms=5)
        else:
            ax.text(0.02, y, "no runs yet", va="center", fontsize=7, color="#888888")
    ax.set_yticks(range(len(names)), [name.removeprefix("ablation/") for name in names], fontsize=7)
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.set_xlim(-0.05, 1.05)
    ax.set_xlabel(_wrapped(METRICS[metric].words, 30))


def profiles(results: Results, rows: tuple[str, ...]) -> Any:
    """Share of runs (seeds) that get farther than each share of the way."""
    figure, axes = panels(1, 2, 3.3, share_y=True)
    labels = labels_of(results, rows)
    thresholds = np.linspace(0.0, 1.0, 201)
    for ax, place in zip(axes[0], ("bandit", "maze"), strict=True):
        for row in rows:
            if f"/{place}/" in f"/{row}" and len(scores := results.scores(row, "way")):
                look = look_of(row)
                profile = performance_profile(scores, thresholds)
                ax.step(thresholds, profile, color=look.colour, ls=look.line, lw=1.5, label=labels[row], where="post")
        if not ax.get_legend_handles_labels()[0]:
            empty(ax, "no finished runs yet")
        ax.set_title(f"Ant{place.capitalize()}")
        ax.set_xlabel("share of the way, τ")
        ax.set_ylim(-0.02, 1.02)
    axes[0, 0].set_ylabel("share of runs with way > τ")
    legend_below(figure, list(axes[0]))
    return figure
