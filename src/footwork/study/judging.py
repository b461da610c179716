"""Judge the claims: their comparisons from the files of the runs, their verdicts, and both in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from footwork.statistics import (
    Effect,
    Floats,
    Statistic,
    as_scores,
    contrast,
    generator_for,
    overall_iqm,
    probability_of_improvement,
    spread,
)
from footwork.study.claims import CLAIMS, Claim, Contrast, Rule, Setting, Verdict, settings_of
from footwork.study.experiments import SCHEDULES, find_row, in_braces, is_row
from footwork.study.measure import EVALUATION, straight_line_stop
from footwork.study.metrics import METRICS
from footwork.study.results import Results, prefixes_at_hand, seeds_in_words

ROOM_AT_WALL = 0.25  # m: so much nearer to the goal than where the straight line ends an ant may stand at the wall


@dataclass(frozen=True)
class Finding:
    """What a comparison found."""

    contrast: Contrast
    rows: tuple[str, ...]
    seeds: tuple[int, ...]  # of each row
    effect: Effect | None  # None where a row has no runs
    probability: float | None  # of improvement, of two rows
    verdict: Verdict
    so_far: Verdict  # what the rule says if the number of seeds is not asked for
    room: float | None = None  # the most that a difference of shares could be: what the other row leaves
    at_wall: bool = False  # room ends where the straight line meets a wall: nobody ended nearer, but for ROOM_AT_WALL


@dataclass(frozen=True)
class Judgement:
    """A claim's verdict in a setting."""

    claim: Claim
    setting: Setting
    where: str  # engine, ant, the masters' reward and schedule
    findings: tuple[Finding, ...]
    verdict: Verdict
    so_far: Verdict  # if the number of seeds is not asked for
    why: str


def judge_all(results: Results) -> list[Judgement]:
    """Every claim in every setting at hand, in the order of the claims.

    On other ants and engines our reward and schedule are enough; the paper's is judged there once it has masters.
    """
    prefixes = prefixes_at_hand(results)
    return [
        judge(results, claim, setting)
        for claim in CLAIMS
        for setting in settings_of(claim, prefixes)
        if not (setting.prefix and setting.schedule == "paper") or _has_masters(results, claim, setting)
    ]


def _has_masters(results: Results, claim: Claim, setting: Setting) -> bool:
    """Whether any master that the claim reads has runs in the setting; true of a claim that reads none."""
    masters = {setting.fill(row) for c in claim.contrasts for row in c.rows if "{schedule}" in row}
    return not masters or any(results.samples(row) for row in masters if is_row(row))


def judge(results: Results, claim: Claim, setting: Setting) -> Judgement:
    """A claim's verdict in a setting, from the files of its runs."""
    contrasts = [c for c in claim.contrasts if c.decides or all(is_row(setting.fill(row)) for row in c.rows)]
    found = [_find(results, claim, c, setting) for c in contrasts]
    findings = tuple(f for f in found if not f.contrast.afterwards or any(f.seeds))
    deciding = [finding for finding in findings if finding.contrast.decides]
    verdict, so_far = _overall([f.verdict for f in deciding]), _overall([f.so_far for f in deciding])
    return Judgement(claim, setting, _where(claim, setting), findings, verdict, so_far, _why(claim, deciding, verdict))


def _overall(verdicts: list[Verdict]) -> Verdict:
    if "does not hold" in verdicts:
        return "does not hold"
    return "holds" if set(verdicts) == {"holds"} else "undecided"


def _find(results: Results, claim: Claim, what: Contrast, setting: Setting) -> Finding:
    rows = tuple(setting.fill(row) for row in what.rows)
    by_seed = [results.scores_by_seed(row, what.metric) if is_row(row) else {} for row in rows]
    stands_on = [_stands_on(row) if what.paired and is_row(row) else row for row in rows]
    by_seed = _in_pairs(results, claim, what, rows, stands_on, by_seed)
    scores = [_as_array(score) for score in by_seed]
    seeds = tuple(map(len, scores))
    effect = _effect(results, claim, what, rows, stands_on, by_seed) if all(seeds) else None
    if effect is None:
        return Finding(what, rows, seeds, None, None, "undecided", "undecided")
    so_far: Verdict = decide(what.rule, what.bound, effect) if min(seeds) > 1 else "undecided"
    verdict = so_far if min(seeds) >= claim.min_seeds else "undecided"
    room, wall = None, None
    if METRICS[what.metric].is_share and what.rule == "greater" and what.weights == (1, -1):
        wall = _way_to_wall(results, what, rows)
        room = (1.0 if wall is None else wall) - float(overall_iqm(as_scores(scores[1])))
    return Finding(what, rows, seeds, effect, _probability(what, scores), verdict, so_far, room, wall is not None)


def _way_to_wall(results: Results, what: Contrast, rows: Sequence[str]) -> float | None:
    """The share of the way at which the straight line meets a wall, if no episode ended nearer to the goal than that.

    But for :data:`ROOM_AT_WALL`, since where the ant stands along the wall leaves some room.
    """
    arena = find_row(rows[0]).task.arena
    stop = straight_line_stop(arena) if what.metric == "way" else None
    if stop is None:
        return None
    whole, left = math.dist(arena.start, arena.goals[0]), math.dist(stop, arena.goals[0])
    for row in rows:
        for entry in results.measurements(row, EVALUATION):
            ends = np.array(entry["ends"], np.float64)
            if (np.hypot(*(ends - np.array(arena.goals[0])).T) < left - ROOM_AT_WALL).any():
                return None
    return 1.0 - left / whole


def _effect(
    results: Results,
    claim: Claim,
    what: Contrast,
    rows: Sequence[str],
    stands_on: Sequence[str],
    by_seed: Sequence[dict[int, Any]],
) -> Effect | None:
    """A comparison's estimate and interval; one row's mean is the one that tables and figures show."""
    if len(rows) == 1 and what.statistic == "iqm":
        return results.middle(rows[0], what.metric)
    statistic: Statistic = spread if what.statistic == "spread" else overall_iqm
    generator = generator_for(f"claim {claim.number} {what.words} {what.metric} {rows}")
    units = [[(row, seed) for seed in score] for row, score in zip(stands_on, by_seed, strict=True)]
    return contrast([_as_array(score) for score in by_seed], what.weights, generator, statistic, units=units)


def _as_array(score: dict[int, Any]) -> Floats:
    return np.array(list(score.values()), np.float64)


def _stands_on(row: str) -> str:
    """The row whose runs a row's seeds stand on: a master's sub-policies, anything else's own."""
    return find_row(row).sub_policies or row


def _in_pairs(
    results: Results,
    claim: Claim,
    what: Contrast,
    rows: Sequence[str],
    stands_on: Sequence[str],
    by_seed: Sequence[dict[int, Any]],
) -> list[dict[int, Any]]:
    """Of rows that stand on the same runs and have different seeds, those that all of them have.

    The others are named where the comparison decides. Where a row has none at all there is nothing to compare, and
    nothing to say.
    """
    paired = []
    for row, base, scores in zip(rows, stands_on, by_seed, strict=True):
        partners = [other for other, b in zip(by_seed, stands_on, strict=True) if b == base and other]
        alone = sorted(seed for seed in scores if not all(seed in other for other in partners))
        if alone and what.decides:
            seeds = ", ".join(map(str, alone))
            said = (
                f"claim {claim.number} compares {row} seed by seed, and leaves out those without a counterpart: {seeds}"
            )
            results.problems[said] = None
        paired.append({seed: score for seed, score in scores.items() if seed not in alone})
    return paired


def _probability(what: Contrast, scores: list[Floats]) -> float | None:
    if len(scores) != 2:
        return None
    if what.paired:  # that a seed does better than its counterpart
        one, other = map(as_scores, scores)
        return float(np.mean((one > other) + 0.5 * (one == other)))
    if what.statistic == "spread":  # that a run is farther from the middle of its row
        if min(map(len, scores)) < 3:  # a lone one is its own middle
            return None
        scores = [np.abs(score - np.median(score, axis=0)) for score in scores]
    return probability_of_improvement(*scores)


def decide(rule: Rule, bound: float, effect: Effect) -> Verdict:
    """What a rule says of an effect (see the table at the top of :mod:`footwork.study.claims`)."""
    estimate, low, high = effect
    verdicts: dict[Rule, tuple[bool, bool]] = {
        "greater": (low > 0 and estimate >= bound, high < bound),
        "not worse": (low > -bound, high < 0 and estimate <= -bound),
        "same": (-bound < low and high < bound, not low <= 0 <= high and abs(estimate) >= bound),
        "at least": (low >= bound, high < bound),
        "at most": (high <= bound, low > bound),
    }
    holds, fails = verdicts[rule]
    return "holds" if holds else "does not hold" if fails else "undecided"


def engine_and_ant(prefix: str) -> str:
    """In words, of the rows whose addresses begin so: ``mujoco, light ant``."""
    experiment = find_row(f"{prefix}walker/plain")
    return f"{experiment.engine}, {experiment.task.robot.name} ant"


def _where(claim: Claim, setting: Setting) -> str:
    where = engine_and_ant(setting.prefix)
    return f"{where}, {SCHEDULES[setting.schedule]}" if len(settings_of(claim)) > 1 else where


def _why(claim: Claim, deciding: list[Finding], verdict: Verdict) -> str:
    """One phrase that says what the verdict rests on, or what is missing."""
    missing = in_braces(dict.fromkeys(row for f in deciding for row, n in zip(f.rows, f.seeds, strict=True) if n == 0))
    if verdict != "undecided":
        decisive = [f for f in deciding if f.verdict == verdict]
        said = [f"{seeds_in_words(min(min(f.seeds) for f in decisive))} or more on every side"]
        turned = [f.contrast.words for f in decisive if is_reversed(f)]
        said += [f"the other way round: {', '.join(turned)}"] if turned else []
        said += [f"no runs of {missing}"] if missing else []
        return "; ".join([*said, *_without_room(deciding)])
    if missing:
        return f"no runs of {missing}"
    fewest = min(min(f.seeds) for f in deciding)
    if fewest < claim.min_seeds:
        so_far = _overall([f.so_far for f in deciding])
        return f"{seeds_in_words(fewest)}, {claim.min_seeds} are asked for; so far: {so_far}"
    return "; ".join(["the interval allows both", *_without_room(deciding)])


def _without_room(deciding: list[Finding]) -> list[str]:
    return [f"{f.contrast.words}, {said}" for f in deciding if (said := no_room(f))]


def no_room(finding: Finding) -> str:
    """What is said of a comparison in which the other row leaves less than the smallest difference that matters."""
    if finding.room is None or finding.room >= finding.contrast.bound:
        return ""
    if finding.at_wall:
        points = 100 * max(finding.room, 0.0)
        nobody = f"no episode ended over {ROOM_AT_WALL:g} m nearer to the goal"
        return f"about {points:.1f} points were possible up to the wall, and {nobody}"
    return f"no more than {100 * finding.room:.1f} points were possible"


def is_reversed(finding: Finding) -> bool:
    """Whether a difference that was to be positive is negative, and not only too small."""
    return finding.contrast.rule in ("greater", "not worse") and finding.effect is not None and finding.effect.high < 0


def show_effect(finding: Finding) -> str:
    """The effect with its interval and unit; one seed has no interval, and no spread."""
    if finding.effect is None:
        return "-"
    metric, alone = METRICS[finding.contrast.metric], min(finding.seeds) == 1
    if alone and finding.contrast.statistic == "spread":
        return "-"
    unit = metric.unit if len(finding.rows) == 1 else metric.difference
    return f"{metric.with_interval(finding.effect, alone)} {unit}"


def show_bound(what: Contrast) -> str:
    """The rule, and the smallest difference that matters or the threshold."""
    metric = METRICS[what.metric]
    return f"{what.rule}, {metric.number(what.bound)} {metric.unit if len(what.rows) == 1 else metric.difference}"


def show_chance(finding: Finding) -> str | None:
    """The probability of improvement; of spreads, that a run is farther from the middle of its row.

    None with one or two seeds, of which it says nothing beside the effect.
    """
    if finding.probability is None or min(finding.seeds) < 3:
        return None
    farther = " farther from the middle" if finding.contrast.statistic == "spread" else ""
    return f"{finding.probability:.2f}{farther}"


__all__ = [
    "Finding",
    "Judgement",
    "decide",
    "engine_and_ant",
    "is_reversed",
    "judge_all",
    "no_room",
    "show_bound",
    "show_chance",
    "show_effect",
]
