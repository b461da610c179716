"""The paper's claims and ours, written down before the runs: rows of data, and the rules that decide them.

A claim compares rows of the table in a metric (:data:`footwork.study.metrics.METRICS`).
Each comparison is a contrast of interquartile means over seeds with a 95 % stratified-bootstrap
interval, whole seeds drawn within each row. Rules, where E is the estimate, [L, U] the interval
and m the smallest difference that matters:

==============  =========================  ================================
rule            holds                      does not hold
==============  =========================  ================================
``greater``     L > 0 and E >= m           U < m
``not worse``   L > -m                     U < 0 and E <= -m
``same``        -m < L and U < m           0 outside [L, U] and |E| >= m
``at least``    L >= threshold             U < threshold
``at most``     U <= threshold             L > threshold
==============  =========================  ================================

Anything else is undecided, and so is every comparison with fewer than :attr:`Claim.min_seeds`
seeds on a side. A claim holds if all its deciding comparisons hold; it does not hold if one does not.

Rows are read per setting: engine and ant (the first part of an address), and the masters'
reward and schedule, the paper's or ours. A verdict names all of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

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
from footwork.study.experiments import MAIN, SCHEDULES, find_row, in_braces, is_row
from footwork.study.metrics import METRICS
from footwork.study.results import Results, seeds_in_words

Rule = Literal["greater", "not worse", "same", "at least", "at most"]
Verdict = Literal["holds", "does not hold", "undecided"]
MIN_SEEDS = 10
PAPER_REGULARISERS = ("random-start", "random-repeated", "appropriate-bias")


@dataclass(frozen=True)
class Contrast:
    """One comparison of a claim.

    Args:
        words: what is compared, short.
        rows: addresses, with {schedule} and {guided} to be filled in.
        weights: of each row's statistic.
        metric: a key of METRICS.
        rule: how it is decided.
        bound: the smallest difference that matters, or the threshold of ``at least`` and ``at most``.
        statistic: of each row's scores: the IQM, or the spread across seeds.
        decides: otherwise it is only shown.
        paired: rows that stand on the same sub-policies are compared seed by seed: their seeds are drawn together.
    """

    words: str
    rows: tuple[str, ...]
    weights: tuple[float, ...]
    metric: str
    rule: Rule
    bound: float
    statistic: Literal["iqm", "spread"] = "iqm"
    decides: bool = True
    paired: bool = False


@dataclass(frozen=True)
class Claim:
    """A sentence, and what would have to be seen for it to hold.

    Args:
        number: as in the study's list.
        words: the claim.
        section: of the paper; "ours" for those that the paper does not make.
        contrasts: its comparisons.
        everywhere: it is judged on every engine and ant at hand, else on the default ones only.
        min_seeds: on each side of a comparison, below which it is undecided.
    """

    number: int
    words: str
    section: str
    contrasts: tuple[Contrast, ...]
    everywhere: bool = False
    min_seeds: int = MIN_SEEDS


@dataclass(frozen=True)
class Setting:
    """Where a claim is judged: the first part of the addresses, and the masters' kind."""

    prefix: str = ""  # "", "light/", "bullet/"
    schedule: str = "paper"  # "paper" or "hrl"

    def fill(self, row: str) -> str:
        """The row's address in this setting."""
        return self.prefix + row.format(schedule=self.schedule, guided="" if self.schedule == "paper" else "guided-")


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


def _greater(words: str, one: str, other: str, metric: str, margin: float, decides: bool = True) -> Contrast:
    return Contrast(words, (one, other), (1, -1), metric, "greater", margin, decides=decides)


def _way(words: str, one: str, other: str, decides: bool = True) -> Contrast:
    return _greater(words, one, other, "way", 0.05, decides)


def _same_way(words: str, one: str, other: str, rule: Rule, paired: bool = False) -> Contrast:
    return Contrast(words, (one, other), (1, -1), "way", rule, 0.05, paired=paired)


def _shown_too(contrasts: tuple[Contrast, ...]) -> tuple[Contrast, ...]:
    """The same comparisons in two measures that the paper does not report: shown, not deciding.

    Success within 1 m; and, on AntMaze, the way around the walls. The straight line, which the paper plots, calls an
    ant that stands at the wall nearer to the goal than one that is half-way around it.
    """
    shown = []
    for c in contrasts:
        maze = all("maze/" in row for row in c.rows)
        for metric in ("success", *(("route",) if maze else ())):
            shown.append(replace(c, words=f"{c.words}, {_SHORT[metric]}", metric=metric, decides=False))
    return (*contrasts, *shown)


# All returns fall in the second half of the training: what would have been found at half of it, shown.
_HALFWAY = ", half-way through training"

# One hand-over from walking, which decides, is near its ceiling; shown beside it, one after the other for 33 s.
_HANDING_OVER = (("handover", ""), ("moving", ", switched at random"))

_GAPS = (("maze", "appropriate-bias"), ("maze", "plain"), ("bandit", "appropriate-bias"), ("bandit", "plain"))

_SHORT = {"success": "success", "route": "way around the walls"}


def _beats_flat(place: str) -> tuple[Contrast, ...]:
    master = f"{place}/{{schedule}}/appropriate-bias"
    return _shown_too(
        (
            _way("against flat, penalised", master, f"{place}/flat/{{guided}}penalised"),
            _way("against flat, free", master, f"{place}/flat/{{guided}}free"),
        )
    )


def _serves_better(place: str) -> tuple[Contrast, ...]:
    plain = f"{place}/{{schedule}}/plain"
    others = tuple(
        _way(f"{kind} against plain", f"{place}/{{schedule}}/{kind}", plain, decides=kind == "appropriate-bias")
        for kind in reversed(PAPER_REGULARISERS)
    )
    return _shown_too(others[:1]) + others[1:]


def _both(make: Callable[[str], tuple[Contrast, ...]]) -> tuple[Contrast, ...]:
    return (*make("bandit"), *make("maze"))


# Claims 1, 2, 7, 8, 9: "regularised" is appropriate bias, which the paper finds best; the others are shown beside it.
CLAIMS: tuple[Claim, ...] = (
    Claim(
        1,
        "With regularised sub-policies the hierarchy beats both flat policies on AntBandit.",
        "8, Figure 6",
        _beats_flat("bandit"),
    ),
    Claim(
        2,
        "With regularised sub-policies the hierarchy beats both flat policies on AntMaze.",
        "8, Figure 5",
        _beats_flat("maze"),
    ),
    Claim(
        3,
        "Flat policies without stability penalties beat those with them, on both tasks.",
        "8, Figures 5 and 6",
        _shown_too(
            _both(lambda place: (_way(place, f"{place}/flat/{{guided}}free", f"{place}/flat/{{guided}}penalised"),))
        ),
    ),
    Claim(
        4,
        "On AntMaze the flat policy without penalties ends stuck behind a wall: most of its episodes end within "
        "1 m of where the straight line to the goal meets the wall.",
        "9",
        (
            Contrast("share of episodes", ("maze/flat/free",), (1,), "stuck", "at least", 0.5),
            Contrast("within 0.5 m of there", ("maze/flat/free",), (1,), "stuck close", "at least", 0.5, decides=False),
            Contrast(
                "within 0.5 m of the start", ("maze/flat/free",), (1,), "at the start", "at most", 0.5, decides=False
            ),
            Contrast("turned over", ("maze/flat/free",), (1,), "turned over", "at most", 0.5, decides=False),
        ),
    ),
    Claim(
        5,
        "Unregularised sub-policies reach a higher training reward than regularised ones.",
        "8, Figures 7 and 8",
        tuple(
            _greater(f"against {kind}{when}", "walker/plain", f"walker/{kind}", metric, 50.0, decides=not when)
            for metric, when in (("return", ""), ("return halfway", _HALFWAY))
            for kind in PAPER_REGULARISERS
        ),
    ),
    Claim(
        6,
        "The training reward of unregularised sub-policies varies less (standard deviation across seeds, "
        "within directions).",
        "8, Figures 7 and 8",
        (
            *(
                Contrast(
                    f"{kind} less plain{when}",
                    (f"walker/{kind}", "walker/plain"),
                    (1, -1),
                    metric,
                    "greater",
                    50.0,
                    "spread",
                    decides=not when,
                )
                for metric, when in (("return by direction", ""), ("return by direction halfway", _HALFWAY))
                for kind in PAPER_REGULARISERS
            ),
            # The other reading, of one curve: how much it goes up and down. Added after the first seeds were seen.
            *(
                _greater(
                    f"{kind} less plain, within a run",
                    f"walker/{kind}",
                    "walker/plain",
                    "fluctuation",
                    10.0,
                    decides=False,
                )
                for kind in PAPER_REGULARISERS
            ),
        ),
    ),
    Claim(
        7,
        "Regularised sub-policies serve the master better on AntBandit.",
        "8, Figure 9",
        _serves_better("bandit"),
        everywhere=True,
    ),
    Claim(
        8,
        "Regularised sub-policies serve the master better on AntMaze.",
        "8, Figure 10",
        _serves_better("maze"),
        everywhere=True,
    ),
    Claim(
        9,
        "The gap between regularised and unregularised sub-policies is larger on AntMaze than on AntBandit.",
        "8, Figures 9 and 10",
        tuple(
            Contrast(
                f"gap on AntMaze less gap on AntBandit{how}",
                tuple(f"{place}/{{schedule}}/{kind}" for place, kind in _GAPS),
                (1, -1, -1, 1),
                metric,
                "greater",
                0.05,
                decides=not how,
                paired=paired,
            )
            for metric, how, paired in (
                ("way", "", False),
                ("way", ", seed by seed", True),
                ("success", ", success", False),
            )
        ),
        everywhere=True,
    ),
    Claim(
        10,
        "Appropriate bias is the best of the paper's three regularisers at handing over.",
        "6",
        tuple(
            _greater(f"against {kind}{how}", "walker/appropriate-bias", f"walker/{kind}", metric, 0.05, not how)
            for metric, how in _HANDING_OVER
            for kind in PAPER_REGULARISERS[:2]
        ),
        everywhere=True,
    ),
    Claim(
        11,
        "With appropriate bias transitions succeed almost always: in at least 95 % of orthogonal hand-overs the ant "
        "neither falls nor flips and walks on at 0.5 m/s or more.",
        "6",
        tuple(
            Contrast(
                f"share{how or ' of hand-overs'}",
                ("walker/appropriate-bias",),
                (1,),
                metric,
                "at least",
                0.95,
                decides=not how,
            )
            for metric, how in _HANDING_OVER
        ),
        everywhere=True,
    ),
    Claim(
        12,
        "Unregularised ants consistently fail to hand over to an orthogonal policy: at most half of the hand-overs "
        "succeed.",
        "6",
        tuple(
            Contrast(
                f"share{how or ' of hand-overs'}", ("walker/plain",), (1,), metric, "at most", 0.5, decides=not how
            )
            for metric, how in _HANDING_OVER
        ),
        everywhere=True,
    ),
    Claim(
        13,
        "Stability penalties in the master's reward make no difference.",
        "8",
        _shown_too(
            _both(
                lambda place: tuple(
                    _same_way(
                        f"{place}, {kind}",
                        f"{place}/{{schedule}}-penalised/{kind}",
                        f"{place}/{{schedule}}/{kind}",
                        "same",
                        paired=True,  # decided before a penalised master was trained
                    )
                    for kind in ("appropriate-bias", "plain")
                )
            )
        ),
    ),
    Claim(
        14,
        "Interleaved sub-policies beat all three of the paper's, at handing over and under a master on AntMaze. "
        "(They are annealed and end episodes on their backs besides; shown too: the paper's three, annealed.)",
        "ours",
        (
            *(
                _greater(
                    f"hand-overs, against {kind}{how}", "walker/interleaved", f"walker/{kind}", metric, 0.05, not how
                )
                for metric, how in _HANDING_OVER
                for kind in PAPER_REGULARISERS
            ),
            *_shown_too(
                tuple(
                    _way(f"maze, against {kind}", "maze/{schedule}/interleaved", f"maze/{{schedule}}/{kind}")
                    for kind in PAPER_REGULARISERS
                )
            ),
            *(
                _greater(
                    f"hand-overs, against {kind}, annealed",
                    "walker/interleaved",
                    f"ablation/annealed/{kind}",
                    "handover",
                    0.05,
                    decides=False,
                )
                for kind in PAPER_REGULARISERS
            ),
        ),
        everywhere=True,
    ),
    Claim(
        15,
        "One symmetric policy serves a master as well as four policies.",
        "ours",
        _shown_too(
            _both(
                lambda place: tuple(
                    _same_way(
                        f"{place}, {one}", f"{place}/{{schedule}}/{one}", f"{place}/{{schedule}}/{four}", "not worse"
                    )
                    for one, four in (("symmetric", "plain"), ("symmetric-interleaved", "interleaved"))
                )
            )
        ),
    ),
)


def settings_of(claim: Claim, prefixes: Iterable[str] = ("",)) -> list[Setting]:
    """Where a claim is judged: its masters with both schedules, its rows under each prefix if it says everywhere.

    Only where the table has all the rows that decide.
    """
    rows = [row for c in claim.contrasts if c.decides for row in c.rows]
    schedules = SCHEDULES if any("{" in row for row in rows) else {"paper": ""}
    chosen = tuple(prefixes) if claim.everywhere else ("",)
    settings = [Setting(prefix, schedule) for prefix in chosen for schedule in schedules]
    return [setting for setting in settings if all(is_row(setting.fill(row)) for row in rows)]


def rows_read(prefixes: Iterable[str] = ("",)) -> list[str]:
    """Every row that a claim reads, in the order of the table."""
    everything = tuple(prefixes)
    read = {
        setting.fill(row)
        for claim in CLAIMS
        for setting in settings_of(claim, everything)
        for c in claim.contrasts
        for row in c.rows
    }
    order = {name: i for i, name in enumerate(MAIN)}
    mine = (name for name in read if is_row(name) and not name.startswith("ablation/"))  # those have fewer seeds
    return sorted(mine, key=lambda name: (order.get(name, len(order)), name))


def prefixes_at_hand(results: Results) -> tuple[str, ...]:
    """The default engine and ant, and those others that have finished runs in the study's folder."""
    runs = results.study.runs
    places = sorted(path.name for path in runs.iterdir() if path.is_dir()) if runs.is_dir() else []
    there = [f"{name}/" for name in places if any(is_row(f"{name}/{row}") for row in MAIN)]
    return ("", *(prefix for prefix in there if any((runs / prefix).rglob("DONE"))))


def judge_all(results: Results) -> list[Judgement]:
    """Every claim in every setting at hand, in the order of the claims."""
    prefixes = prefixes_at_hand(results)
    return [judge(results, claim, setting) for claim in CLAIMS for setting in settings_of(claim, prefixes)]


def judge(results: Results, claim: Claim, setting: Setting) -> Judgement:
    """A claim's verdict in a setting, from the files of its runs."""
    contrasts = [c for c in claim.contrasts if c.decides or all(is_row(setting.fill(row)) for row in c.rows)]
    findings = tuple(_find(results, claim, c, setting) for c in contrasts)
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
    by_seed = _in_pairs(results, claim, rows, stands_on, by_seed)
    scores = [np.array(list(score.values()), np.float64) for score in by_seed]
    seeds = tuple(len(score) for score in scores)
    if not all(seeds):
        return Finding(what, rows, seeds, None, None, "undecided", "undecided")
    statistic: Statistic = spread if what.statistic == "spread" else overall_iqm
    generator = generator_for(f"claim {claim.number} {what.words} {what.metric} {rows}")
    units = [[(row, seed) for seed in score] for row, score in zip(stands_on, by_seed, strict=True)]
    effect = contrast(scores, what.weights, generator, statistic, units=units)
    so_far: Verdict = decide(what.rule, what.bound, effect) if min(seeds) > 1 else "undecided"
    verdict = so_far if min(seeds) >= claim.min_seeds else "undecided"
    room = None
    if METRICS[what.metric].is_share and what.rule == "greater" and what.weights == (1, -1):
        room = 1.0 - float(overall_iqm(as_scores(scores[1])))
    return Finding(what, rows, seeds, effect, _probability(what, scores), verdict, so_far, room)


def _stands_on(row: str) -> str:
    """The row whose runs a row's seeds stand on: a master's sub-policies, anything else's own."""
    return find_row(row).sub_policies or row


def _in_pairs(
    results: Results, claim: Claim, rows: Sequence[str], stands_on: Sequence[str], by_seed: Sequence[dict[int, Any]]
) -> list[dict[int, Any]]:
    """Of rows that stand on the same runs and have different seeds, those that all of them have; the others are named.

    Where one has none at all there is nothing to compare, and nothing to say.
    """
    paired = []
    for row, base, scores in zip(rows, stands_on, by_seed, strict=True):
        partners = [other for other, b in zip(by_seed, stands_on, strict=True) if b == base and other]
        alone = sorted(seed for seed in scores if not all(seed in other for other in partners))
        if alone:
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
    if what.statistic == "spread":  # that a run is farther from the middle of its row
        if min(map(len, scores)) < 3:  # a lone one is its own middle
            return None
        scores = [np.abs(score - np.median(score, axis=0)) for score in scores]
    return probability_of_improvement(*scores)


def decide(rule: Rule, bound: float, effect: Effect) -> Verdict:
    """What a rule says of an effect (see the table at the top)."""
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


def _where(claim: Claim, setting: Setting) -> str:
    experiment = find_row(f"{setting.prefix}walker/plain")
    where = f"{experiment.engine}, {experiment.task.robot.name} ant"
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
        return "; ".join([*said, *_no_room(deciding)])
    if missing:
        return f"no runs of {missing}"
    fewest = min(min(f.seeds) for f in deciding)
    if fewest < claim.min_seeds:
        so_far = _overall([f.so_far for f in deciding])
        return f"{seeds_in_words(fewest)}, {claim.min_seeds} are asked for; so far: {so_far}"
    return "; ".join(["the interval allows both", *_no_room(deciding)])


def _no_room(deciding: list[Finding]) -> list[str]:
    """Comparisons in which the other row leaves less than the smallest difference that matters."""
    return [
        f"{f.contrast.words}, no more than {100 * f.room:.1f} points were possible"
        for f in deciding
        if f.room is not None and f.room < f.contrast.bound
    ]


def _in_brackets(finding: Finding, effect: Effect) -> str:
    low, high = (METRICS[finding.contrast.metric].number(value) for value in (effect.low, effect.high))
    return f"[{low}, {high}]"


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
    interval = "" if alone else f" {_in_brackets(finding, finding.effect)}"
    unit = metric.unit if len(finding.rows) == 1 else metric.difference
    return f"{metric.number(finding.effect.estimate)}{interval} {unit}"


def show_bound(what: Contrast) -> str:
    """The rule, and the smallest difference that matters or the threshold."""
    metric = METRICS[what.metric]
    return f"{what.rule}, {metric.number(what.bound)} {metric.unit if len(what.rows) == 1 else metric.difference}"


def show_chance(finding: Finding) -> str:
    """The probability of improvement; of spreads, that a run is farther from the middle of its row."""
    if finding.probability is None:
        return "-"
    farther = " farther from the middle" if finding.contrast.statistic == "spread" else ""
    return f"{finding.probability:.2f}{farther}"


__all__ = [
    "CLAIMS",
    "MIN_SEEDS",
    "Claim",
    "Contrast",
    "Finding",
    "Judgement",
    "Setting",
    "decide",
    "is_reversed",
    "judge",
    "judge_all",
    "prefixes_at_hand",
    "rows_read",
    "settings_of",
    "show_bound",
    "show_chance",
    "show_effect",
]
