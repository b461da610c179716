"""Numbers that every seed of a row has, read from the files of its run: what claims compare and figures plot."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from footwork.arena import DIRECTIONS, Arena, DistanceField, Point, geodesic_field
from footwork.evaluate import IDLE_SPEED
from footwork.statistics import Effect, Floats
from footwork.study.measure import EVALUATION, TRANSITIONS, straight_line_stop
from footwork.study.training_curves import mean_between

if TYPE_CHECKING:  # that module asks this one for scores
    from footwork.study.results import Results, Sample

LATE = (0.9, 1.0)  # shares of the training between which a return is called final
HALFWAY = (0.4, 0.5)
_RETURN = "reward per episode"
SWITCHED_EVERY = 50  # control steps, as a master of k = 50 may do


@dataclass(frozen=True)
class Metric:
    """A number that every seed of a row has.

    Args:
        words: what it is, for tables and axes.
        of: reads it; None where the files do not have it.
        unit: behind the number; "%" where the number is a share, of which 1 is the most.
    """

    words: str
    of: Callable[[Results, Sample], Any]
    unit: str = "%"

    @property
    def is_share(self) -> bool:
        """Whether it lies between 0 and 1, and is shown in per cent."""
        return self.unit == "%"

    def show(self, value: float) -> str:
        """The value as text, with its unit."""
        return f"{self.number(value)} {self.unit}"

    def number(self, value: float) -> str:
        """The value as text, without."""
        if self.is_share:
            return f"{100 * value:.1f}"
        return f"{value:.2f}" if abs(value) < 10 else f"{value:.4g}"

    def with_interval(self, effect: Effect, alone: bool = False) -> str:
        """The estimate with its interval, without a unit; a lone seed has no interval."""
        interval = "" if alone else f" [{self.number(effect.low)}, {self.number(effect.high)}]"
        return self.number(effect.estimate) + interval

    @property
    def difference(self) -> str:
        """The unit of a difference."""
        return "points" if self.is_share else self.unit


def _return(between: tuple[float, float], results: Results, sample: Sample) -> Floats | None:
    """Of each direction, over the episodes that ended between two shares of the training [R]."""
    curve = results.curve(sample)
    if curve is None:  # and it was said why
        return None
    returns = mean_between(curve, "return", *between)
    if np.isnan(returns).any():
        results.problems[f"{sample.run.path}: no episode ended in {between[0]:.0%} to {between[1]:.0%} of training"] = (
            None
        )
        return None
    return returns


def _mean_return(between: tuple[float, float], results: Results, sample: Sample) -> float | None:
    returns = _return(between, results, sample)
    return None if returns is None else float(returns.mean())


def _evaluated(name: str, results: Results, sample: Sample) -> Any:
    entry = results.entry(sample, EVALUATION)
    return None if entry is None else entry.get(name)


def _success(radius: float, results: Results, sample: Sample) -> float | None:
    """Share of the episodes in which the ant comes so near to the goal."""
    by_radius = _evaluated("success", results, sample)
    return None if by_radius is None else by_radius[str(radius)]


def _speed(results: Results, sample: Sample) -> float | None:
    entry = results.entry(sample, EVALUATION)
    return None if entry is None else float(np.mean([entry["speed_mps"][name] for name in DIRECTIONS]))


def _handover(name: str, results: Results, sample: Sample) -> float | None:
    """Mean between orthogonal directions: the eight of the sixteen pairs that are a quarter turn apart."""
    entry = results.entry(sample, TRANSITIONS)
    if entry is None:
        return None
    pairs = [(i, (i + turn) % 4) for i in range(4) for turn in (1, 3)]
    return float(np.mean([entry["handover"][i][j][name] for i, j in pairs]))


def _fluctuation(results: Results, sample: Sample) -> Any:
    """Of each direction's training return about its own course, in the second half of training [R].

    Half the mean square of the differences between neighbouring bins is their variance, wherever the course goes
    (von Neumann 1941).
    """
    curve = results.curve(sample)
    if curve is None:
        return None
    returns = curve.values["return"]
    with warnings.catch_warnings():  # a direction of which no episode ended in two bins on end
        warnings.simplefilter("ignore", RuntimeWarning)
        found = np.sqrt(np.nanmean(np.diff(returns[len(returns) // 2 :], axis=0) ** 2, axis=0) / 2)
    return None if np.isnan(found).any() else found


@cache
def _way_around(arena: Arena) -> DistanceField:
    return geodesic_field(arena)


def _route(results: Results, sample: Sample) -> float | None:
    """As ``way``, along the shortest way around the walls: on AntMaze a straight line leads into one."""
    arena, entry = sample.experiment.task.arena, results.entry(sample, EVALUATION)
    if entry is None or len(arena.goals) != 1:
        return None
    field = _way_around(arena)
    left = np.mean(field.at(np.array(entry["ends"], np.float64)))
    return float(1.0 - left / field.at(np.array(arena.start)))


def _ended_within(radius: float, place: Callable[[Arena], Point | None], results: Results, sample: Sample) -> Any:
    """Share of the episodes that ended so near to a place."""
    entry, where = results.entry(sample, EVALUATION), place(sample.experiment.task.arena)
    if entry is None or where is None:
        return None
    return float(np.mean(np.hypot(*(np.array(entry["ends"], np.float64) - np.array(where)).T) <= radius))


def _switched(name: str, results: Results, sample: Sample) -> float | None:
    """A share under random switching, of options or, in the end, of ants."""
    entry = results.entry(sample, TRANSITIONS)
    found = None if entry is None else entry["switching"].get(str(SWITCHED_EVERY))
    return None if found is None else float(found[name])


def _moving(results: Results, sample: Sample) -> float | None:
    """Options of random switching that are not idle."""
    idle = _switched("idle", results, sample)
    return None if idle is None else 1.0 - idle


def _transitions(results: Results, sample: Sample) -> float | None:
    """How often a master changes from one sub-policy to another in an episode, mean over those whose paths are kept."""
    entry = results.entry(sample, EVALUATION)
    if entry is None or not sample.experiment.is_master:
        return None
    return float(np.mean([np.count_nonzero(np.diff(path["choices"])) for path in entry["paths"]]))


METRICS: dict[str, Metric] = {
    "way": Metric("share of the straight-line way to the goal", partial(_evaluated, "way")),
    "success": Metric("episodes that come within 1 m of the goal", partial(_success, 1.0)),
    "success close": Metric("episodes that come within 0.5 m of the goal", partial(_success, 0.5)),
    "route": Metric("share of the shortest way around the walls", _route),
    "stuck": Metric("episodes that end where the straight line meets the wall", partial(_evaluated, "stuck")),
    "stuck close": Metric("episodes that end within 0.5 m of there", partial(_ended_within, 0.5, straight_line_stop)),
    "at the start": Metric(
        "episodes that end within 0.5 m of the start", partial(_ended_within, 0.5, lambda arena: arena.start)
    ),
    "turned over": Metric("episodes in which the ant turns over", partial(_evaluated, "flip_rate")),
    "return": Metric("training return, last tenth of training", partial(_mean_return, LATE), _RETURN),
    "return by direction": Metric(
        "training return of each direction, last tenth of training", partial(_return, LATE), _RETURN
    ),
    "return halfway": Metric(
        "training return, the tenth before half of the training", partial(_mean_return, HALFWAY), _RETURN
    ),
    "return by direction halfway": Metric(
        "training return of each direction, the tenth before half of the training", partial(_return, HALFWAY), _RETURN
    ),
    "fluctuation": Metric(
        "training return's deviation from one hundredth of training to the next", _fluctuation, _RETURN
    ),
    "handover": Metric("orthogonal hand-overs that succeed", partial(_handover, "success")),
    "handover speed": Metric(
        "speed along the new direction after orthogonal hand-overs", partial(_handover, "speed_mps"), "m/s"
    ),
    "moving": Metric(
        f"options that gain {IDLE_SPEED} m/s or more along their direction, switched at random every {SWITCHED_EVERY} "
        "control steps",
        _moving,
    ),
    "idle": Metric(
        f"options that gain less than {IDLE_SPEED} m/s along their direction, switched at random every "
        f"{SWITCHED_EVERY} control steps",
        partial(_switched, "idle"),
    ),
    "upside down": Metric(
        f"ants upside down after random switching every {SWITCHED_EVERY} control steps",
        partial(_switched, "upside_down"),
    ),
    "transitions": Metric("changes of sub-policy", _transitions, "per episode"),
    "speed": Metric("speed along the direction", _speed, "m/s"),
}


__all__ = ["METRICS", "SWITCHED_EVERY", "Metric"]
