"""The live page: ants are stepped as Options steps them, bad wishes are refused in words, the server stays up."""

from __future__ import annotations

import http.client
import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

if find_spec("websockets") is None:
    pytest.skip("needs the extra [play]", allow_module_level=True)

from PIL import Image
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from footwork.checkpoint import CheckpointError
from footwork.doors import live, play
from footwork.doors import visit as visit_module
from footwork.doors.cli import run
from footwork.doors.live import Lesson
from footwork.doors.play import open_server
from footwork.doors.visit import House, Visit
from footwork.palette import DIRECTION_COLOURS, GOAL_COLOUR, rgb
from footwork.study.experiments import find_row
from footwork.study.runs import find_trained
from webdriver import AVAILABLE, MISSING, Browser

NOWHERE = Path("no-runs-here")
ROW = "maze/hrl/symmetric-interleaved"
CORRIDOR = ["#####", "#r.g#", "#####"]
slow = pytest.mark.skipif(os.environ.get("FOOTWORK_SLOW") != "1", reason="takes minutes: FOOTWORK_SLOW=1 runs it")


# ---------------------------------------------------------------- one visitor


@pytest.fixture(scope="module")
def heard():
    return []


@pytest.fixture(scope="module")
def shared_visit(heard):
    visit = Visit(House(NOWHERE, ROW), heard.append)
    yield visit
    visit.leave()


@pytest.fixture
def visit(shared_visit, heard):
    heard.clear()
    shared_visit.do_restart()
    shared_visit._put_goal(shared_visit.arena.goals[0])
    shared_visit.who = "trained"
    return shared_visit


def words(heard):
    return [message["text"] for message in heard if message["is"] == "word"]


def test_an_ant_steps_as_options_does(visit):
    ant, held = visit.ants[0], 1
    snapshot, state, decisions = ant.env.physics.snapshot(), ant.state, ant.decisions
    for _ in range(ant.env.option_steps):
        ant.step(held)
    assert ant.decisions == decisions + 1
    ant.env.physics.restore(snapshot)
    begun = ant.env.begin(state, jnp.array([held], jnp.int32), ant.key)
    whole = ant.env.simulate(begun, jax.random.fold_in(ant.key, 2 * ant.decisions + 1))
    np.testing.assert_array_equal(np.asarray(whole.inner.physics.qpos)[0], ant.qpos)
    assert ant.choice == held


def test_who_can_lead(visit, heard):
    assert visit.leaders() == ["you", "planner", "trained"]
    visit.ants[0].step(visit.current_leaders()[0])
    assert visit.frame()["ants"][0]["odds"] is not None
    visit.hear('{"do": "steer", "direction": 3}')
    assert (visit.who, visit.current_leaders()) == ("you", [3])
    visit.ants[0].step(3)  # at once, not when the option is over
    shown = visit.frame()["ants"][0]
    assert (shown["choice"], shown["odds"], shown["value"]) == (3, None, None)
    visit.hear('{"do": "lead", "who": "planner"}')
    assert visit.current_leaders()[0].choose(np.array(visit.arena.start)) == 0  # the U begins to the right
    assert visit.current_leaders()[0].choose(np.array([4.0, 0.0])) == 1
    visit.hear('{"do": "lead", "who": "lesson"}')
    assert "nobody of that name can lead here: 'lesson'" in words(heard)[-1]


def test_a_goal_is_moved_where_an_ant_can_be(visit, heard):
    visit.hear('{"do": "goal", "at": [4.0, -4.0]}')
    assert visit.ants[0].goal.tolist() == [4.0, -4.0]
    assert visit.who == "planner"  # the master of the maze does not see its goal
    assert "does not see the new one" in words(heard)[-1]
    visit.ants[0].step(visit.current_leaders()[0])
    x, y = visit.ants[0].qpos[:2]
    assert visit.frame()["ants"][0]["distance"] == pytest.approx(np.hypot(x - 4.0, y + 4.0), abs=0.01)
    for wish, answer in (
        ('{"do": "goal", "at": [0.0, 0.0]}', "0.4 m from every wall"),
        ('{"do": "goal", "at": [1e9, 0.0]}', "at most 200 m away"),
        ('{"do": "goal", "at": [50.0, 0.0]}', "no way leads to this goal"),
        ('{"do": "goal", "at": [1.0]}', "a goal is a point"),
        ('{"do": "goal", "at": "x"}', "could not convert"),
        ('{"do": "goal", "at": [NaN, 0.0]}', "a goal is a point"),
    ):
        visit.hear(wish)
        assert any(part in words(heard)[-1] for part in answer.split("|")), words(heard)[-1]
        assert visit.ants[0].goal.tolist() == [4.0, -4.0]


def test_a_push_moves_the_ant_and_a_restart_puts_it_back(visit):
    ant = visit.ants[0]
    for _ in range(3):
        ant.step(0)
    before = np.asarray(ant.state.inner.physics.qvel)[0, :2].copy()
    ant.push(np.pi / 2)
    ant.step(0)
    gained = np.asarray(ant.state.inner.physics.qvel)[0, :2] - before
    assert gained[1] > 0.5 * live.PUSH
    ant.restart()
    assert ant.qpos[:3] == pytest.approx([*visit.arena.start, 0.75], abs=1e-6)


def test_falls_flips_and_arrivals_are_counted_once(visit):
    ant = visit.ants[0]
    flips, goals = ant.flips, ant.goals

    def place(z, quaternion, xy):
        inner = ant.state.inner
        qpos = np.array(inner.physics.qpos)
        qpos[0, :7] = (*xy, z, *quaternion)
        physics = inner.physics._replace(qpos=jnp.asarray(qpos), qvel=jnp.zeros((1, 14)))
        ant.state = ant.state._replace(inner=inner._replace(physics=physics, stale=jnp.ones(1, bool)))

    place(0.5, (0.0, 1.0, 0.0, 0.0), visit.arena.start)
    for _ in range(5):
        ant.step(0)
    assert (ant.flipped, ant.flips) == (True, flips + 1)
    ant.lying = int(live.LIE_SECONDS / 0.0165) + 1
    assert ant.begin_again(led=False)
    place(0.6, (1.0, 0.0, 0.0, 0.0), visit.arena.goals[0])
    for _ in range(5):
        ant.step(0)
    assert (ant.arrived, ant.goals, ant.flipped) == (True, goals + 1, False)
    ant.staying = int(live.STAY_SECONDS / 0.0165) + 1
    assert not ant.begin_again(led=False)  # who steers may stay
    assert ant.begin_again(led=True)


@pytest.mark.parametrize(
    ("wish", "answer"),
    [
        ('{"do": "maze", "rows": ["####", "#r.#", "####"]}', "exactly one goal"),
        ('{"do": "maze", "rows": ["####", "#rg", "####"]}', "equally long"),
        ('{"do": "maze", "rows": ["####", "#rg.", "####"]}', "enclosed by walls"),
        ('{"do": "maze", "rows": ["#####", "#r#g#", "#####"]}', "no path from start to goal"),
        ('{"do": "maze", "rows": ["#?#"]}', "unknown maze cell"),
        ('{"do": "maze", "rows": "no"}', "a list of rows"),
        (json.dumps({"do": "maze", "rows": ["#" * 14] * 14}), "at most 13 cells"),
        ('{"do": "arena", "name": "nowhere"}', "no maze 'nowhere'"),
        ('{"do": "sub_policies", "rows": ["walker/none"]}', "choose one or two of walker/plain"),
        ('{"do": "sub_policies", "rows": []}', "choose one or two of"),
        ('{"do": "steer", "direction": 7}', "direction must be 0..3"),
        ('{"do": "pace", "pace": 1000}', "pace must be in"),
        ('{"do": "push", "angle": "x"}', "could not convert"),
        ('{"do": "goal_quietly", "goal": [0, 0]}', "something unknown"),
        ('{"do": "__class__"}', "something unknown"),
        ('{"do": 3}', "something unknown"),
        ('{"what": 1}', "something unknown"),
        ("[]", "something unknown"),
        ("null", "something unknown"),
        ('{"do": "push"}', "push cannot be done with {}"),
        ('{"do": "pace", "pace": null}', 'pace cannot be done with {"pace": null}'),
        ('{"do": "arena", "name": []}', 'arena cannot be done with {"name": []}'),
        ("nonsense", "Expecting value"),
        ('{"do": "steer", "direction": 1e999}', "direction must be 0..3"),
        ('{"do": "push", "angle": 1' + 400 * "0" + "}", "too large"),
        ("[" * 60_000, "recursion"),
    ],
)
def test_what_cannot_be_done_is_said_and_changes_nothing(visit, heard, wish, answer):
    ants, arena = visit.ants, visit.arena
    visit.hear(wish)
    assert answer in words(heard)[-1]
    assert heard[-1]["bad"]
    assert (visit.ants, visit.arena) == (ants, arena)
    visit.ants[0].step(visit.current_leaders()[0])


@pytest.mark.parametrize(
    "wish", ['{"do": "sub_policies", "rows": ["walker/plain"]}', '{"do": "arena", "name": "spiral"}']
)
def test_what_cannot_be_loaded_leaves_everything_as_it_is(visit, heard, wish, monkeypatch):
    def damaged(row, runs):
        raise CheckpointError("policy.safetensors: damaged")

    ants, rows, arena = visit.ants, visit.rows, visit.arena
    with monkeypatch.context() as patch:
        patch.setattr(visit_module, "find_trained", damaged)
        patch.setattr(visit, "find_sub_policies", lambda row: damaged(row, None))
        visit.hear(wish)
    assert words(heard)[-1] == "policy.safetensors: damaged"
    assert (visit.ants, visit.rows, visit.arena) == (ants, rows, arena)
    assert [message["name"] for message in heard if message["is"] == "scene"] == [arena.name]
    visit.ants[0].step(visit.current_leaders()[0])


def test_a_page_that_comes_back_is_told_everything(visit, heard, monkeypatch):
    class Learning:
        params = None

        def curve(self):
            return [(0.5, 0.25)]

        def report(self):
            return {"step": 1, "running": False, "ways": [[1, 2, 3, 4, 0]]}

    monkeypatch.setattr(visit, "lesson", Learning())
    monkeypatch.setattr(visit, "lesson_place", (visit.arena, visit.rows[0]))
    told = []
    monkeypatch.setattr(visit, "tell", visit.tell)
    visit.welcome_back(told.append)
    assert [message["is"] for message in told] == ["scene", "lesson"]
    assert (told[1]["fresh"], told[1]["curve"], len(told[1]["ways"])) == (True, [(0.5, 0.25)], 1)
    monkeypatch.setattr(visit, "lesson_place", (None, visit.rows[0]))
    visit.report_lesson()
    assert told[-1]["ways"] == []  # they were walked in another place


def test_time_goes_by_at_the_pace_asked_for(visit):
    steps = visit.ants[0].steps
    visit.hear('{"do": "pause", "on": true}')
    visit.step(0.05)
    assert visit.ants[0].steps == steps
    visit.hear('{"do": "pause", "on": false}')
    for _ in range(10):
        visit.step(0.0165)
    assert visit.ants[0].steps == pytest.approx(steps + 10, abs=1)
    visit.step(60.0)  # a machine that stood still does not make the page wait
    assert visit.ants[0].steps <= steps + 20
    json.dumps(visit.frame())


def test_a_scene_tells_the_page_of_the_maze(visit):
    scene = visit.scene()
    json.dumps(scene)
    assert scene["grid"] == list(visit.arena.grid)
    assert len(scene["walls"]) == len(visit.arena.walls)
    assert scene["ants"] == ["walker/symmetric-interleaved"]


def test_ants_stand_on_the_engine_of_the_row(monkeypatch, heard):
    asked, closed, make = [], [], live.physics_for

    def physics_for(engine, *arguments):
        asked.append(engine)
        physics = make("mujoco", *arguments)
        monkeypatch.setattr(physics, "close", lambda: closed.append(engine))
        return physics

    def on_bullet(row, runs):
        trained = find_trained(row, runs)
        return trained._replace(experiment=replace(trained.experiment, engine="bullet"))

    monkeypatch.setattr(live, "physics_for", physics_for)
    monkeypatch.setattr(visit_module, "find_trained", on_bullet)
    visit = Visit(House(NOWHERE, ROW), heard.append)
    assert visit.master_row().engine == "bullet"
    visit.leave()
    assert (asked, closed) == (["bullet"], ["bullet"])


# ---------------------------------------------------------------- a lesson


def test_a_lesson_reports_and_ends(monkeypatch):
    from test_train import tiny, untrained

    experiment = tiny("maze/hrl/plain", iterations=3)
    lesson = Lesson(experiment, untrained("walker/plain"))
    lesson.join(300)
    report = lesson.report()
    assert (report["error"], report["running"]) == ("", False)
    assert report["step"] == report["total"] == 3 * 4 * 3 * 2
    assert len(report["ways"]) == 3 * 3 * 4  # updates, decisions, ants
    assert {piece[4] for piece in report["ways"]} <= {0, 1, 2, 3}
    x, y = (100 * place for place in experiment.task.arena.start)
    assert report["ways"][0][:2] == pytest.approx([x, y], abs=1)
    assert lesson.report()["ways"] == []
    assert lesson.master().policy == experiment.policy()


def test_a_lesson_that_fails_says_so(monkeypatch):
    def fail(*_):
        raise RuntimeError("out of luck")

    monkeypatch.setattr(live, "build_environment", fail)
    lesson = Lesson(find_row("maze/hrl/plain"), find_trained("walker/plain", NOWHERE))
    lesson.join(60)
    assert lesson.report()["error"] == "RuntimeError: out of luck"
    assert lesson.master() is None


# ---------------------------------------------------------------- the server


class Company:
    """A Visit without ants."""

    left: list[str]
    lesson = None

    def __init__(self, house, tell):
        self.tell, self.count = tell, 0
        tell({"is": "scene"})

    def step(self, seconds):
        self.count += 1

    def frame(self):
        return {"is": "frame", "count": self.count}

    def report_lesson(self):
        pass

    def hear(self, text):
        if text == "break":
            raise RuntimeError("broken")
        self.tell({"is": "word", "text": text})

    def say(self, text, stays=False):
        self.tell({"is": "word", "text": text})

    def welcome_back(self, tell):
        self.tell = tell
        tell({"is": "scene", "again": True})

    def leave(self):
        Company.left.append("left")


@pytest.fixture
def served(monkeypatch):
    monkeypatch.setattr(play, "Visit", Company)
    Company.left = []
    house = House(NOWHERE, ROW, seats=1)
    server = open_server(house, port=0)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield house, server.socket.getsockname()[1]
    house.closing.set()
    server.shutdown()
    thread.join(30)
    assert not thread.is_alive()
    house.empty()


def hear(connection, kind):
    while (message := json.loads(connection.recv(timeout=60)))["is"] != kind:
        pass
    return message


def get(port, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def test_the_page_is_served_to_this_machine_only(served):
    _, port = served
    status, text = get(port)
    assert status == 200
    assert "<title>Footwork</title>" in text
    assert "{{" not in text
    assert get(port, "/?from=a-bookmark")[0] == 200
    assert get(port, "/other")[0] == 404
    assert get(port, Host="evil.example")[0] == 403
    assert get(port, Host="[")[0] == 403
    with pytest.raises(InvalidStatus):
        connect(f"ws://127.0.0.1:{port}/ants", origin="http://evil.example")
    with connect(f"ws://127.0.0.1:{port}/ants", origin=f"http://127.0.0.1:{port}") as visitor:
        assert hear(visitor, "frame")["count"] >= 1


def test_a_second_visitor_waits_for_a_seat(served, monkeypatch):
    house, port = served
    monkeypatch.setattr(visit_module, "KEPT_SECONDS", 0.5)
    address = f"ws://127.0.0.1:{port}/ants"
    with connect(address) as first:
        hear(first, "frame")
        with connect(address) as second:
            assert hear(second, "word")["text"] == "1 visitor is here already; you are next"
            with connect(address) as third:
                assert hear(third, "word")["text"] == "1 visitor is here already; 1 more before you"
            first.socket.close()  # gone without a word
            hear(second, "frame")
            second.send("still there?")
            assert hear(second, "word")["text"] == "still there?"
    assert Company.left == ["left"]
    house.empty()
    assert house.taken == []
    assert Company.left == ["left", "left"]


def test_a_page_that_comes_back_finds_its_visit(served):
    house, port = served
    address = f"ws://127.0.0.1:{port}/ants?visit=mine"
    with connect(address) as page:
        assert hear(page, "frame")["count"] == 1
    with connect(address) as page:
        assert hear(page, "scene").get("again")
        assert hear(page, "frame")["count"] > 1
        with connect(address) as another:  # as when the window is duplicated
            assert hear(page, "word")["text"] == "this visit goes on in another window"
            with pytest.raises(ConnectionClosed) as closed:
                hear(page, "nothing more")
            assert closed.value.rcvd.code == play.ELSEWHERE
            assert hear(another, "scene").get("again")
    assert [seat.token for seat in house.taken] == ["mine"]
    assert Company.left == []


def test_a_seat_belongs_to_one(monkeypatch):
    monkeypatch.setattr(visit_module, "KEPT_SECONDS", 0.0)
    house, first, second, third = House(NOWHERE, ROW, seats=1), object(), object(), object()
    seat, _ = house.sit("first", first)
    house.leave_seat(seat, second)  # a page that has lost it changes nothing
    assert seat.connection is first
    assert house.sit("second", second) == (None, 0)
    assert house.sit("third", third) == (None, 1)
    house.leave_seat(seat, first)
    assert time.monotonic() - seat.left_at < 60
    taken, _ = house.sit("second", second)
    assert house.taken == [taken]
    assert house.sit("first", object()) == (None, 1)  # who was away too long is a visitor like any other
    assert not play._sit(house, seat, first, play._Line(None))  # and a page that waited for that seat begins anew
    assert not seat.here.locked()


def test_what_is_told_when_the_page_is_gone_goes_nowhere():
    class Closed:
        def send(self, text):
            raise ConnectionClosed(None, None)

    line = play._Line(Closed())
    line({"is": "scene"})
    assert line.gone
    line.word("nobody hears this")


def test_a_visit_that_breaks_is_one_visits_end(served, capsys):
    _, port = served
    with connect(f"ws://127.0.0.1:{port}/ants") as visitor:
        visitor.send("break")
        assert hear(visitor, "word")["text"] == "the visit ended: broken"
    with connect(f"ws://127.0.0.1:{port}/ants") as visitor:
        assert hear(visitor, "frame")
    assert "RuntimeError: broken" in capsys.readouterr().err


def test_a_taken_port_is_said(served, capsys):
    _, port = served
    assert run(["play", "--port", str(port), "--runs", str(NOWHERE)]) == 1
    assert capsys.readouterr().err == f"footwork: port {port} of 127.0.0.1 is in use: choose another with --port\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["walker/plain"], "play shows masters"),
        (["maze/flat/free"], "play shows masters"),
        (["nothing"], "unknown row 'nothing'"),
        ([ROW, "--seats", "0"], "seats must be >= 1, got 0"),
        ([ROW, "--port", "70000"], "port must be in 0..65535, got 70000"),
        ([ROW, "--lesson-steps", "0"], "lesson_steps must be >= 1, got 0"),
        ([ROW, "--host", "256.1.1.1"], "256.1.1.1"),
    ],
)
def test_what_play_refuses(arguments, message, capsys):
    assert run(["play", *arguments, "--runs", str(NOWHERE)]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("learns", [None, False, True], ids=["nobody there", "a visitor", "a lesson"])
def test_ctrl_c_closes_cleanly(learns):
    command = [sys.executable, "-m", "footwork", "play", "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    line = process.stdout.readline()
    assert line.startswith("http://127.0.0.1:")
    if learns is None:
        process.send_signal(signal.SIGINT)
    else:
        with connect(line.split()[0].replace("http", "ws", 1) + "ants") as visitor:
            hear(visitor, "frame")
            if learns:
                visitor.send('{"do": "train"}')
                hear(visitor, "lesson")
            process.send_signal(signal.SIGINT)
            with pytest.raises(ConnectionClosed):
                hear(visitor, "nothing more")
    out, err = process.communicate(timeout=120)
    lesson = "a lesson finishes what it is at, or compiling; Ctrl-C again does not wait\n" if learns else ""
    assert (process.returncode, out, err) == (0, f"closing\n{lesson}", f"{ROW}: policies from packaged weights\n")


def test_a_signal_before_the_server_serves_closes_it_too(monkeypatch):
    """It may come between the line that tells the address and the loop."""

    def interrupt(word, **_):
        if word.startswith("http"):
            signal.raise_signal(signal.SIGINT)

    def give_up(*_):
        raise AssertionError("the server was not closed")

    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    monkeypatch.setattr("builtins.print", interrupt)
    alarm = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(120)
    try:
        play.play(ROW, NOWHERE, "127.0.0.1", 0, 1)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, alarm)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers


# ---------------------------------------------------------------- in a browser


@pytest.fixture
def page(tmp_path, request):
    house = House(NOWHERE, ROW, lesson_steps=getattr(request, "param", 25_600))
    server = open_server(house, port=0)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    flags = ("--disable-3d-apis",) if "without_webgl" in request.keywords else ()
    browser = Browser(str(tmp_path / "profile"), 900, 700, flags)
    browser.open(f"http://127.0.0.1:{server.socket.getsockname()[1]}/")
    yield browser
    browser.close()
    house.closing.set()
    server.shutdown()
    thread.join(60)
    house.empty()


def draw_a_corridor(browser):
    """With the page's own tools: a maze of 5 x 5 cells whose goal is two cells to the right of the start."""
    browser.run("document.getElementById('draw').click(); document.getElementById('map').scrollIntoView(); return 1")
    wanted = {"#": [(1, 1), (1, 2), (1, 3), (2, 1), (2, 2), (2, 3)], ".": [(3, 2)], "r": [(3, 1)], "g": [(3, 3)]}
    for tool, cells in wanted.items():
        browser.run("document.querySelector(`[data-tool='${arguments[0]}']`).click(); return 1", tool)
        for i, j in cells:
            x, y, w, h = browser.run(
                "const r = document.getElementById('map').getBoundingClientRect(); return [r.x, r.y, r.width, r.height]"
            )
            browser.click(x + (j + 0.5) * w / 5, y + (i + 0.5) * h / 5)
    browser.run("document.getElementById('drop').click(); return 1")
    browser.wait("return footwork.panels[0]?.name === 'drawn' && footwork.panels[0].ant?.steps > 3", 240)
    assert browser.run("return footwork.map.rows.map((row) => row.join(''))") == ["#####"] * 3 + ["#r.g#", "#####"]


@pytest.mark.skipif(not AVAILABLE, reason=MISSING)
def test_a_visit_in_a_browser(page):
    page.wait("return footwork.panels[0]?.ant?.steps > 30", 240)
    page.run("footwork.setCamera('whole'); return 1")
    box = page.run("const r = document.getElementById('view').getBoundingClientRect(); return [r.x, r.y]")
    place = page.run("return footwork.project(footwork.panels[0], [4, -4])")
    page.click(box[0] + place[0], box[1] + place[1])
    page.wait("const g = footwork.state.ants[0].goal; return Math.hypot(g[0] - 4, g[1] + 4) < 0.5")
    page.press("\ue012")  # left
    page.wait("return footwork.state.who === 'you' && footwork.state.ants[0].choice === 2")
    page.press("\ue014")  # right
    page.wait("return footwork.panels[0].trace.filter((point) => point[2] === 0).length > 100", 240)
    page.press(" ")
    page.wait("return footwork.state.paused && !footwork.dirty")
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)[60:, :600]
    for colour in (rgb(DIRECTION_COLOURS[0]), rgb(GOAL_COLOUR), (0.70, 0.71, 0.75)):  # path and ant, goal, walls
        near = np.abs(picture - 255 * np.array(colour)).max(axis=-1) < 40
        assert near.sum() > 30, colour
    page.press(" ")
    draw_a_corridor(page)
    page.run("document.getElementById('train').click(); return 1")
    page.wait("return document.getElementById('learned').textContent === '26 k of 26 k'", 300)
    page.wait("return footwork.state.who === 'lesson'")
    page.run("location.reload(); return 1")  # loses nothing: the maze, its master, and what was learned
    page.wait("return window.footwork?.state.who === 'lesson' && footwork.panels[0].name === 'drawn'")
    assert page.run("return footwork.curve.length") > 0
    assert page.complaints() == []
    assert {url.split("/", 3)[3].partition("?")[0] for url in page.requested()} <= {"", "ants"}


@pytest.mark.skipif(not AVAILABLE, reason=MISSING)
@pytest.mark.without_webgl
def test_clicks_go_where_they_are_drawn_without_webgl_too(page):
    page.wait("return footwork.panels[0]?.ant?.steps > 3 && footwork.renderer === null", 240)
    box = page.run("const r = document.getElementById('view').getBoundingClientRect(); return [r.x, r.y]")
    for camera, goal in (("whole", (4.0, -4.0)), ("above", (-4.0, 4.0))):
        page.run("footwork.setCamera(arguments[0]); return 1", camera)
        place = page.run("return footwork.project(footwork.panels[0], arguments[0])", goal)
        page.click(box[0] + place[0], box[1] + place[1])
        page.wait(f"const g = footwork.state.ants[0].goal; return Math.hypot(g[0] - {goal[0]}, g[1] - {goal[1]}) < 0.2")
    x, y = (round(float(number)) for number in page.run("return footwork.project(footwork.panels[0], [-4, 4])"))
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
    seen = picture[round(box[1]) + y - 3 : round(box[1]) + y + 3, round(box[0]) + x - 3 : round(box[0]) + x + 3]
    assert np.abs(seen - 255 * np.array(rgb(GOAL_COLOUR))).max(axis=-1).min() < 40  # it is drawn where it was clicked


@slow
@pytest.mark.skipif(not AVAILABLE, reason=MISSING)
@pytest.mark.parametrize("page", [300_000], indirect=True)
def test_success_rises_in_a_drawn_maze(page):
    page.wait("return footwork.panels[0]?.ant?.steps > 3", 240)
    draw_a_corridor(page)
    page.run("document.getElementById('train').click(); return 1")
    page.wait("return footwork.curve.length > 0 && footwork.learning", 300)
    page.wait("return !footwork.learning", 900)
    curve = [success for _, success in page.run("return footwork.curve")]
    assert curve[0] < 0.3
    assert curve[-1] > 0.6
