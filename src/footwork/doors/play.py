"""``footwork play``: a page on this machine where a person watches a master, is the master, and lets one learn.

One thread per visitor: it hears what the visitor wants, steps the visitor's own ants in real
time and tells the page of them. Visitors share nothing but the processor, so there are seats
for few; who comes later waits for one.
"""

from __future__ import annotations

import errno
import json
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from footwork.arena import CLEARANCE, DIRECTIONS, MAZES, Arena, inside_walls, maze
from footwork.doors.live import Ant, Lesson, Master, Planner
from footwork.doors.replay import arena_extent, find_policies, page
from footwork.physics.skeleton import skeleton
from footwork.study.experiments import WALKERS, find_row
from footwork.study.palette import DIRECTION_COLOURS, FLAT_COLOUR
from footwork.study.runs import find_needed, find_trained, finished_runs, packaged
from footwork.train import Experiment, Trained

try:
    from websockets.datastructures import Headers
    from websockets.exceptions import ConnectionClosed
    from websockets.http11 import Request, Response
    from websockets.sync.server import Server, ServerConnection, serve
except ImportError as error:
    raise ImportError("the page needs websockets: pip install 'footwork[play]'") from error

FRAMES_PER_SECOND = 30
SQUARE = "square"  # the open field with a goal at a corner: the bandit's
MAX_CELLS = 13  # of a drawn maze, each way
LESSON_STEPS = 1_000_000  # control steps
_LESSON_PERIOD = 0.5  # s between reports of a lesson
_WAIT = 1.0  # s between looks for a free seat
_PACES = (0.25, 4.0)
_LOCAL = ("127.0.0.1", "localhost", "::1")


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
    taken: list[str] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)


class Visit:
    """One visitor's ants, leader, maze and lesson.

    Args:
        house: what is shared.
        tell: sends the page a message.
    """

    def __init__(self, house: House, tell: Callable[[dict[str, Any]], None]):
        self.house, self.tell = house, tell
        trained = find_policies(house.row, house.runs)
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
        self.lesson_arena: Arena | None = None
        self.lesson_leads = False  # once it can
        self.ants: list[Ant] = []
        self.masters: list[Master | None] = []
        self._planner: tuple[tuple[float, float], Planner] | None = None
        self._recent: list[tuple[float, int]] = []
        self._reported = 0.0
        self._behind = 0.0
        self.build()

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
        planner = Planner.to(self.arena, place)  # refuses what cannot be reached
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
        known = [*known_walkers(self.house.runs), self._given[1].experiment.name]
        if not isinstance(rows, list) or not 1 <= len(rows) <= 2 or any(row not in known for row in rows):
            raise ValueError(f"choose one or two of {', '.join(known)}; got {rows!r}")
        self.rows = list(rows)
        self.build()

    def do_arena(self, name: str) -> None:
        """Another maze with a name, or the open square."""
        if name == SQUARE:
            arena = find_row("bandit/hrl/plain").task.arena
        elif name in MAZES:
            arena = MAZES[name]
        else:
            raise ValueError(f"no maze {name!r}; there are {', '.join((SQUARE, *MAZES))}")
        self.enter(arena)

    def do_maze(self, rows: Any) -> None:
        """A maze that was drawn; it is checked as every maze is."""
        if not isinstance(rows, list) or not all(isinstance(row, str) for row in rows):
            raise ValueError("a drawn maze is a list of rows of # . r g")
        if max([len(rows), *map(len, rows)]) > MAX_CELLS:
            raise ValueError(f"a drawn maze has at most {MAX_CELLS} cells each way")
        self.enter(maze(rows, name="drawn"), drawn=True)

    def do_train(self) -> None:
        """Let a master learn this place, from nothing, on the first sub-policies."""
        if self.lesson is not None and self.lesson.running:
            raise ValueError("a lesson is going on already")
        if self.arena.name == find_row("bandit/hrl/plain").task.arena.name:
            raise ValueError("lessons are given in mazes: choose one, or draw one")
        self.say("a master begins to learn; compiling takes a few seconds")
        arena = replace(self.arena, goals=(self.goal(),))
        row = self.master_row()
        experiment = replace(row, task=replace(row.task, arena=arena), total_steps=self.house.lesson_steps)
        self.lesson, self.lesson_arena = Lesson(experiment, self.find_sub_policies(self.rows[0])), self.arena
        self.lesson_leads, self._reported = True, 0.0
        self.tell({"is": "lesson", "fresh": True, **self.lesson.report()})

    def do_stop(self) -> None:
        """End the lesson; what was learned stays."""
        if self.lesson is not None:
            self.lesson.stop()

    # What there is ---------------------------------------------------------------------------------------------

    def say(self, text: str, bad: bool = False, stays: bool = False) -> None:
        """A line on the page."""
        self.tell({"is": "word", "text": text, "bad": bad, "stays": stays})

    def goal(self) -> tuple[float, float]:
        """Where it is now, m."""
        if not self.ants:
            return self.arena.goals[0]
        x, y = self.ants[0].goal
        return float(x), float(y)

    def master_row(self) -> Experiment:
        """The row of masters for this kind of place and the first sub-policies."""
        if self.rows[0] == self.first.needs and self.first.task.observe_goal == self.on_square():
            return self.first
        place = "bandit" if self.on_square() else "maze"
        return find_row(f"{place}/hrl/{self.rows[0].removeprefix('walker/')}")

    def on_square(self) -> bool:
        """Whether this is the bandit's open field."""
        return not self.arena.grid

    def leaders(self) -> list[str]:
        """Who can lead here and now."""
        found = ["you", "planner"]
        if any(self.masters):
            found.append("trained")
        if self.lesson is not None and self.lesson_arena == self.arena and self.lesson.params is not None:
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
        name = f"{'bandit' if self.on_square() else 'maze'}/hrl/{row.removeprefix('walker/')}"
        try:
            trained = find_trained(name, self.house.runs)
        except ValueError:
            return None
        return Master.of(trained) if trained.experiment.task.arena == self.arena else None

    def enter(self, arena: Arena, drawn: bool = False) -> None:
        """Go to another place."""
        if self.lesson is not None:
            self.lesson.stop()
        self.arena, self.drawn = arena, drawn
        self._planner = None
        self.ants = []
        self.build()

    def build(self) -> None:
        """The ants anew, after their place or their sub-policies changed."""
        self.say("preparing the ants …", stays=True)
        task = replace(self.master_row().task, arena=self.arena)
        steps = self.master_row().option_steps
        goal = self.goal()
        self.ants = [Ant(self.find_sub_policies(row), task, steps, seed) for seed, row in enumerate(self.rows)]
        self.masters = [self.find_master(row) for row in self.rows]
        if goal in self.arena.goals and not self.on_square():
            goal = self.arena.goals[0]
        self.do_goal_quietly(goal)
        if self.who not in self.leaders():
            self.who = "planner"
        if self.who == "planner" and any(self.masters) and goal in self.arena.goals:
            self.who = "trained"
        for ant, leader in zip(self.ants, self.current_leaders(), strict=True):
            ant.step(leader)  # compiles
        self.tell(self.scene())

    def do_goal_quietly(self, goal: tuple[float, float]) -> None:
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
        self._behind = min(self._behind + (0.0 if self.paused else seconds * self.pace), 3 * self.pace / 30)
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
        report = self.lesson.report()
        self.tell({"is": "lesson", "fresh": False, **report})
        self._reported = time.monotonic() if report["running"] else np.inf

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
            "extent": arena_extent(arena),
            "ants": self.rows,
            "drawn": self.drawn,
        }

    def hear(self, text: str | bytes) -> None:
        """Do what a message asks for; what cannot be done is said."""
        try:
            message = json.loads(text)
            name = message.pop("do")
            action = getattr(self, f"do_{name}", None) if isinstance(name, str) else None
            if action is None or name not in ACTIONS:
                raise ValueError(f"the page asked for something unknown: {name!r}")
            action(**message)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            self.say(str(error), bad=True)

    def leave(self) -> None:
        """End what goes on in the background."""
        if self.lesson is not None:
            self.lesson.stop()
            self.lesson.join(10.0)


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


def known_walkers(runs: Path) -> list[str]:
    """Walker rows with trained policies."""
    return [row.name for row in WALKERS if packaged(row.name).is_file() or finished_runs(row.name, runs)]


def attend(house: House, connection: ServerConnection) -> None:
    """A visitor's thread, from coming to going."""
    name = f"{connection.remote_address}"
    tell: Callable[[dict[str, Any]], None] = lambda message: connection.send(json.dumps(message))  # noqa: E731
    visit: Visit | None = None
    try:
        _take_seat(house, name, tell)
        visit = Visit(house, tell)
        _keep_company(house, visit, connection)
    except ConnectionClosed:
        pass  # they went away; the server stays
    except Exception as error:
        tell({"is": "word", "text": f"the visit ended: {error}", "bad": True, "stays": True})
        raise
    finally:
        if visit is not None:
            visit.leave()
        with house.lock:
            if name in house.taken:
                house.taken.remove(name)


def _take_seat(house: House, name: str, tell: Callable[[dict[str, Any]], None]) -> None:
    told = -1
    while not house.closing.is_set():
        with house.lock:
            if len(house.taken) < house.seats:
                house.taken.append(name)
                return
        told = (told + 1) % 5
        if told == 0:  # again now and then, which also notices who has left
            text = f"{house.seats} {'visitor is' if house.seats == 1 else 'visitors are'} here already; you are next"
            tell({"is": "word", "text": text, "bad": False, "stays": True})
        time.sleep(_WAIT)


def _keep_company(house: House, visit: Visit, connection: ServerConnection) -> None:
    last = time.monotonic()
    while not house.closing.is_set():
        _hear_all(visit, connection)
        now = time.monotonic()
        visit.step(now - last)
        last = now
        visit.tell(visit.frame())
        visit.report_lesson()
        left = last + 1 / FRAMES_PER_SECOND - time.monotonic()
        if left > 0:
            time.sleep(left)


def _hear_all(visit: Visit, connection: ServerConnection) -> None:
    while True:
        try:
            text = connection.recv(timeout=0)
        except TimeoutError:
            return
        visit.hear(text)


def _answer(text: bytes, hosts: tuple[str, ...], request: Request) -> Response | None:
    """The page, or None for the page's own socket. Other sites' pages may not talk to it."""
    host = request.headers.get("Host", "")
    if hosts and urlsplit(f"//{host}").hostname not in hosts:
        return _response(HTTPStatus.FORBIDDEN, b"this page is for this machine\n", "text/plain")
    if request.path == "/ants":
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return _response(HTTPStatus.FORBIDDEN, b"from this page only\n", "text/plain")
        return None
    if request.path == "/":
        return _response(HTTPStatus.OK, text, "text/html; charset=utf-8")
    return _response(HTTPStatus.NOT_FOUND, b"there is one page: /\n", "text/plain")


def _response(status: HTTPStatus, body: bytes, kind: str) -> Response:
    headers = Headers({"Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-store"})
    return Response(status.value, status.phrase, headers, body)


def world(house: House) -> dict[str, Any]:
    """What the page must know before the first scene."""
    trained = find_policies(house.row, house.runs)
    walkers = known_walkers(house.runs)
    if trained.experiment.needs and trained.experiment.needs not in walkers:
        walkers.append(trained.experiment.needs)
    return {
        "skeleton": skeleton(trained.experiment.task.robot),
        "directions": DIRECTIONS,
        "colours": DIRECTION_COLOURS,
        "flat_colour": FLAT_COLOUR,
        "sub_policies": walkers,
        "arenas": [*MAZES, SQUARE],
    }


def open_server(house: House, host: str = "127.0.0.1", port: int = 8765) -> Server:
    """A server that listens; ``serve_forever`` serves.

    Raises:
        ValueError: the port is taken, or host and port cannot be listened on.
    """
    text = page(
        "live.html", "Footwork", ("style.css", "live.css"), ("scene.js", "live.js"), json.dumps(world(house))
    ).encode()
    hosts = _LOCAL if host in _LOCAL else ()
    try:
        return serve(
            lambda connection: attend(house, connection),
            host,
            port,
            process_request=lambda connection, request: _answer(text, hosts, request),
            max_size=64 * 1024,
            compression=None,
        )
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ValueError(f"port {port} of {host} is in use: choose another with --port") from None
        raise ValueError(f"cannot listen on {host}, port {port}: {error.strerror or error}") from None
    except OverflowError:
        raise ValueError(f"port must be in 0..65535, got {port}") from None


def play(row: str, runs: Path, host: str, port: int, seats: int, lesson_steps: int = LESSON_STEPS) -> None:
    """Serve the page until interrupted.

    Raises:
        ValueError: the row is no master, there is no seat, or the port is taken.
    """
    if seats < 1:
        raise ValueError(f"seats must be >= 1, got {seats}")
    trained = find_policies(row, runs)
    if not trained.experiment.is_master:
        raise ValueError(f"play shows masters (maze/hrl/..., bandit/hrl/...), not {trained.experiment.name}")
    house = House(runs, row, seats, lesson_steps)
    server = open_server(house, host, port)
    old = [(number, signal.signal(number, signal.default_int_handler)) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        address = server.socket.getsockname()
        print(f"http://{address[0]}:{address[1]}/   (Ctrl-C ends it)", flush=True)
        server.serve_forever()
    except KeyboardInterrupt:
        print("closing")
    finally:
        house.closing.set()  # visitors' threads end at their next picture
        server.shutdown()
        for number, handler in old:
            signal.signal(number, handler)


__all__ = ["House", "Visit", "attend", "open_server", "play", "world"]
