"""The replay page and the video: what is shown is what was filmed, and nothing is fetched."""

from __future__ import annotations

import html
import io
import json
import re
import shutil
import subprocess
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

import footwork.doors
from footwork import render
from footwork.arena import DIRECTIONS, extent_of, open_field
from footwork.doors.cli import run
from footwork.doors.replay import Replay, quantise
from footwork.doors.video import Look, video
from footwork.footage import Footage
from footwork.palette import DIRECTION_COLOURS, rgb
from footwork.physics.mjcf import build_model
from footwork.physics.skeleton import skeleton
from footwork.robot import HEAVY, ROBOTS
from footwork.study.experiments import ANT_MAZE, ANT_WALKER
from webdriver import AVAILABLE, MISSING, Browser

VIEWER = Path(footwork.doors.__file__).parent / "viewer"
NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="needs node, to run the page's kinematics")


def shot(steps=60, task=ANT_MAZE, row="maze/hrl/test", seed=0, outcome="reached"):
    """An ant that walks from the start to the goal along straight lines, turning, its legs at random."""
    rng = np.random.default_rng(seed)
    via = np.array([task.arena.start, (4.0, -4.0), (4.0, 4.0), (-4.0, 4.0)])
    along = np.linspace(0, len(via) - 1, steps + 1)
    qpos = np.zeros((steps + 1, 15), np.float32)
    qpos[:, 0] = np.interp(along, range(len(via)), via[:, 0])
    qpos[:, 1] = np.interp(along, range(len(via)), via[:, 1])
    qpos[:, 2] = 0.55
    yaw = np.linspace(0, 3 * np.pi, steps + 1)
    qpos[:, 3], qpos[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    qpos[:, 7:] = rng.uniform(-0.6, 0.6, (steps + 1, 8)) + np.array([0, 0.9, 0, -0.9, 0, -0.9, 0, 0.9])
    choice = np.minimum(along[:-1].astype(np.int8), 2)
    flipped = np.zeros(steps, bool)
    flipped[: steps // 4] = seed == 1
    decisions = -(-steps // 10)
    return Footage(
        row=row,
        seed=0,
        episode=seed,
        task=task,
        goal=np.array(task.arena.goals[0], np.float32),
        qpos=qpos,
        choice=choice,
        reward=rng.normal(1.0, 1.0, steps).astype(np.float32),
        distance=np.ones(steps, np.float32),
        fallen=np.zeros(steps, bool),
        flipped=flipped,
        odds=rng.dirichlet(np.ones(4), decisions).astype(np.float32),
        value=rng.normal(size=decisions).astype(np.float32),
        option_steps=10,
        outcome=outcome,
    )


def node(code, data):
    """What the page's own code makes of ``data``."""
    script = "".join((VIEWER / name).read_text() for name in ("scene.js", "replay.js"))
    script += f"const v = module.exports, a = JSON.parse(require('fs').readFileSync(0)); {code}"
    done = subprocess.run([NODE, "-e", script], input=json.dumps(data), capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def payload(page):
    return json.loads(re.search(r'id="footage">(.*?)</script>', page, re.S).group(1))


# ---------------------------------------------------------------- the page


@needs_node
@pytest.mark.parametrize("robot", ["heavy", "light"])
def test_the_pages_kinematics_are_mujocos(robot):
    model = build_model(ROBOTS[robot], open_field())
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[:] = rng.normal(size=15)
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    mujoco.mj_kinematics(model, data)
    bones = skeleton(ROBOTS[robot])
    code = "console.log(JSON.stringify(v.geomPoses(a.skeleton, a.qpos)))"
    poses = node(code, {"skeleton": bones, "qpos": data.qpos.tolist()})
    numbers = [model.geom(geom["name"]).id for geom in bones["geoms"]]
    assert len(numbers) == 13
    np.testing.assert_allclose([p["position"] for p in poses], data.geom_xpos[numbers], atol=1e-7)
    np.testing.assert_allclose([p["rotation"] for p in poses], data.geom_xmat[numbers], atol=1e-7)


@needs_node
def test_the_page_decodes_what_was_filmed():
    filmed = shot(50)
    episode = payload(Replay((filmed,)).html())["episodes"][0]
    code = (
        "const d = v.decode(a); console.log(JSON.stringify({frames: [...d.frames], choice: [...d.choice], "
        "total: [...d.total], flags: [...d.flags], odds: [...d.odds], half: v.poseAt(d, 20.5)}))"
    )
    seen = node(code, episode)
    np.testing.assert_allclose(np.reshape(seen["frames"], (51, 15)), filmed.qpos, atol=2e-4)
    np.testing.assert_array_equal(seen["choice"], filmed.choice)
    np.testing.assert_allclose(seen["total"], np.cumsum(filmed.reward), rtol=1e-5)
    np.testing.assert_allclose(np.array(seen["odds"]) / 255, filmed.odds.ravel(), atol=0.002)
    middle = (filmed.qpos[20] + filmed.qpos[21]) / 2
    middle[3:7] /= np.linalg.norm(middle[3:7])
    np.testing.assert_allclose(seen["half"], middle, atol=3e-4)
    assert np.linalg.norm(seen["half"][3:7]) == pytest.approx(1.0)


def test_the_error_of_a_pose_is_half_a_step():
    values = np.random.default_rng(0).normal(scale=(20.0, 1e-3, 0.0), size=(500, 3)).astype(np.float32)
    low, step, codes = quantise(values)
    error = np.abs(np.array(low) + np.array(step) * codes - values)
    assert (error.max(axis=0) <= np.array(step) / 2 + 1e-6).all()
    assert step[0] < 0.003


def test_the_page_is_small_and_fetches_nothing():
    page = Replay((shot(1000),)).html()
    assert len(page.encode()) < 200_000  # of the 3 MB that were allowed
    assert "http://" not in page
    assert "https://" not in page
    assert not re.search(r"\b(src|href)=|@import|url\(|fetch\(|XMLHttpRequest|WebSocket", page)
    assert "default-src 'none'" in page
    both = Replay((shot(1000), shot(1000, seed=1))).html()
    assert len(both) - len(page) < 90_000


def test_the_page_says_what_was_filmed():
    walker = replace(shot(20, task=ANT_WALKER, row="walker/test", outcome="truncated"), odds=np.zeros((0, 4)))
    told = payload(Replay((shot(), walker)).html())
    maze, field = told["episodes"]
    assert tuple(told["directions"]) == DIRECTIONS
    assert tuple(told["colours"]) == DIRECTION_COLOURS
    assert (maze["row"], maze["good"], maze["outcome"]) == ("maze/hrl/test", True, "reached the goal after 1.0 s")
    assert len(maze["walls"]) == len(ANT_MAZE.arena.walls)
    assert maze["goal"] == list(ANT_MAZE.arena.goals[0])
    assert (field["goal"], field["walls"], field["odds"], field["good"]) == (None, [], "", False)
    assert shot().extent() == (0.0, 0.0, 7.0, 7.0)  # the maze within its border, and a metre


def test_text_cannot_break_out_of_the_page():
    page = Replay((shot(5, row="</script><script>alert(1)</script>"),), title="<b>&").html()
    assert "<script>alert(1)" not in page
    assert "<title>&lt;b&gt;&amp;</title>" in page
    assert payload(page)["episodes"][0]["row"] == "</script><script>alert(1)</script>"


def test_a_notebook_shows_the_page_itself():
    shown = Replay((shot(5),), height=300)
    frame = shown._repr_html_()
    assert html.unescape(re.search(r'srcdoc="(.*?)" style', frame, re.S).group(1)) == shown.html()
    assert "height: 300px" in frame


def test_what_a_replay_refuses():
    with pytest.raises(ValueError, match="at least one episode"):
        Replay(())
    light = replace(ANT_MAZE, robot=ROBOTS["light"])
    with pytest.raises(ValueError, match="different ants do not share a page: heavy, light"):
        Replay((shot(5), shot(5, task=light)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["replay", "maze/hrl/none"], "unknown row 'maze/hrl/none'"),
        (["replay", "maze/flat/free", "--episodes", "0"], "episodes must be >= 1, got 0"),
        (["replay", "maze/flat/free", "--steps", "0"], "steps must be >= 1, got 0"),
        (["replay"], "replay needs at least one row or run directory"),
        (["video", "maze/flat/free", "-o", "ant.avi"], "must end in one of .mp4, .webp, .gif, got '.avi'"),
        (["video", "maze/flat/free", "--width", "33"], "width must be even and in 32..4096, got 33"),
        (["video", "maze/flat/free", "--width", "20000"], "width must be even and in 32..4096, got 20000"),
        (["video", "maze/flat/free", "--speed", "0"], "speed must be > 0 and <= 1000, got 0"),
        (["video", "maze/flat/free", "--speed", "inf"], "speed must be > 0 and <= 1000, got inf"),
        (["video", "maze/flat/free", "-o", "/dev/null/a.webp"], "cannot write /dev/null/a.webp: "),
        (["replay", "maze/flat/free", "-o", "ant.txt"], "ant.txt does not end in .html"),
        (["replay", "maze/flat/free", "-o", "/"], "cannot write /: it is a directory"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_ant_stands_on_the_floor():
    from footwork.physics import physics_for

    task = ANT_MAZE
    qpos = render.standing(task.arena.start)[None]
    physics = physics_for("mujoco", task.robot, task.arena, 1, 1)
    state = physics.reset(physics.initial(), np.ones(1, bool), qpos, np.zeros((1, 14), np.float32))
    assert state.foot_contact.all()  # they touch from 2 cm on
    assert not physics.reset(state, np.ones(1, bool), qpos + 0.05 * np.eye(15)[2], np.zeros((1, 14))).foot_contact.any()


def test_points_are_where_they_are_rendered():
    render.choose_platform.cache_clear()
    platform, reason = render.choose_platform()
    if platform is None:
        pytest.skip(f"no OpenGL here: {reason}")
    (x, y), (there_x, there_y) = ANT_MAZE.arena.start, ANT_MAZE.arena.goals[0]
    view = render.View(320, 240, "arena", extent_of(ANT_MAZE.arena))
    painter = render.GLPainter(ANT_MAZE, view, platform)
    pose = render.standing((x, y))
    picture = painter.paint(render.Shot(pose, (0.0, 1.0, 0.0), np.array([there_x, there_y]), (), np.zeros(2))).astype(
        int
    )
    painter.close()
    for place, colour in (((there_x - 0.3, there_y, 0.02), rgb("#D55E00")), ((x, y, pose[2]), (0.0, 1.0, 0.0))):
        column, row = np.round(render.project(view, [place])[0]).astype(int)
        seen = picture[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3)
        hue = seen / np.maximum(seen.max(axis=1, keepdims=True), 1)  # in the light or in the shade
        assert np.abs(hue - np.array(colour) / max(colour)).max(axis=1).min() < 0.2, place


def test_the_commands_leave_a_page_and_a_video(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(render, "_try_platform", lambda name: "nothing there")
    render.choose_platform.cache_clear()
    page, film = tmp_path / "deep" / "ant.html", tmp_path / "ant.webp"
    common = ["--steps", "4", "--threads", "1", "--runs", str(tmp_path)]
    assert run(["replay", "maze/flat/free", "maze/flat/penalised", "-o", str(page), *common]) == 0
    assert [e["row"] for e in payload(page.read_text())["episodes"]] == ["maze/flat/free", "maze/flat/penalised"]
    assert run(["video", "maze/flat/free", "-o", str(film), *common, "--width", "64", "--height", "48"]) == 0
    out = capsys.readouterr()
    assert "2 episodes, 8 control steps" in out.out
    assert "maze/flat/penalised: policies from packaged weights" in out.err
    assert out.err.count("no OpenGL here (egl: nothing there; osmesa: nothing there)") == 1
    assert Image.open(film).size == (64, 48)
    render.choose_platform.cache_clear()


def test_a_damaged_or_foreign_run_is_refused(tmp_path, capsys):
    (tmp_path / "config.json").write_text("{}")
    assert run(["replay", str(tmp_path)]) == 1
    assert str(tmp_path) in capsys.readouterr().err


# ---------------------------------------------------------------- the video


@pytest.mark.parametrize("camera", ["follow", "arena", "above"])
def test_the_sketch_shows_ant_goal_path_and_walls(camera):
    painter = render.FilmPainter(shot(), 160, 120, camera, None)
    picture = painter.paint(60).astype(int)
    assert picture.shape == (120, 160, 3)
    seen = {tuple(colour) for colour in picture.reshape(-1, 3)}
    for colour in (rgb(DIRECTION_COLOURS[2]), rgb("#D55E00"), render._WALL):
        want = np.array(colour) * 255
        assert min(np.abs(np.array(c) - want).max() for c in seen) < 12, colour
    assert (painter.paint(0) != picture).any()


def test_a_video_lasts_as_long_as_the_episode():
    look = Look(96, 64, fps=20, speed=2.0, camera="arena")
    for suffix in (".webp", ".gif"):
        made = video((shot(60), shot(30, seed=1)), suffix, look)
        opened = Image.open(io.BytesIO(made.data))
        assert opened.size == (192, 64)
        seconds = 60 * HEAVY.control_dt / 2.0 + 1.0  # and the last picture for a second
        durations = []
        for number in range(opened.n_frames):
            opened.seek(number)
            opened.load()
            durations.append(opened.info["duration"])
        assert sum(durations) / 1000 == pytest.approx(seconds, abs=0.15)
        assert f"data:image/{suffix[1:]};base64," in made._repr_html_()


@pytest.mark.skipif(find_spec("av") is None, reason="needs the extra [video]")
def test_an_mp4_can_be_read_back():
    import av

    made = video((shot(30),), ".mp4", Look(64, 48, fps=30))
    with av.open(io.BytesIO(made.data)) as container:
        frames = list(container.decode(video=0))
    assert (frames[0].width, frames[0].height) == (64, 48)
    assert len(frames) == np.ceil(30 * HEAVY.control_dt * 30) + 1 + 30
    assert "data:video/mp4;base64," in made._repr_html_()


def test_without_pyav_the_extra_is_named(monkeypatch):
    monkeypatch.setattr("footwork.doors.video.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install 'footwork\[video\]'"):
        video((shot(5),), ".mp4")


def test_opengl_is_tried_apart_and_its_failure_told(monkeypatch):
    render.choose_platform.cache_clear()
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert render.choose_platform() == (None, "MUJOCO_GL=disable")
    render.choose_platform.cache_clear()
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setattr(render.sys, "executable", "/bin/false")
    assert render.choose_platform() == (None, "osmesa: exit status 1")
    render.choose_platform.cache_clear()


def test_mujocos_renderer_where_there_is_one():
    render.choose_platform.cache_clear()
    platform, reason = render.choose_platform()
    if platform is None:
        pytest.skip(f"no OpenGL here: {reason}")
    painter = render.FilmPainter(shot(), 128, 96, "arena", platform)
    picture = painter.paint(60)
    assert picture.shape == (96, 128, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    assert (painter.paint(10) != picture).any()
    painter.close()


# ---------------------------------------------------------------- in a browser


@pytest.mark.skipif(not AVAILABLE, reason=MISSING)
def test_the_page_in_a_browser(tmp_path):
    path = Replay((shot(120), shot(80, seed=1)), title="a test").save(tmp_path / "ant.html")
    browser = Browser(str(tmp_path / "profile"), 640, 480)
    try:
        browser.open(path.as_uri())
        assert browser.run("return [footwork.playing, footwork.steps, footwork.renderer !== null]") == [
            False,
            120,
            True,
        ]
        assert browser.run("return document.querySelectorAll('.panel').length") == 2
        browser.press("\ue010")  # end
        assert browser.run("return footwork.time") == 120
        browser.wait("return document.querySelector('.badge.on')?.textContent === 'reached the goal after 2.0 s'")
        browser.press("\ue012")  # left: half a second
        assert browser.run("return footwork.time") == 90
        browser.press(" ")
        browser.wait("return footwork.time > 92")
        browser.press(" ")
        assert not browser.run("return footwork.playing")
        box = browser.run(
            "const b = document.getElementById('tracks').getBoundingClientRect(); return [b.x, b.y, b.width]"
        )
        browser.click(box[0] + box[2] / 2, box[1] + 5)
        assert browser.run("return footwork.time") == pytest.approx(60, abs=1)
        browser.press("\ue013")  # faster
        assert browser.run("return footwork.speed") == 2
        browser.wait("return !footwork.dirty")
        picture = np.asarray(Image.open(io.BytesIO(browser.screenshot())).convert("RGB"))
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 300
        assert browser.complaints() == []
        assert browser.requested() == [path.as_uri()]
    finally:
        browser.close()
