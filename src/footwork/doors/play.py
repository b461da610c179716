"""``footwork play``: a page on this machine where a person watches a master, is the master, and lets one learn.

One thread per visitor: it hears what the visitor wants, steps the visitor's own ants in real
time and tells the page of them. Visitors share nothing but the processor, so there are seats
for few; who comes later waits for one. A page that is loaded again, or was cut off, finds its
visit as it was, its lesson too, unless somebody who waited has taken the seat.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import signal
import socket
import sys
import threading
import time
import traceback
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from footwork.arena import DIRECTIONS, MAZES
from footwork.doors.replay import page
from footwork.doors.visit import FRAMES_PER_SECOND, LESSON_STEPS, SQUARE, House, Seat, Visit, known_walkers
from footwork.palette import DIRECTION_COLOURS, FLAT_COLOUR
from footwork.physics.skeleton import skeleton
from footwork.study.runs import find_trained, which_policies

try:
    from websockets.datastructures import Headers
    from websockets.exceptions import ConnectionClosed
    from websockets.http11 import Request, Response
    from websockets.sync.server import Server, ServerConnection, serve
except ImportError as error:
    raise ImportError("the page needs websockets: pip install 'footwork[play]'") from error

_WAIT = 1.0  # s between looks for a free seat
_TELL_AGAIN = 5.0  # s between two words to somebody who waits
_TOKEN_LENGTH = 64
ELSEWHERE = 4001  # the code with which a page is closed whose visit another page goes on with; live.js knows it
_LOCAL = ("127.0.0.1", "localhost", "::1")


class _Line:
    """What goes to a page; once the page is gone, nowhere. So nothing that a visit does fails because nobody looks."""

    def __init__(self, connection: ServerConnection):
        self._connection = connection
        self.gone = False

    def __call__(self, message: dict[str, Any]) -> None:
        if self.gone:
            return
        try:
            self._connection.send(json.dumps(message))
        except ConnectionClosed:
            self.gone = True

    def word(self, text: str, bad: bool = False) -> None:
        """A line on the page that stays."""
        self({"is": "word", "text": text, "bad": bad, "stays": True})


def attend(house: House, connection: ServerConnection) -> None:
    """A visitor's thread, from coming to going."""
    line = _Line(connection)
    while (seat := _take_seat(house, _token_of(connection), connection, line)) is not None:
        try:
            if _sit(house, seat, connection, line):
                return
        finally:
            house.leave_seat(seat, connection)


def _sit(house: House, seat: Seat, connection: ServerConnection, line: _Line) -> bool:
    """The visit, from when the page has it to itself; False if the seat was lost while another page still had it."""
    while not seat.here.acquire(timeout=_WAIT):
        line.word("the visit is busy; one moment …")
        if house.closing.is_set() or line.gone:
            return True
    try:
        if seat not in house.taken:
            return False
        _receive(house, seat, line)
        _keep_company(house, seat, connection, line)
    except ConnectionClosed:
        pass  # they went away; the visit waits for them
    except Exception as error:
        house.dismiss(seat)
        line.word(f"the visit ended: {error}", bad=True)
        if isinstance(error, ValueError | OSError):
            print(f"footwork: a visit ended: {error}", file=sys.stderr)
        else:
            traceback.print_exc()
    finally:
        seat.here.release()
    return True


def _token_of(connection: ServerConnection) -> str:
    """What the page calls its visit, so that it finds it again; a page that says nothing has a visit of its own."""
    query = parse_qs(urlsplit(connection.request.path).query) if connection.request else {}
    return query.get("visit", [""])[0][:_TOKEN_LENGTH] or str(connection.id)


def _take_seat(house: House, token: str, connection: ServerConnection, line: _Line) -> Seat | None:
    """The seat of this token, or a free one, when it is this visitor's turn; None when the house closes, or they go."""
    told_at, told = -_TELL_AGAIN, ""
    try:
        while not house.closing.is_set() and not line.gone:
            seat, before = house.sit(token, connection)
            if seat is not None:
                return seat
            text = _please_wait(house.seats, before)
            if text != told or time.monotonic() - told_at >= _TELL_AGAIN:  # which also notices who has left
                line.word(text)
                told_at, told = time.monotonic(), text
            time.sleep(_WAIT)
    finally:
        house.stand_up(connection)
    return None


def _please_wait(seats: int, before: int) -> str:
    here = f"{seats} {'visitor is' if seats == 1 else 'visitors are'} here already"
    return f"{here}; {f'{before} more before you' if before else 'you are next'}"


def _receive(house: House, seat: Seat, line: _Line) -> None:
    """Begin a visit, or go on with the one that this page had before it was loaded again or cut off."""
    if seat.visit is None:
        seat.visit = Visit(house, line)
    else:
        seat.visit.welcome_back(line)


def _keep_company(house: House, seat: Seat, connection: ServerConnection, line: _Line) -> None:
    visit = seat.visit
    assert visit is not None
    last = due = time.monotonic()
    while not house.closing.is_set() and not line.gone and seat.connection is connection:
        _hear_all(visit, connection)
        now = time.monotonic()
        visit.step(now - last)
        last = now
        visit.tell(visit.frame())
        visit.report_lesson()
        due = max(due, now - 1 / FRAMES_PER_SECOND) + 1 / FRAMES_PER_SECOND  # a late picture is made up for by the next
        time.sleep(max(0.0, due - time.monotonic()))
    if seat.connection is not connection:
        line.word("this visit goes on in another window")
        connection.close(ELSEWHERE)


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
    if hosts and _name_of(host) not in hosts:
        return _response(HTTPStatus.FORBIDDEN, b"this page is for this machine\n", "text/plain")
    path = request.path.partition("?")[0]
    if path == "/ants":
        origin = request.headers.get("Origin")
        if origin is not None and origin.partition("://")[2] != host:
            return _response(HTTPStatus.FORBIDDEN, b"from this page only\n", "text/plain")
        return None
    if path == "/":
        return _response(HTTPStatus.OK, text, "text/html; charset=utf-8")
    return _response(HTTPStatus.NOT_FOUND, b"there is one page: /\n", "text/plain")


def _name_of(host: str) -> str | None:
    """A machine's name without its port; None where it is none."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


def _response(status: HTTPStatus, body: bytes, kind: str) -> Response:
    headers = Headers({"Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-store"})
    return Response(status.value, status.phrase, headers, body)


def world(house: House) -> dict[str, Any]:
    """What the page must know before the first scene."""
    trained = find_trained(house.row, house.runs)
    walkers = known_walkers(house.runs, trained.experiment.engine)
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
            logger=_quiet(),
            family=socket.AF_INET6 if ":" in host else socket.AF_INET,
        )
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ValueError(f"port {port} of {host} is in use: choose another with --port") from None
        raise ValueError(f"cannot listen on {host}, port {port}: {error.strerror or error}") from None
    except OverflowError:
        raise ValueError(f"port must be in 0..65535, got {port}") from None


def _quiet() -> logging.Logger:
    """Websockets' own words, of pages that went away without one, are nobody's business: ours are said by ourselves."""
    logger = logging.getLogger("footwork.play.websockets")
    logger.setLevel(logging.CRITICAL)
    return logger


def address_of(server: Server) -> str:
    """Where a browser finds the page."""
    host, port = server.socket.getsockname()[:2]
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/"


def play(row: str, runs: Path, host: str, port: int, seats: int, lesson_steps: int = LESSON_STEPS) -> None:
    """Serve the page until interrupted.

    Raises:
        ValueError: the row is no master, there is no seat, lessons have no steps, or the port is taken.
    """
    for name, number in (("seats", seats), ("lesson_steps", lesson_steps)):
        if number < 1:
            raise ValueError(f"{name} must be >= 1, got {number}")
    trained = find_trained(row, runs)
    if not trained.experiment.is_master:
        raise ValueError(f"play shows masters (maze/hrl/..., bandit/hrl/...), not {trained.experiment.name}")
    house = House(runs, row, seats, lesson_steps)
    server = open_server(house, host, port)
    closing = threading.Thread(target=server.shutdown, name="closing")  # waits for what this thread does

    def close(number: int, frame: Any) -> None:
        if house.closing.is_set():
            os._exit(128 + number)  # asked a second time: visitors are not waited for
        house.closing.set()  # their threads end at their next picture
        closing.start()

    # A handler that asks and does not raise: before it serves, a server that is interrupted would never be closed.
    old = [(number, signal.signal(number, close)) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        print(which_policies(trained), file=sys.stderr, flush=True)
        print(f"{address_of(server)}   (Ctrl-C ends it)", flush=True)
        server.serve_forever()
        print("closing", flush=True)
        if house.stop_lessons():
            print("a lesson finishes what it is at, or compiling; Ctrl-C again does not wait", flush=True)
        closing.join()  # visitors' threads need the interpreter whole
        house.empty()
    finally:
        for number, handler in old:
            signal.signal(number, handler)


__all__ = ["attend", "open_server", "play", "world"]
