"""The paper in its own order, sentence by sentence (shortened): which claims, figures and numbers answer it.

Where a sentence compares nothing, the answer says how it is built here, or shows the rows it is about.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from footwork.learn.config import PAPER
from footwork.statistics import iqm
from footwork.study.association import ASSOCIATIONS, Association, strength
from footwork.study.claims import PAPER_REGULARISERS
from footwork.study.experiments import (
    FLAT_GRIDS,
    GRIDS_BY_NAME,
    INTERLEAVED_WITHOUT,
    INTERLEAVED_WITHOUT_MASTERS,
    MORE_REGULARISED_MASTERS,
    PAPER_MASTERS_VARIED,
    grids_of,
    in_braces,
    is_row,
)
from footwork.study.judging import Judgement, engine_and_ant, show_effect
from footwork.study.metrics import METRICS
from footwork.study.plan import Study
from footwork.study.results import Results, prefixes_at_hand, seeds_in_words


@dataclass(frozen=True)
class Shown:
    """Rows side by side in one metric, each with its interquartile mean.

    Args:
        metric: a key of METRICS.
        rows: label and address of each.
        where: the grid that the labels are values of, and what they are.
    """

    metric: str
    rows: tuple[tuple[str, str], ...]
    where: str = ""


@dataclass(frozen=True)
class Answer:
    """A sentence of the paper, and where the report answers it.

    Args:
        section: of the paper.
        words: what it says.
        claims: by number.
        figures: of the report, by number.
        shows: rows that it is about.
        built: how it is done here, where that is the answer.
        associations: of sub-policies with the masters on them.
    """

    section: str
    words: str
    claims: tuple[int, ...] = ()
    figures: tuple[int, ...] = ()
    shows: tuple[Shown, ...] = ()
    built: str = ""
    associations: tuple[Association, ...] = ()


def _grid(metric: str, *names: str) -> tuple[Shown, ...]:
    """The points of grids, labelled with their values."""
    grids = [GRIDS_BY_NAME[name] for name in names]
    return tuple(
        Shown(
            metric,
            tuple(("as it is" if v is None else str(v), row) for v, row in grid.points().items()),
            f"{grid.name}, {grid.words}",
        )
        for grid in grids
    )


def _rows(metric: str, *rows: str) -> Shown:
    return Shown(metric, tuple((row, row) for row in rows))


def _varied(place: str) -> list[str]:
    """Masters with the paper's reward on its own kinds, with k = 200 on AntMaze, with B as a size on AntBandit."""
    return [row.name for row in PAPER_MASTERS_VARIED if f"/{place}/" in row.name]


_LENGTHS = tuple(grid.name for grid in grids_of("t"))

ANSWERS: tuple[Answer, ...] = (
    Answer(
        "abstract, 1",
        "Without resetting joints, the hierarchy navigates to a given goal; the flat policies fail",
        (1, 2),
        (15, 16),
        shows=tuple(
            _rows(
                "success",
                *(f"{place}/{row}" for row in ("paper/appropriate-bias", "hrl/appropriate-bias", "hrl/interleaved")),
                *(f"{place}/flat/{row}" for row in ("penalised", "free", "guided-penalised", "guided-free")),
            )
            for place in ("bandit", "maze")
        ),
        built="no joint is reset but at the start of an episode",
    ),
    Answer(
        "abstract, 9",
        "The regularisers produce significantly better performing hierarchies",
        (7, 8),
        (9, 10, 15),
    ),
    Answer(
        "1",
        "Four sub-policies are trained separately",
        built="as described: four learners with nothing in common but the machine. Ours are not: interleaved ones "
        "train together, a symmetric one is a single policy in four frames",
    ),
    Answer("2", "PPO-Penalty and PPO-Clip", built="both are there; every row of the study clips, as section 7 says"),
    Answer(
        "3.1",
        "AntWalker: four directions, targets 10 km away; 32 observations, 8 torques (Figure 1)",
        figures=(1,),
        built="as described; the reward is progress, staying alive, and four penalties: power, stalling torque, joints "
        "at their limits, colliding feet, weighted as PyBullet's own ants are",
    ),
    Answer(
        "3.2",
        "AntBandit: one of the four corners of a square, drawn at each reset; 36 observations; with and without the "
        "stability penalties (Figure 2)",
        figures=(2, 20),
        built="as described; with penalties: rows ...-penalised",
    ),
    Answer(
        "3.3",
        "AntMaze: a fixed point in a maze; 34 observations (Figure 3)",
        figures=(3,),
        built="as described; the maze itself is not stated: ours is the U of the field's benchmarks, cells of 4 m",
    ),
    Answer(
        "3.4",
        "The vanilla ant in PyBullet is heavier than MuJoCo's, which makes it harder",
        figures=(19,),
        shows=(
            _rows("speed", "walker/plain", "light/walker/plain", "bullet/walker/plain"),
            _rows("handover", "walker/plain", "light/walker/plain", "bullet/walker/plain"),
        ),
        built="walker/... is the heavy ant on MuJoCo; light/... MuJoCo's own; bullet/... the heavy one on PyBullet",
    ),
    Answer("3.4", "A bug draws the walls at half their size", figures=(3,), built="not copied: drawn as they are"),
    Answer(
        "4", "Every k steps the master decides which policy runs next (Figure 4)", figures=(4,), built="as described"
    ),
    Answer(
        "4",
        "k is a hyperparameter (not stated)",
        figures=(13,),
        shows=(
            *_grid("success", "ablation/bandit/k", "ablation/maze/k", "ablation/maze/k-paper"),
            _rows("success", *_varied("maze")),
        ),
        built="k = 50, and a grid around it",
    ),
    Answer(
        "4",
        "Sub-policies see the observation without what the task adds; the master sees all of it",
        figures=(4,),
        built="as described: the first 32 numbers",
    ),
    Answer(
        "4",
        "The master's reward is the sum of the rewards over the k steps",
        built="as described, undiscounted within an option; Table 1's discount applies once per decision",
    ),
    Answer(
        "4, 5",
        "Mean and variance of the actions are learned functions of the state; two tanh layers of 64",
        built="as described, for actors and critics",
    ),
    Answer(
        "5",
        "Flat policies see the whole observation, with and without the stability penalties",
        figures=(5, 6),
        built="as described: rows flat/free and flat/penalised",
    ),
    Answer("6", "The agent consistently fails to transition to an orthogonal policy", (12,), (11,)),
    Answer(
        "6",
        "Random start, random repeated, appropriate bias: t timesteps (not stated)",
        figures=(14, 19, 22),
        shows=(
            *_grid("upside down", *_LENGTHS),
            *_grid("speed", *_LENGTHS),
            *(
                _rows(
                    "success",
                    *(f"{place}/hrl/{kind}" for kind in ("random-repeated", "appropriate-bias")),
                    *(row.name for row in MORE_REGULARISED_MASTERS if f"/{place}/" in row.name),
                )
                for place in ("bandit", "maze")
            ),
        ),
    ),
    Answer("6", "Appropriate bias seems to work best", (10,), (11, 12)),
    Answer("6", "Transitions take place successfully almost always", (11,), (11,)),
    Answer(
        "7",
        "With and without regularisation: four sub-policies, masters on AntMaze and AntBandit, two flat policies on "
        "each; PPO with a clipped surrogate, GAE, Adam",
        built="as described; every row, its seeds and its steps under Rows",
    ),
    Answer(
        "7",
        "Table 1: learning rate, discount, GAE, clip ratio, value loss, I",
        built=f"learning rate {PAPER.learning_rate:g}, discount {PAPER.gamma:g}, GAE {PAPER.gae_lambda:g}, clip ratio "
        f"{PAPER.clip_eps:g}, value loss {PAPER.vf_coef:g}, I = {PAPER.update_epochs}, in every row of the paper's",
    ),
    Answer(
        "7",
        "S, I, B of Tables 1 and 2; create B = 32 batches (a number, or a size?)",
        figures=(19,),
        shows=(
            *_grid("return", "ablation/walker/B-as-size"),
            *_grid("way", "ablation/bandit/B-as-size", "ablation/maze/B-as-size"),
            _rows("way", *_varied("bandit")),
        ),
        built="a number; 32 as a size is an ablation",
    ),
    Answer(
        "7",
        "The reward is averaged over consecutive runs to get a cleaner plot",
        figures=(5, 6, 9, 10),
        built="so here, over the last twentieth of the training",
    ),
    Answer(
        "8",
        "Only the reward for the distance is graphed, also where penalties are in it",
        figures=(5, 6, 9, 10, 20),
        built="so here; verdicts rest on the distance too, success and the way around the walls stand beside it",
    ),
    Answer("8", "Stability penalties while training the master do not make a difference", (13,), (20, 23)),
    Answer("8", "The regularised hierarchy outperforms the flat policies (Figures 5, 6)", (1, 2), (5, 6, 15, 18)),
    Answer(
        "8",
        "This is a fair comparison: the observations are enough for an ideal algorithm",
        figures=(5, 6, 19),
        shows=_grid("way", *FLAT_GRIDS),
        built="flat policies see what masters see and take 10 M control steps; a master takes 0.5 or 2 M on "
        "sub-policies of 4 M (symmetric), 8, or 16 (appropriate bias, whose partners are plain). With the masters' "
        "reward (flat/guided-...) they are shown too, and without the entropy bonus, which is ours, with less noise "
        "(its cap is ours too), and annealed as interleaved rows are",
    ),
    Answer(
        "8, 9",
        "The search space of a master is much smaller, one action of it changes the state by a large amount",
        figures=(13, 15),
        built="four choices every k steps for eight torques every step; how much k matters is Figure 13",
    ),
    Answer("8", "Flat policies without stability penalties perform better than with them", (3,), (5, 6)),
    Answer(
        "8",
        "Unregularised sub-policies show a considerably smaller variance (Figures 7, 8), because regularisation takes "
        "random steps",
        (6,),
        (7, 8),
    ),
    Answer(
        "8",
        "Unregularised policies achieve higher rewards eventually",
        (5,),
        (7, 8),
        shows=tuple(
            _rows(metric, *(f"walker/{kind}" for kind in ("plain", *PAPER_REGULARISERS)))
            for metric in ("return halfway", "return")
        ),
        built="what is found depends on when one looks, since returns need not keep rising under Table 1's constant "
        "learning rate: claims 5 and 6 are shown half-way through training too",
    ),
    Answer("8", "... but do not allow smooth transitions", (12,), (11, 12)),
    Answer(
        "8",
        "The hypothesis, that a master needs sub-policies which hand over smoothly, is validated",
        figures=(21,),
        built="not one of the claims, looked at after the runs: whether, of a kind's seeds, masters come within 1 m "
        "more often on those that hand over better (Spearman's rank correlation within kinds)",
        associations=ASSOCIATIONS,
    ),
    Answer("8", "Regularised sub-policies serve as much better slaves (Figures 9, 10)", (7, 8), (9, 10, 16)),
    Answer("8", "The difference is much more pronounced on AntMaze", (9,), (9, 10)),
    Answer(
        "8",
        "AntBandit requires only one transition in the ideal case, AntMaze several",
        figures=(16,),
        shows=tuple(
            _rows("transitions", *(f"{place}/hrl/{kind}" for kind in ("plain", "appropriate-bias", "interleaved")))
            for place in ("bandit", "maze")
        ),
    ),
    Answer("9", "Moving straight to the target, the flat policy gets stuck in a wall", (4,), (16, 17)),
    Answer(
        "ours",
        "Interleaved sub-policies; one symmetric policy",
        (14, 15),
        (11, 12, 19, 22),
        shows=(
            *(
                _rows(metric, "walker/interleaved", *(row.name for row in INTERLEAVED_WITHOUT))
                for metric in ("handover", "idle", "upside down", "speed")
            ),
            *(
                _rows(
                    "success",
                    f"{place}/hrl/interleaved",
                    *(row.name for row in INTERLEAVED_WITHOUT_MASTERS if f"/{place}/" in row.name),
                )
                for place in ("bandit", "maze")
            ),
        ),
        built="interleaved rows hand ants over to each other while they train, count what an ant is then worth "
        "to the others (cooperation), are annealed, and end episodes on the back: the last three are left out one by "
        "one, and all together",
    ),
)


@dataclass(frozen=True)
class Choice:
    """Something that the paper leaves open, and what was taken."""

    what: str
    here: str


def choices(study: Study) -> tuple[Choice, ...]:
    """Read off the rows themselves, as the study trains them."""

    def fields(kind: str) -> dict[str, Any]:
        return vars(study.row(f"walker/{kind}").regulariser)

    walker, annealed = study.row("walker/plain"), study.row("walker/interleaved").ppo
    maze, bandit = study.row("maze/paper/plain"), study.row("bandit/paper/plain")
    ours, flat = study.row("maze/hrl/plain"), study.row("maze/flat/free")
    table_1, masters = walker.ppo, ours.ppo
    weights = walker.task.weights
    corner, start = bandit.task.arena.goals[0], maze.task.arena.start
    return (
        Choice("engine and ant", "MuJoCo, the ant with the masses of PyBullet's; docs/ant.md compares them"),
        Choice(
            "control steps",
            f"sub-policies {walker.total_steps:,} per direction (symmetric ones "
            f"{study.row('walker/symmetric').total_steps:,}), masters {bandit.total_steps:,} on AntBandit and "
            f"{maze.total_steps:,} on AntMaze, flat policies {flat.total_steps:,}",
        ),
        Choice(
            "episodes",
            f"{walker.task.episode_steps} control steps in training sub-policies, {maze.task.episode_steps} on the "
            "tasks; a sub-policy's ends when the torso is too low, a task's within "
            f"{maze.task.goal_radius} m of the goal",
        ),
        Choice(
            "PPO beside Table 1",
            f"entropy bonus {table_1.ent_coef} (in a pilot without it one of four never walked), advantages "
            f"normalised per update, Adam's epsilon {table_1.adam_eps:g}, log-deviation {table_1.initial_log_std:g} at "
            "first; no schedule of the learning rate, no gradient clipping. The light ant's sub-policies get no bonus, "
            "since plain ones and the paper's were seen not to walk with it",
        ),
        Choice(
            "S = 2048",
            f"{table_1.num_envs} ants side by side, {table_1.num_steps} control steps each per update; S = 128 and 40 "
            f"of the masters: {maze.ppo.num_envs} ants, {maze.ppo.num_steps} and {bandit.ppo.num_steps} decisions each",
        ),
        Choice(
            "reward weights",
            f"progress {weights.progress:g} (m/s), alive {weights.alive:g}, power {weights.electricity:g}, stalling "
            f"torque {weights.stall_torque:g}, joints at limits {weights.joints_at_limit:g}, feet "
            f"{weights.feet_collision:g}; nothing for being alive on the tasks",
        ),
        Choice("k", f"{maze.option_steps} control steps"),
        Choice(
            "t",
            f"random start {fields('random-start')['steps']} control steps; random repeated "
            f"{fields('random-repeated')['duration']} steps of noise every {fields('random-repeated')['every']}; "
            f"appropriate bias {fields('appropriate-bias')['steps']} steps of a partner from walker/plain",
        ),
        Choice(
            "square and maze", f"corners {corner[0]:g} m from the middle along x and y; start of the U maze at {start}"
        ),
        Choice(
            "our reward, our masters' schedule (rows hrl and guided)",
            f"{ours.task.weights.goal:g} for arriving, coordinates times {ours.task.xy_scale:g}, on AntMaze progress "
            f"along the shortest way around the walls; masters: {masters.num_envs} ants, {masters.num_steps} decisions "
            f"each, {masters.num_minibatches} batches, learning rate {masters.learning_rate:g}, rewards times "
            f"{masters.reward_scale:g}. Flat policies keep Table 1's schedule with either reward",
        ),
        Choice(
            "interleaved rows",
            f"stays of {fields('interleaved')['mean_steps']} control steps in the mean, an exchange at every "
            f"{fields('interleaved')['every']}th step at most; entropy bonus and learning rate fall over the training "
            f"to {annealed.final_ent_coef_share:g} and {annealed.final_learning_rate_share:g} of what they are; "
            "episodes end on the back too",
        ),
    )


def said(answer: Answer, judgements: Sequence[Judgement], results: Results) -> str:
    """The answer in lines: how it is built, the verdicts with their effects, the rows that are shown."""
    lines = [answer.built] if answer.built else []
    lines += [_verdict(j) for j in judgements if j.claim.number in answer.claims]
    lines += [line for shown in answer.shows if (line := _side_by_side(shown, results))]
    lines += [line for association in answer.associations for line in _associated(association, results)]
    return "\n".join(lines) or "see the figure"


def _associated(association: Association, results: Results) -> list[str]:
    """A line for the default engine and ant, and for each other at hand whose runs say it."""
    lines = []
    for prefix in prefixes_at_hand(results):
        effect = strength(results, association, prefix)
        if prefix and effect is None:
            continue
        said = f"{effect.estimate:.2f} [{effect.low:.2f}, {effect.high:.2f}]" if effect else "no runs that say it"
        lines.append(f"{association.words} ({engine_and_ant(prefix)}): {said}")
    return lines


def _verdict(judgement: Judgement) -> str:
    effects = [f"{f.contrast.words} {show_effect(f)}" for f in judgement.findings if f.contrast.decides and f.effect]
    return (
        f"claim {judgement.claim.number} ({judgement.where}): {judgement.verdict} "
        f"({'; '.join([*effects, judgement.why])})"
    )


def _side_by_side(shown: Shown, results: Results) -> str:
    """The rows that have runs; those without are named together."""
    metric, grid = METRICS[shown.metric], f"{shown.where}, " if shown.where else ""
    measured: list[str] = []
    missing: list[tuple[str, str]] = []
    for label, row in shown.rows:
        scores = results.scores(row, shown.metric) if is_row(row) else ()
        if len(scores):
            measured.append(
                f"{label}{':' if grid else ''} {metric.show(float(iqm(scores)))} ({seeds_in_words(len(scores))})"
            )
        else:
            missing.append((label, row))
    parts = [", ".join(measured)] if measured else []
    names = ", ".join(label for label, _ in missing) if grid else in_braces(row for _, row in missing)
    parts += [f"no runs of {names}" if measured or not grid else "no runs"] if missing else []
    return f"{grid}{metric.words}: {'; '.join(parts)}"


__all__ = ["ANSWERS", "Answer", "Choice", "Shown", "choices", "said"]
