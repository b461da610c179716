"""One visitor of ``footwork play``: ants, who leads them, a maze, a lesson, and what the visitor may do to them."""

from __future__ import annotations

import inspect
import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from footwork.arena import CLEARANCE, DIRECTIONS, MAZES, Arena, Point, extent_of, inside_walls, maze
from footwork.doors.live import Ant, Lesson, Master, Planner
from footwork.physics import DEFAULT_ENGINE
from footwork.study.experiments import WALKERS, find_row, with_engine
from footwork.study.runs import find_needed, find_trained, finished_runs, packaged
from footwork.train import Experiment, Trained

SQUARE = "square"  # the open field with a goal at a corner: the bandit's
MAX_CELLS = 13  # of a drawn maze, each way
LESSON_STEPS = 1_000_000  # control steps
FRAMES_PER_SECOND = 1 / 0.033  # two control steps each
KEPT_SECONDS = 10.0  # that a visitor may be away before somebody who waits gets the seat
_LESSON_PERIOD = 0.5  # s between reports of a lesson
_FARTHEST = 200.0  # m, of a goal
_PACES = (0.25, 4.0)


@dataclass(eq=False)
class Seat:
    """A visitor's place in the house, kept while the visitor is away and nobody else wants it.

    Args:
        token: by which the visitor's page finds it again.
        connection: of the page that shows the visit; None while no page does.
        visit: once it has begun.
        left_at: when the last page went, on the monotonic clock, s.
    """

    token: str
    connection: object | None
    visit: Visit | None = None
    left_at: float = 0.0
    here: threading.Lock = field(default_factory=threading.Lock)  # held by the thread that steps the visit


@dataclass(frozen=True)
class House:
    """What all visitors share.

    Args:
        runs: where runs are kept.
        row: the master that a visitor meets first.
        seats: visitors at once.
        lesson_steps: control steps of a lesson.
    """

    runs: Path
    row: str
    seats: int = 2
    lesson_steps: int = LESSON_STEPS
    closing: threading.Event = field(default_factory=threading.Event)
    taken: list[Seat] = field(default_factory=list)
    waiting: list[object] = field(default_factory=list)  # connections, in the order in which they came
    lock: threading.Lock = field(default_factory=threading.Lock)

    def sit(self, token: str, connection: object) -> tuple[Seat | None, int]:
        """Take a seat: one's own of before, or a free one when it is one's turn.

        Returns:
            The seat; or None, and how many wait before this visitor.
        """
        with self.lock:
            seat = next((seat for seat in self.taken if seat.token == token), None)
            if seat is not None:
                seat.connection = connection  # a page that still shows it lets go
                if connection in self.waiting:
                    self.waiting.remove(connection)
                return seat, 0
            if connection not in self.waiting:
                self.waiting.append(connection)
            before = self.waiting.index(connection)
            abandoned = None if len(self.taken) < self.seats else self._abandoned()
            if before > 0 or (len(self.taken) >= self.seats and abandoned is None):
                return None, before
            seat = Seat(token, connection)
            if abandoned is not None:
                self.taken.remove(abandoned)  # from now on its owner is a visitor like any other
            self.taken.append(seat)
            self.waiting.remove(connection)
        if abandoned is not None and abandoned.visit is not None:
            abandoned.visit.leave()
        return seat, 0

    def _abandoned(self) -> Seat | None:
        """The seat of the one who is away for the longest time, if that is long enough to lose it."""
        away = [seat for seat in self.taken if seat.connection is None]
        seat = min(away, key=lambda seat: seat.left_at, default=None)
        return None if seat is None or time.monotonic() - seat.left_at < KEPT_SECONDS else seat

    def leave_seat(self, seat: Seat, connection: object) -> None:
        """Go away from a seat, unless another page has it by now; it is kept for a while."""
        with self.lock:
            if seat.connection is connection:
                seat.connection, seat.left_at = None, time.monotonic()

    def stand_up(self, connection: object) -> None:
        """Wait no more."""
        with self.lock:
            if connection in self.waiting:
                self.waiting.remove(connection)

    def dismiss(self, seat: Seat) -> None:
        """End a visit and free its seat."""
        with self.lock:
            if seat in self.taken:
                self.taken.remove(seat)
        if seat.visit is not None:
            seat.visit.leave()

    def stop_lessons(self) -> int:
        """Ask all lessons to end; how many were going on."""
        visits = [seat.visit for seat in list(self.taken) if seat.visit is not None]
        going_on = [visit for visit in visits if visit.lesson is not None and visit.lesson.running]
        for visit in going_on:
            visit.do_stop()
        return len(going_on)

    def empty(self) -> None:
        """End all visits, those whose pages are gone too."""
        self.stop_lessons()
        for seat in list(self.taken):
            self.dismiss(seat)


class Visit:
    """One visitor's ants, leader, maze and lesson.

    Args:
        house: what is shared.
        tell: sends the page a message.
    """

    def __init__(self, house: House, tell: Callable[[dict[str, Any]], None]):
        self.house, self.tell = house, tell
        trained = find_trained(house.row, house.runs)
        self.first = trained.experiment
        needed = find_needed(trained, house.runs)
        if needed is None:
            raise ValueError(f"play shows masters (maze/hrl/..., bandit/hrl/...), not {trained.experiment.name}")
        self._given = (trained, needed)
        self.rows = [needed.experiment.name]
        self.arena = self.first.task.arena
        self.drawn = False
        self.who, self.held = "trained", 0
        self.pace, self.paused = 1.0, False
        self.lesson: Lesson | None = None
        self.lesson_place: tuple[Arena, str] | None = None  # where it learns, and on which sub-policies
        self.lesson_leads = False  # once it can
        self.ants: list[Ant] = []
        self.masters: list[Master | None] = []
        self._planner: tuple[Point, Planner] | None = None
        self._recent: list[tuple[float, int]] = []
        self._reported = 0.0
        self._behind = 0.0
        try:
            self.build(self.arena.goals[0])
        except Exception:
            self.leave()
            raise

    # What the visitor may do: one method per message ``{"do": name, ...}`` ------------------------------------

    def do_lead(self, who: str) -> None:
        """Choose who leads."""
        if who not in self.leaders():
            raise ValueError(f"nobody of that name can lead here: {who!r}; there are {', '.join(self.leaders())}")
        self.who, self.lesson_leads = who, False

    def do_steer(self, direction: int) -> None:
        """Be the master."""
        if direction not in range(len(DIRECTIONS)):
            raise ValueError(f"direction must be 0..3, got {direction!r}")
        self.who, self.held, self.lesson_leads = "you", int(direction), False

    def do_goal(self, at: Any) -> None:
        """Move the goal."""
        goal = np.array(at, np.float64)
        if goal.shape != (2,) or not np.isfinite(goal).all():
            raise ValueError(f"a goal is a point (x, y) in m, got {at!r}")
        if inside_walls(self.arena, goal, CLEARANCE):
            raise ValueError("a goal must keep 0.4 m from every wall")
        place = (float(goal[0]), float(goal[1]))
        if np.abs(goal).max() > _FARTHEST:
            raise ValueError(f"a goal is at most {_FARTHEST:.0f} m away")
        try:
            planner = Planner.to(self.arena, place)
        except ValueError:
            raise ValueError("no way leads to this goal") from None
        self._planner = (place, planner)
        for ant in self.ants:
            ant.move_goal(goal)
        if self.who in ("trained", "lesson") and not self.ants[0].task.observe_goal:
            self.who = "planner"
            self.say("this master learned one goal and does not see the new one: the shortest way leads now")

    def do_push(self, angle: float) -> None:
        """Push every ant."""
        if not np.isfinite(float(angle)):
            raise ValueError(f"angle must be finite, got {angle!r}")
        for ant in self.ants:
            ant.push(float(angle))

    def do_restart(self) -> None:
        """Begin anew."""
        for ant in self.ants:
            ant.restart()

    def do_pause(self, on: bool) -> None:
        """Stop, go on."""
        self.paused = bool(on)

    def do_pace(self, pace: float) -> None:
        """Seconds of the ant per second."""
        low, high = _PACES
        if not low <= float(pace) <= high:
            raise ValueError(f"pace must be in {low}..{high}, got {pace!r}")
        self.pace = float(pace)

    def do_sub_policies(self, rows: Any) -> None:
        """One or two kinds of sub-policies, side by side."""
        known = list(
            dict.fromkeys((*known_walkers(self.house.runs, self.first.engine), self._given[1].experiment.name))
        )
        if not isinstance(rows, list) or not 1 <= len(rows) <= 2 or any(row not in known for row in rows):
            raise ValueError(f"choose one or two of {', '.join(known)}; got {rows!r}")
        self.move_to(rows=list(rows))

    def do_arena(self, name: str) -> None:
        """Another maze with a name, or the open square."""
        if name == SQUARE:
            arena = find_row("bandit/hrl/plain").task.arena
        elif name in MAZES:
            arena = MAZES[name]
        else:
            raise ValueError(f"no maze {name!r}; there are {', '.join((SQUARE, *MAZES))}")
        self.move_to(arena=arena, drawn=False)

    def do_maze(self, rows: Any) -> None:
        """A maze that was drawn; it is checked as every maze is."""
        if not isinstance(rows, list) or not all(isinstance(row, str) for row in rows):
            raise ValueError("a drawn maze is a list of rows of # . r g")
        if max([len(rows), *map(len, rows)]) > MAX_CELLS:
            raise ValueError(f"a drawn maze has at most {MAX_CELLS} cells each way")
        self.move_to(arena=maze(rows, name="drawn"), drawn=True)

    def do_train(self) -> None:
        """Let a master learn this place, from nothing, on the first sub-policies."""
        if self.lesson is not None and self.lesson.running:
            raise ValueError("a lesson is going on already")
        if self.on_square():
            raise ValueError("lessons are given in mazes: choose one, or draw one")
        self.say("a master begins to learn; compiling takes a few seconds")
        arena = replace(self.arena, goals=(self.goal(),))
        row = self.master_row()
        experiment = replace(row, task=replace(row.task, arena=arena), total_steps=self.house.lesson_steps)
        self.lesson = Lesson(experiment, self.find_sub_policies(self.rows[0]))
        self.lesson_place = (self.arena, self.rows[0])
        self.lesson_leads, self._reported = True, 0.0
        self._report_lesson(fresh=True)

    def do_stop(self) -> None:
        """End the lesson; what was learned stays."""
        if self.lesson is not None:
            self.lesson.stop()

    # What there is ---------------------------------------------------------------------------------------------

    def say(self, text: str, bad: bool = False, stays: bool = False) -> None:
        """A line on the page."""
        self.tell({"is": "word", "text": text, "bad": bad, "stays": stays})

    def goal(self) -> Point:
        """Where it is now, m."""
        if not self.ants:
            return self.arena.goals[0]
        x, y = self.ants[0].goal
        return float(x), float(y)

    def master_row(self) -> Experiment:
        """The row of masters for this kind of place and the first sub-policies."""
        if self.rows[0] == self.first.needs and self.first.task.observe_goal == self.on_square():
            return self.first
        return self._master_row_of(self.rows[0])

    def _master_row_of(self, walkers: str) -> Experiment:
        """The row of masters that choose among these sub-policies in this kind of place, on the visit's engine."""
        place, kind = "bandit" if self.on_square() else "maze", walkers.rpartition("walker/")[2]
        return with_engine(find_row(f"{place}/hrl/{kind}"), self.first.engine)

    def on_square(self) -> bool:
        """Whether this is the bandit's open field."""
        return not self.arena.grid

    def leaders(self) -> list[str]:
        """Who can lead here and now."""
        found = ["you", "planner"]
        if any(self.masters):
            found.append("trained")
        here = self.lesson_place == (self.arena, self.rows[0])
        if self.lesson is not None and here and self.lesson.params is not None:
            found.append("lesson")
        return found

    def find_sub_policies(self, row: str) -> Trained:
        """Trained ones: those of the first master, or what the row's name means."""
        given = self._given[1]
        return given if row == given.experiment.name else find_trained(row, self.house.runs)

    def find_master(self, row: str) -> Master | None:
        """The trained master of these sub-policies for this very place, if there is one."""
        given, needed = self._given
        if row == needed.experiment.name and given.experiment.task.arena == self.arena:
            return Master.of(given)
        try:
            trained = find_trained(self._master_row_of(row).name, self.house.runs)
        except ValueError:
            return None
        return Master.of(trained) if trained.experiment.task.arena == self.arena else None

    def move_to(self, **changes: Any) -> None:
        """Change the place (``arena``, ``drawn``) or the sub-policies (``rows``); if that fails, all stays as it is."""
        kept = ("rows", "arena", "drawn", "ants", "masters", "who", "_planner")
        before, goal = {name: getattr(self, name) for name in kept}, self.goal()
        vars(self).update(changes)
        try:
            self.build(goal if self.arena == before["arena"] else self.arena.goals[0])
        except Exception:
            for ant in self.ants:
                if ant not in before["ants"]:
                    ant.close()
            vars(self).update(before)
            self.tell(self.scene())
            raise
        for ant in before["ants"]:
            ant.close()
        if self.lesson is not None and self.arena != before["arena"]:
            self.lesson.stop()

    def build(self, goal: Point) -> None:
        """New ants for the place and the sub-policies that there are now; the old ones are left to the caller."""
        self.say("preparing the ants …", stays=True)
        row = self.master_row()
        task = replace(row.task, arena=self.arena)
        self.ants = []
        for seed, name in enumerate(self.rows):
            self.ants.append(Ant(self.find_sub_policies(name), task, row.option_steps, seed, self.first.engine))
        self.masters = [self.find_master(name) for name in self.rows]
        self._put_goal(goal)
        if self.who not in self.leaders():
            self.who = "planner"
        if self.who == "planner" and any(self.masters) and goal in self.arena.goals:
            self.who = "trained"
        for ant, leader in zip(self.ants, self.current_leaders(), strict=True):
            ant.step(leader)  # compiles
        self.tell(self.scene())

    def _put_goal(self, goal: Point) -> None:
        """All ants with one goal, and the way there."""
        self._planner = (goal, Planner.to(self.arena, goal))
        for ant in self.ants:
            ant.move_goal(np.array(goal))

    def current_leaders(self) -> list[Master | Planner | int]:
        """Of each ant. An ant without a master of its own is led along the shortest way."""
        assert self._planner is not None
        planner = self._planner[1]
        if self.who == "you":
            return [self.held] * len(self.ants)
        if self.who == "trained":
            return [planner if master is None else master for master in self.masters]
        if self.who == "lesson" and self.lesson is not None:
            return [self.lesson.master() or planner] * len(self.ants)
        return [planner] * len(self.ants)

    # As time goes by -------------------------------------------------------------------------------------------

    def step(self, seconds: float) -> None:
        """Let ``seconds`` go by; when the machine cannot keep up, the ant is slower, not the page."""
        dt = self.ants[0].task.robot.control_dt
        self._behind = min(
            self._behind + (0.0 if self.paused else seconds * self.pace), 3 * self.pace / FRAMES_PER_SECOND
        )
        if self.lesson_leads and "lesson" in self.leaders():
            self.who, self.lesson_leads = "lesson", False
        steps = 0
        leaders = self.current_leaders()
        while self._behind >= dt:
            self._behind -= dt
            for ant, leader in zip(self.ants, leaders, strict=True):
                ant.step(leader)
                ant.begin_again(led=not isinstance(leader, int))
            steps += len(self.ants)
        now = time.monotonic()
        self._recent = [(at, n) for at, n in self._recent if at > now - 2.0] + [(now, steps)]

    def frame(self) -> dict[str, Any]:
        """What the page shows now."""
        span = max(time.monotonic() - self._recent[0][0], 0.1) if self._recent else 1.0
        return {
            "is": "frame",
            "ants": [ant.report() for ant in self.ants],
            "who": self.who,
            "leaders": self.leaders(),
            "paused": self.paused,
            "rate": round(sum(n for _, n in self._recent) / span, 1),
        }

    def report_lesson(self) -> None:
        """Twice a second, how the lesson goes."""
        if self.lesson is None or time.monotonic() - self._reported < _LESSON_PERIOD:
            return
        running = self._report_lesson(fresh=False)
        self._reported = time.monotonic() if running else np.inf

    def _report_lesson(self, fresh: bool) -> bool:
        """Tell of the lesson, from its beginning if the page knows nothing of it; tells whether it goes on."""
        assert self.lesson is not None
        report = self.lesson.report()
        if self.lesson_place is None or self.lesson_place[0] != self.arena:
            report["ways"] = []  # they were walked in another place
        curve = {"curve": self.lesson.curve()} if fresh else {}
        self.tell({"is": "lesson", "fresh": fresh, **curve, **report})
        return bool(report["running"])

    def welcome_back(self, tell: Callable[[dict[str, Any]], None]) -> None:
        """Show it all to a page that has been loaded again, or found back."""
        self.tell = tell
        self._behind, self._recent = 0.0, []
        self.tell(self.scene())
        if self.lesson is not None:
            self._reported = 0.0
            self._report_lesson(fresh=True)

    def scene(self) -> dict[str, Any]:
        """The place, for the page."""
        arena = self.arena
        return {
            "is": "scene",
            "name": SQUARE if self.on_square() else arena.name,
            "walls": [[wall.x, wall.y, wall.half_x, wall.half_y] for wall in arena.walls],
            "wall_height": arena.wall_height,
            "grid": list(arena.grid),
            "cell": arena.cell,
            "start": arena.start,
            "goal": self.goal(),
            "goal_radius": 0.5,
            "extent": list(extent_of(arena)),
            "ants": self.rows,
            "drawn": self.drawn,
        }

    def hear(self, text: str | bytes) -> None:
        """Do what a message asks for; what cannot be done is said, and changes nothing."""
        try:
            self._do(text)
        except (ValueError, OSError, OverflowError, RecursionError, RuntimeError, MemoryError) as error:
            self.say(str(error) or type(error).__name__, bad=True)

    def _do(self, text: str | bytes) -> None:
        message = json.loads(text)
        name = message.pop("do", None) if isinstance(message, dict) else None
        if not isinstance(name, str) or name not in ACTIONS:
            raise ValueError(f"the page asked for something unknown: {name!r}")
        action = getattr(self, f"do_{name}")
        try:
            inspect.signature(action).bind(**message)
            action(**message)
        except TypeError:  # of another kind than the action takes, or not the details that it takes
            raise ValueError(f"{name} cannot be done with {json.dumps(message)}") from None

    def leave(self) -> None:
        """End what goes on in the background."""
        if self.lesson is not None:
            self.lesson.stop()
            self.lesson.join(60.0)  # compiling is not interrupted
        for ant in self.ants:
            ant.close()


ACTIONS = (
    "lead",
    "steer",
    "goal",
    "push",
    "restart",
    "pause",
    "pace",
    "sub_policies",
    "arena",
    "maze",
    "train",
    "stop",
)


def known_walkers(runs: Path, engine: str = DEFAULT_ENGINE) -> list[str]:
    """Walker rows of an engine with trained policies."""
    names = [with_engine(row, engine).name for row in WALKERS]
    return [name for name in names if packaged(name).is_file() or finished_runs(name, runs)]
