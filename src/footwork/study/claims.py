"""The paper's claims and ours: rows of data, and the rules that decide them, written down before the runs.

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

Comparisons that do not decide are shown; some were added later (:attr:`Contrast.afterwards`).

Anything else is undecided, and so is every comparison with fewer than :attr:`Claim.min_seeds`
seeds on a side. A claim holds if all its deciding comparisons hold; it does not hold if one does not.

Rows are read per setting: engine and ant (the first part of an address), and the masters'
reward and schedule, the paper's or ours. A verdict names all of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Literal

from footwork.study.experiments import FLAT_GRIDS, GRIDS_BY_NAME, KINDS, MAIN, SCHEDULES, is_row

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
        afterwards: shown, and first looked at after the claim's verdict; its rows get no more seeds for it.
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
    afterwards: bool = False
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
    ) + tuple(
        # Control steps: with partners, appropriate bias and a master take 16.5 or 18 M, plain ones and a master 8.5 or
        # 10 M, a flat policy 10 M.
        _way(
            f"on plain sub-policies, against flat, {kind}",
            f"{place}/{{schedule}}/plain",
            f"{place}/flat/{{guided}}{kind}",
            decides=False,
        )
        for kind in ("penalised", "free")
    )


def _beats_flat_made_otherwise() -> tuple[Contrast, ...]:
    """The same with flat policies that learn with other fields. Shown, where there are such rows."""
    return tuple(
        _way(
            f"against flat, {GRIDS_BY_NAME[grid].base.rpartition('/')[2]}, {how}",
            "bandit/{schedule}/appropriate-bias",
            row.name.replace("/flat-", "/flat-{guided}"),
            decides=False,
        )
        for grid, how in FLAT_GRIDS.items()
        for row in GRIDS_BY_NAME[grid].rows()
    )


def _serves_better(place: str) -> tuple[Contrast, ...]:
    plain = f"{place}/{{schedule}}/plain"
    others = tuple(
        _way(f"{kind} against plain", f"{place}/{{schedule}}/{kind}", plain, decides=kind == "appropriate-bias")
        for kind in reversed(PAPER_REGULARISERS)
    )
    return _shown_too(others[:1]) + others[1:]


def _only_shown(contrasts: Iterable[Contrast], how: str) -> tuple[Contrast, ...]:
    """Comparisons of rows that differ from the study's in one field: shown, where there are such rows."""
    return tuple(replace(c, words=f"{c.words}, {how}", decides=False) for c in _shown_too(tuple(contrasts)))


# Masters with the paper's reward on AntMaze and longer options, and on AntBandit with B read as a size.
_LONG, _AS_SIZE = "ablation/maze/k-{schedule}-200", "ablation/bandit/B-as-size-{schedule}"


def _long_options_beat_flat() -> tuple[Contrast, ...]:
    return _only_shown(
        (
            _way(f"{name}against flat, {flat}", f"{_LONG}/{kind}", f"maze/flat/{{guided}}{flat}")
            for kind, name in (("appropriate-bias", ""), ("plain", "on plain sub-policies, "))
            for flat in ("penalised", "free")
        ),
        "k = 200",
    )


def _serves_better_otherwise(group: str, how: str) -> tuple[Contrast, ...]:
    return _only_shown(
        (_way(f"{kind} against plain", f"{group}/{kind}", f"{group}/plain") for kind in reversed(PAPER_REGULARISERS)),
        how,
    )


# Claim 13 is decided on these sub-policies, its other masters were looked at after that.
_PENALISED_KINDS = ("appropriate-bias", "plain")


def _penalties(place: str, kinds: Iterable[str]) -> tuple[Contrast, ...]:
    return tuple(
        _same_way(
            f"{place}, {kind}",
            f"{place}/{{schedule}}-penalised/{kind}",
            f"{place}/{{schedule}}/{kind}",
            "same",
            paired=True,  # decided before a penalised master was trained
        )
        for kind in kinds
    )


def _both(make: Callable[[str], tuple[Contrast, ...]]) -> tuple[Contrast, ...]:
    return (*make("bandit"), *make("maze"))


# Claims 1, 2, 7, 8, 9: "regularised" is appropriate bias, which the paper finds best; the others are shown beside it.
CLAIMS: tuple[Claim, ...] = (
    Claim(
        1,
        "With regularised sub-policies the hierarchy beats both flat policies on AntBandit.",
        "8, Figure 6",
        _beats_flat("bandit") + _beats_flat_made_otherwise(),
    ),
    Claim(
        2,
        "With regularised sub-policies the hierarchy beats both flat policies on AntMaze.",
        "8, Figure 5",
        _beats_flat("maze") + _long_options_beat_flat(),
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
        _serves_better("bandit") + _serves_better_otherwise(_AS_SIZE, "B as a size"),
        everywhere=True,
    ),
    Claim(
        8,
        "Regularised sub-policies serve the master better on AntMaze.",
        "8, Figure 10",
        _serves_better("maze") + _serves_better_otherwise(_LONG, "k = 200"),
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
        (
            *_shown_too(_both(lambda place: _penalties(place, _PENALISED_KINDS))),
            *(
                replace(c, decides=False, afterwards=True)
                for c in _shown_too(
                    _both(lambda place: _penalties(place, (kind for kind in KINDS if kind not in _PENALISED_KINDS)))
                )
            ),
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
            *_only_shown(
                (
                    _way(f"maze, against {kind}", "ablation/maze/k-{schedule}/200", f"{_LONG}/{kind}")
                    for kind in PAPER_REGULARISERS
                ),
                "k = 200",
            ),
            *(
                _greater(
                    f"hand-overs, against {kind}, annealed{how}",
                    "walker/interleaved",
                    f"ablation/annealed/{kind}",
                    metric,
                    0.05,
                    decides=False,
                )
                for metric, how in _HANDING_OVER
                for kind in PAPER_REGULARISERS
            ),
            *(
                _greater(
                    f"maze, against {kind}, annealed{how}",
                    "maze/{schedule}/interleaved",
                    f"ablation/maze/{{schedule}}-annealed/{kind}",
                    metric,
                    0.05,
                    decides=False,
                )
                for kind in PAPER_REGULARISERS
                for metric, how in (("way", ""), *((metric, f", {words}") for metric, words in _SHORT.items()))
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
    """Every row that a claim reads, in the order of the table; ablations, which are shown only, aside."""
    everything = tuple(prefixes)
    read = {
        setting.fill(row)
        for claim in CLAIMS
        for setting in settings_of(claim, everything)
        for c in claim.contrasts
        if not c.afterwards
        for row in c.rows
    }
    order = {name: i for i, name in enumerate(MAIN)}
    mine = (name for name in read if is_row(name) and "ablation" not in name.split("/"))  # those have fewer seeds
    return sorted(mine, key=lambda name: (order.get(name, len(order)), name))


__all__ = [
    "CLAIMS",
    "MIN_SEEDS",
    "PAPER_REGULARISERS",
    "Claim",
    "Contrast",
    "Rule",
    "Setting",
    "Verdict",
    "rows_read",
    "settings_of",
]
