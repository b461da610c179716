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
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from footwork.arena import DIRECTIONS, MAZES
from footwork.doors.replay import page
from footwork.doors.visit import FRAMES_PER_SECOND, LESSON_STEPS, SQUARE, House, Visit, known_walkers
from footwork.physics.skeleton import skeleton
from footwork.study.palette import DIRECTION_COLOURS, FLAT_COLOUR
from footwork.study.runs import find_trained

try:
    from websockets.datastructures import Headers
    from websockets.exceptions import ConnectionClosed
    from websockets.http11 import Request, Response
    from websockets.sync.server import Server, ServerConnection, serve
except ImportError as error:
    raise ImportError("the page needs websockets: pip install 'footwork[play]'") from error

_WAIT = 1.0  # s between looks for a free seat
_LOCAL = ("127.0.0.1", "localhost", "::1")


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
    last = due = time.monotonic()
    while not house.closing.is_set():
        _hear_all(visit, connection)
        now = time.monotonic()
        visit.step(now - last)
        last = now
        visit.tell(visit.frame())
        visit.report_lesson()
        due = max(due, now - 1 / FRAMES_PER_SECOND) + 1 / FRAMES_PER_SECOND  # a late picture is made up for by the next
        time.sleep(max(0.0, due - time.monotonic()))


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
    trained = find_trained(row, runs)
    if not trained.experiment.is_master:
        raise ValueError(f"play shows masters (maze/hrl/..., bandit/hrl/...), not {trained.experiment.name}")
    house = House(runs, row, seats, lesson_steps)
    server = open_server(house, host, port)

    def close(number: int, frame: Any) -> None:
        house.closing.set()  # visitors' threads end at their next picture
        threading.Thread(target=server.shutdown, name="closing").start()  # it waits for what this thread does

    # A handler that asks and does not raise: before it serves, a server that is interrupted would never be closed.
    old = [(number, signal.signal(number, close)) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        address = server.socket.getsockname()
        print(f"http://{address[0]}:{address[1]}/   (Ctrl-C ends it)", flush=True)
        server.serve_forever()
        print("closing")
    finally:
        for number, handler in old:
            signal.signal(number, handler)  # a second Ctrl-C does not wait for visitors


__all__ = ["attend", "open_server", "play", "world"]
