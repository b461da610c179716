"""The figures as rows: which there are, what each reads, and what it answers in the paper."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from footwork.study.association import ASSOCIATIONS
from footwork.study.experiments import EXPERIMENTS, KINDS, MAIN, SCHEDULES, is_row
from footwork.study.figures import curves, measures, paths, scenes
from footwork.study.figures.style import save, styled
from footwork.study.results import Results

_KINDS = tuple(kind for kind in KINDS if not kind.startswith("symmetric"))


@dataclass(frozen=True)
class Figure:
    """One figure.

    Args:
        name: its file's name, and what the command line calls it.
        title: one line.
        caption: how to read it; names in braces stand for what depends on the study's size.
        draw: from the results and the rows, a matplotlib figure.
        rows: that it reads.
        paper: the figure of the paper that it answers, if any.
        once: there is one of it, and not one per engine and ant: it sets them side by side, or is about the default.
        about: those of its rows of which it shows nothing without one; none: any of them is enough.
    """

    name: str
    title: str
    caption: str
    draw: Callable[[Results, tuple[str, ...]], Any]
    rows: tuple[str, ...] = ()
    paper: str = ""
    once: bool = False
    about: tuple[str, ...] = ()


class Drawn(NamedTuple):
    """A figure as it was written."""

    figure: Figure
    files: tuple[Path, ...]
    without: tuple[str, ...]  # rows that it reads and that have no finished runs
    prefix: str = ""  # of its rows: another engine or ant


def _against_flat(place: str) -> tuple[str, ...]:
    kinds = ("appropriate-bias", "interleaved", "symmetric-interleaved")
    masters = [f"{place}/{schedule}/{kind}" for schedule in SCHEDULES for kind in kinds]
    flats = [f"{place}/flat/{name}" for name in ("free", "penalised", "guided-free", "guided-penalised")]
    return (*masters, *flats)


def _on_kinds(place: str, kinds: tuple[str, ...] = KINDS, schedules: Iterable[str] = SCHEDULES) -> tuple[str, ...]:
    return tuple(f"{place}/{schedule}/{kind}" for schedule in schedules for kind in kinds)


def _walkers(kinds: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"walker/{kind}" for kind in kinds)


_BANDS = "Interquartile mean over seeds, pointwise 95 % bootstrap bands (of three seeds or fewer: their range)."
_INTERVALS = "IQM over seeds with 95 % intervals (of three seeds or fewer: their range)"
_REWARD = (
    "Only the distance part of the reward, as the paper plots, in shares of the whole way and averaged over the last "
    "twentieth of the training each time. Left along the straight line; right, on AntMaze, along the shortest way "
    "around the walls, so that there the panels differ in measure and in scale. An episode that ends in the goal "
    f"circle does not quite reach 1. Sub-policies' own training ({{own_steps}} control steps) is not on the axis. "
    f"{_BANDS}"
)

FIGURES: tuple[Figure, ...] = (
    Figure(
        "01-walker",
        "AntWalker",
        "The arena without walls in which sub-policies learn. The target is 10 km away in one of four directions.",
        scenes.walker_scene,
        paper="Figure 1",
    ),
    Figure(
        "02-bandit",
        "AntBandit",
        "At each reset one of the four corners becomes the goal, and the ant is told which.",
        scenes.bandit_scene,
        paper="Figure 2",
    ),
    Figure(
        "03-maze",
        "AntMaze",
        "The straight line to the goal leads into a wall.",
        scenes.maze_scene,
        paper="Figure 3",
    ),
    Figure(
        "04-hierarchy",
        "The two-level hierarchy",
        "Every k control steps the master chooses one of four frozen sub-policies.",
        scenes.hierarchy,
        paper="Figure 4",
    ),
    Figure(
        "05-maze-reward",
        "AntMaze: hierarchies and flat policies",
        _REWARD,
        curves.task_curves,
        _against_flat("maze"),
        "Figure 5",
    ),
    Figure(
        "06-bandit-reward",
        "AntBandit: hierarchies and flat policies",
        _REWARD,
        curves.task_curves,
        _against_flat("bandit"),
        "Figure 6",
    ),
    Figure(
        "07-unregularised",
        "Training of unregularised sub-policies",
        f"Training reward of each direction. {_BANDS}",
        curves.direction_curves,
        ("walker/plain",),
        "Figure 7",
    ),
    Figure(
        "08-regularised",
        "Training of regularised sub-policies",
        f"Training reward of each direction, the steps of noise or of a partner included. {_BANDS}",
        curves.direction_curves,
        _walkers(("random-start", "random-repeated", "appropriate-bias", "interleaved")),
        "Figure 8",
    ),
    Figure(
        "09-bandit-sub-policies",
        "AntBandit: masters on regularised and unregularised sub-policies",
        _REWARD,
        curves.task_curves,
        _on_kinds("bandit"),
        "Figure 9",
    ),
    Figure(
        "10-maze-sub-policies",
        "AntMaze: masters on regularised and unregularised sub-policies",
        _REWARD,
        curves.task_curves,
        _on_kinds("maze"),
        "Figure 10",
    ),
    Figure(
        "11-handovers",
        "Hand-overs: from each direction to each",
        "Upper number: per cent of hand-overs without fall or flip, at 0.5 m/s or more; lower: mean speed after (m/s). "
        "Interquartile means over seeds, {pairs} ants per pair and seed.",
        measures.handover_maps,
        _walkers(KINDS),
    ),
    Figure(
        "12-switching",
        "Random switching for 2000 control steps",
        f"A new direction drawn from all four every so often; an option under 0.2 m/s is idle. {_INTERVALS}.",
        measures.switching,
        _walkers(KINDS),
    ),
    Figure(
        "13-option-length",
        "The length k of an option",
        f"{_INTERVALS}, masters on interleaved sub-policies. Control steps and decisions per "
        "update are the same everywhere, so that a longer option leaves a master fewer updates (on AntMaze "
        "{updates_10} at k = 10, {updates_400} at k = 400). maze/k-paper: with the paper's reward and schedule, else "
        "with ours.",
        measures.k_grids,
        measures.rows_of_grids("k"),
        once=True,
    ),
    Figure(
        "14-regulariser-length",
        "The length t of each regulariser",
        f"{_INTERVALS}. Hand-overs between orthogonal directions, one at a time; options that get "
        "on, and ants on their backs in the end, when the direction is drawn anew every 50 control steps; speed "
        "without hand-overs.",
        measures.t_grids,
        measures.rows_of_grids("t"),
        once=True,
    ),
    Figure(
        "15-success",
        "Success in training, against steps and against wall time",
        "Share of the episodes that end in the goal, over the last twentieth of the training each time; sub-policies' "
        "own training ({own_steps} control steps) not counted. Masters with our reward and schedule, flat ones with "
        "the paper's reward (free) and with ours (guided). Seeds that trained side by side have an equal share of "
        f"their time each. {_BANDS}",
        curves.success_curves,
        (
            *_on_kinds("bandit", schedules=("hrl",)),
            "bandit/flat/free",
            "bandit/flat/guided-free",
            *_on_kinds("maze", schedules=("hrl",)),
            "maze/flat/free",
            "maze/flat/guided-free",
        ),
    ),
    Figure(
        "16-paths",
        "Paths through the maze",
        "Twelve episodes of the first seed; a master's coloured by the sub-policy in use, a flat policy's grey. "
        "Straight pieces join the places of a master's decisions, k control steps apart, and may cut corners.",
        paths.maze_paths,
        (
            *(f"maze/hrl/{kind}" for kind in ("plain", "appropriate-bias", "interleaved", "symmetric-interleaved")),
            "maze/paper/appropriate-bias",
            "maze/flat/free",
        ),
    ),
    Figure(
        "17-flat-ends",
        "Where the episodes of flat policies end",
        "A point per episode, all seeds, and the share of all episodes that end in the circle: within 1 m of where the "
        "straight line to the goal meets the wall.",
        paths.flat_ends,
        tuple(f"maze/flat/{kind}" for kind in ("free", "penalised", "guided-free", "guided-penalised")),
    ),
    Figure(
        "18-profiles",
        "Performance profiles",
        "Share of runs (seeds) that get farther than each share of the straight-line way, all trained with our "
        "reward; pointwise 95 % bootstrap bands (of three seeds or fewer: their range).",
        measures.profiles,
        (
            *_on_kinds("bandit", _KINDS, ("hrl",)),
            "bandit/flat/guided-free",
            *_on_kinds("maze", _KINDS, ("hrl",)),
            "maze/flat/guided-free",
        ),
    ),
    Figure(
        "19-choices",
        "What the paper leaves open: B, k, t, the potential, bonus and annealing, the ant; and parts of interleaving",
        f"{_INTERVALS}; in brackets the number of seeds. There are walls to go around on AntMaze "
        "only. k-paper-200, B-as-size-paper: the paper's reward and schedule with options of 200 control steps, with "
        "minibatches of 32. The entropy bonus is 0.02 where a name does not say otherwise (annealed and interleaved "
        "ones begin with it), but for the light ant's sub-policies, which have none. Flat policies: their "
        "log-deviation capped at 0.5 instead of 2.0; bonus and step falling over all their updates (4882). Interleaved "
        "ones without cooperation: returns leave out the chance of a hand-over and what the ant would then be worth to "
        "the others. random-repeated/t/25, appropriate-bias/t/400: masters on sub-policies with noise every 25 steps "
        "instead of 100, with 400 steps of a partner instead of 100.",
        measures.comparisons,
        measures.COMPARED,
        once=True,
    ),
    Figure(
        "20-penalties",
        "Stability penalties in the master's reward",
        "The distance part of the reward, in the row's own potential, of masters trained with and without the "
        f"penalties, averaged over the last twentieth of the training each time. {_BANDS}",
        curves.penalty_curves,
        tuple(
            f"{place}/{schedule}{penalised}/{kind}"
            for place in ("bandit", "maze")
            for schedule in SCHEDULES
            for kind in ("appropriate-bias", "plain")
            for penalised in ("", "-penalised")
        ),
        once=True,
    ),
    Figure(
        "21-masters-by-handovers",
        "Masters on sub-policies that hand over well and badly",
        "A point per seed: its sub-policies' hand-overs, and the master on them. ρ: Spearman's rank correlation within "
        "kinds (what sets kinds apart adds nothing), over the kinds with three seeds and more in which both vary, "
        "95 % bootstrap interval, kinds drawn on their own (though appropriate bias had plain ones as partners). "
        "Looked at after the runs, not one of the claims.",
        measures.masters_by_handovers,
        tuple(dict.fromkeys(row for association in ASSOCIATIONS for row in association.rows)),
        about=tuple(row for association in ASSOCIATIONS for row in association.masters),
    ),
    Figure(
        "22-safety-against-speed",
        "Safety against speed",
        "Sub-policies of every kind, and of other lengths of a regulariser (the numbers at the ends of a line: t, "
        "or the mean stay of interleaved ones, in control steps). Right: fast straight on; low: safe when the "
        "direction is drawn anew every 50 control steps. Filled: Table 1's constant learning rate; white: annealed. "
        "Interquartile means over seeds, bars 95 % intervals (of three seeds or fewer: their range); a point without "
        "bars is one seed. Without...: interleaved ones that lack a part.",
        measures.safety_against_speed,
        measures.LENGTHS_AND_KINDS,
    ),
    Figure(
        "23-penalties-by-kind",
        "What stability penalties change, by kind of sub-policies",
        "Masters trained with stability penalties less those without on the same sub-policies, seed by seed, in "
        "percentage points: differences of interquartile means and 95 % bootstrap intervals (with three seeds too "
        "narrow); in brackets the seeds. Left of zero penalties cost, right of it they help. Claim 13 is decided on "
        "the way of masters on plain and appropriate-bias sub-policies; the other kinds were looked at after that.",
        measures.cost_of_penalties,
        measures.PENALISED_OR_NOT,
        once=True,
    ),
)


def find_figures(names: Iterable[str]) -> list[Figure]:
    """Figures by name, or by the number at its beginning; all for none.

    Raises:
        ValueError: there is none of that name; lists those there are.
    """
    known = {figure.name: figure for figure in FIGURES}
    by_number = {str(int(name.partition("-")[0])): figure for name, figure in known.items()}
    chosen = []
    for name in names:
        figure = known.get(name) or by_number.get(name.lstrip("0"))
        if figure is None:
            raise ValueError(f"unknown figure {name!r}; known figures: {', '.join(known)}")
        chosen.append(figure)
    return chosen or list(FIGURES)


def draw_figures(results: Results, figures: Iterable[Figure], to: Path, prefix: str = "") -> list[Drawn]:
    """Draw figures into a folder, each as PNG and as SVG.

    With a prefix such as ``light/``, the same of the rows under it, into a folder of that name: results of
    different engines and ants stay apart. Figures that would show nothing under it are left out, and
    those of which there is one only.
    """
    note = "" if results.study.size.name == "full" else f"{results.study.size.name} study: short runs, few seeds"
    note = "runs of any length" if results.any_length else note
    note = " - ".join(part for part in (prefix.strip("/"), note) if part)
    drawn = []
    for figure in figures:
        rows = tuple(prefix + row for row in figure.rows if is_row(prefix + row))
        there = {row for row in rows if results.samples(row)}
        # On other engines and ants the ablations are not planned: they lack nothing that nobody ran.
        without = tuple(row for row in rows if row not in there and (row in EXPERIMENTS or row[len(prefix) :] in MAIN))
        shows = {prefix + row for row in figure.about or figure.rows} & there
        if prefix and (figure.once or not shows):
            continue
        with styled():
            files = save(figure.draw(results, rows), to / prefix / figure.name, note)
        drawn.append(Drawn(figure, tuple(files), without, prefix))
    return drawn
