"""Pictures of an ant: by MuJoCo's renderer where OpenGL works without a screen, else drawn from above with a pen.

A painter is made for one task and paints shots of it: ``paint(Shot) -> [height, width, 3] uint8``.
:class:`FilmPainter` paints the moment after any control step of a filmed episode.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, Protocol

import mujoco
import numpy as np
from PIL import Image, ImageDraw

from footwork.footage import Footage
from footwork.palette import DIRECTION_COLOURS, FLAT_COLOUR, GOAL_COLOUR, rgb
from footwork.physics.mjcf import build_spec
from footwork.robot import ANKLE_SIGN
from footwork.tasks.task import Task

CameraName = Literal["follow", "arena", "above"]
PLATFORMS = ("egl", "osmesa")  # OpenGL without a screen: on a driver, and in software

_SHIN = (0.27, 0.29, 0.33)
_BACKGROUND = (0.955, 0.95, 0.935)
_WALL = (0.68, 0.69, 0.72)
_WALL_HEIGHT = 0.5  # m, as drawn: walls of 2 m would hide the ant
_MARGIN = 0.6  # m
_SHIN_LENGTH, _LIMB_RADIUS = 0.4 * 2**0.5, 0.08  # m, as in assets/ant.xml
_GOAL_RADIUS = 0.5  # m, as drawn where nothing ends an episode
_FOLLOW_DISTANCE = 8.0  # m
_FIELD_OF_VIEW = 45.0  # degrees, vertical: MuJoCo's own
_PATH_HALF_WIDTH = 0.06  # m
_PIECE_STEPS = 4  # control steps per piece of a drawn path


Colour = tuple[float, float, float]  # each in [0, 1]
Piece = tuple[np.ndarray, np.ndarray, Colour]  # of a path: from [2], to [2] in m


@dataclass(frozen=True, eq=False)
class Shot:
    """What one picture shows.

    Args:
        qpos: the ant, [15].
        tint: its colour.
        goal: [2] in m; None where there is none to arrive at.
        path: the way so far.
        look_at: the point [2] of the floor that a following camera looks at.
    """

    qpos: np.ndarray
    tint: Colour
    goal: np.ndarray | None
    path: Sequence[Piece]
    look_at: np.ndarray


def standing(at: Sequence[float]) -> np.ndarray:
    """The pose [15] of an ant that stands at a point [2] of the floor, its shins 60 degrees down."""
    bend = np.radians(60.0)
    height = _SHIN_LENGTH * np.sin(bend) + _LIMB_RADIUS
    joints = [angle for sign in ANKLE_SIGN for angle in (0.0, sign * bend)]
    return np.array([*at, height, 1.0, 0.0, 0.0, 0.0, *joints], np.float32)


class Painter(Protocol):
    """Paints shots of one task."""

    def paint(self, shot: Shot) -> np.ndarray:
        """A picture, [height, width, 3] uint8."""

    def close(self) -> None:
        """Give back what the renderer holds."""


@dataclass(frozen=True)
class View:
    """How a painter looks at a task.

    Args:
        width: px.
        height: px.
        camera: follows the ant, or shows ``extent`` at an angle (arena) or from above.
        extent: centre x, y and half sizes (m) of what there is to see.
        most_pieces: of a path.
        still: one picture, not one of many: shadows without specks far from the middle, for 1.4 times the time without
            a GPU.
    """

    width: int
    height: int
    camera: CameraName
    extent: tuple[float, float, float, float]
    most_pieces: int = 0
    still: bool = False


def painter(task: Task, view: View, platform: str | None) -> Painter:
    """The painter of a task on an OpenGL platform, or the one that needs none."""
    return SketchPainter(task, view) if platform is None else GLPainter(task, view, platform)


@cache
def choose_platform() -> tuple[str | None, str]:
    """The OpenGL platform that works on this machine, and why none does.

    Each is tried in a process of its own: a broken driver may take its process with it, and two
    platforms do not share one. ``MUJOCO_GL`` names the only one to try, or forbids all (``disable``).
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    if asked in ("disable", "disabled", "off", "false", "0"):
        return None, f"MUJOCO_GL={asked}"
    names = (asked,) if asked in PLATFORMS else PLATFORMS
    reasons = []
    for name in names:
        problem = _try_platform(name)
        if problem is None:
            return name, ""
        reasons.append(f"{name}: {problem}")
    return None, "; ".join(reasons)


def _try_platform(name: str) -> str | None:
    """None where a picture can be made, else what went wrong."""
    code = (
        f"import mujoco, mujoco.{name} as p\nc = p.GLContext(16, 16)\nc.make_current()\n"
        "m = mujoco.MjModel.from_xml_string('<mujoco/>')\nmujoco.MjrContext(m, 100)"
    )
    environment = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    try:
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    except subprocess.TimeoutExpired:
        return "no answer within 60 s"
    if done.returncode == 0:
        return None
    lines = [line for line in done.stderr.strip().splitlines() if not line.startswith((" ", "Exception ignored"))]
    return lines[-1] if lines else f"exit status {done.returncode}"


def colour_of(choice: int) -> Colour:
    """Of a sub-policy's direction, or of a flat policy."""
    return rgb(FLAT_COLOUR if choice < 0 else DIRECTION_COLOURS[choice])


class _Pose:
    """The ant of a picture: a model that is posed, never stepped."""

    def __init__(self, spec: mujoco.MjSpec):
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.parts = [self.model.geom(number).name.split("_")[0] for number in range(self.model.ngeom)]

    def take(self, qpos: np.ndarray, tint: Colour) -> None:
        """Pose the ant and paint its parts."""
        self.data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self.data)
        for number, part in enumerate(self.parts):
            if part in ("torso", "stub", "thigh", "shin"):
                self.model.geom_rgba[number, :3] = self.shade(part, tint)

    @staticmethod
    def shade(part: str, tint: Colour) -> Colour:
        mixed = {"shin": 1.0, "thigh": 0.25}.get(part, 0.0)
        red, green, blue = (a + (b - a) * mixed for a, b in zip(tint, _SHIN, strict=True))
        return red, green, blue


class GLPainter:
    """MuJoCo's own renderer."""

    def __init__(self, task: Task, view: View, platform: str):
        self._context = importlib.import_module(f"mujoco.{platform}").GLContext(view.width, view.height)
        self._context.make_current()
        self._task, self._view = task, view
        self._pose = _Pose(furnished(task, view))
        self._scene = mujoco.MjvScene(self._pose.model, maxgeom=2000 + view.most_pieces)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = True
        self._renderer = mujoco.MjrContext(self._pose.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._renderer)
        self._rectangle = mujoco.MjrRect(0, 0, view.width, view.height)
        self._pixels = np.empty((view.height, view.width, 3), np.uint8)

    def paint(self, shot: Shot) -> np.ndarray:
        self._context.make_current()
        self._pose.take(shot.qpos, shot.tint)
        options, perturbation = mujoco.MjvOption(), mujoco.MjvPerturb()
        camera = _gl_camera(self._view, shot.look_at)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._pose.model, self._pose.data, options, perturbation, camera, everything, self._scene
        )
        _add_path(self._scene, shot.path)
        if shot.goal is not None:
            _add_goal(self._scene, shot.goal.astype(np.float64), self._task.goal_radius or _GOAL_RADIUS)
        mujoco.mjr_render(self._rectangle, self._scene, self._renderer)
        mujoco.mjr_readPixels(self._pixels, None, self._rectangle, self._renderer)
        return np.flipud(self._pixels).copy()

    def close(self) -> None:
        self._context.make_current()
        self._renderer.free()
        self._context.free()


def furnished(task: Task, view: View) -> mujoco.MjSpec:
    """The model of the task's arena, with light for a picture."""
    spec = build_spec(task.robot, task.arena)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = view.width, view.height
    spec.visual.quality.offsamples, spec.visual.quality.shadowsize = 4, 4096 if view.still else 2048
    spec.visual.headlight.ambient = [0.38, 0.38, 0.40]
    spec.visual.headlight.diffuse = [0.18, 0.18, 0.18]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    x, y, half_x, half_y = view.extent
    # MuJoCo's shadows of a directional light are sound well within this distance only
    spec.stat.center, spec.stat.extent = [x, y, 0.0], max(30.0, 4 * half_x, 4 * half_y)
    spec.visual.map.znear, spec.visual.map.zfar = 0.03, 8.0
    # in extents: at 1.0 surfaces far from the middle shadow themselves in specks; 2.0 asks for twice the pixels
    spec.visual.map.shadowclip = 2.0 if view.still else 1.0
    for light in spec.lights:
        light.pos, light.dir = [x, y, 20.0], [-0.25, 0.3, -0.92]
        light.diffuse, light.ambient, light.specular = [0.55, 0.54, 0.52], [0.0] * 3, [0.12] * 3
    for texture in spec.textures:
        if texture.name == "sky":
            texture.rgb1, texture.rgb2 = list(_BACKGROUND), list(_BACKGROUND)
    for geom in spec.geoms:
        if geom.name.startswith("wall"):
            geom.rgba, geom.pos[2], geom.size[2] = [*_WALL, 1.0], _WALL_HEIGHT / 2, _WALL_HEIGHT / 2
    return spec


def _gl_camera(view: View, at: np.ndarray) -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE.value
    camera.azimuth = 90.0
    if view.camera == "follow":
        camera.lookat[:] = (*at, 0.3)
        camera.distance, camera.elevation = _FOLLOW_DISTANCE, -42.0
        return camera
    x, y, half_x, half_y = view.extent
    above = view.camera == "above"
    camera.elevation = -89.9 if above else -58.0
    room = 0.0 if above else 0.13 * half_y  # below, for the caption
    camera.lookat[:] = (x, y - room, 0.0)
    tall = half_y if above else 0.9 * half_y + 0.6 + room
    half_view = np.tan(np.radians(_FIELD_OF_VIEW) / 2)
    camera.distance = max(tall, half_x * view.height / view.width) / half_view
    return camera


def project(view: View, points: Any) -> np.ndarray:
    """Where points [P, 3] (m) are in a picture of the whole arena by OpenGL, [P, 2] px from its upper left corner."""
    camera = _gl_camera(view, np.zeros(2))
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    ahead = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    seen = np.asarray(points, np.float64) - (camera.lookat - camera.distance * ahead)
    sideways, upwards = seen @ right, seen @ np.cross(right, ahead)
    scale = view.height / 2 / np.tan(np.radians(_FIELD_OF_VIEW) / 2) / (seen @ ahead)
    return np.stack([view.width / 2 + scale * sideways, view.height / 2 - scale * upwards], axis=-1)


def _add_path(scene: mujoco.MjvScene, path: Sequence[Piece]) -> None:
    for start, end, colour in path:
        along = (end - start).astype(np.float64)
        length = float(np.hypot(*along))
        if length < 1e-6:
            continue
        middle = (start + end) / 2
        (x, y), size = along / length, (length / 2 + 0.6 * _PATH_HALF_WIDTH, _PATH_HALF_WIDTH, 0.003)
        tint = tuple(0.85 * channel for channel in colour)
        geom = _new_geom(scene, mujoco.mjtGeom.mjGEOM_BOX, tint, size, (*middle, 0.004))
        geom.mat = np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])


def _add_goal(scene: mujoco.MjvScene, goal: np.ndarray, radius: float) -> None:
    (x, y), colour = goal, rgb(GOAL_COLOUR)
    for kind, size, height in (
        (mujoco.mjtGeom.mjGEOM_CYLINDER, (radius, 0.01, 0.0), 0.01),
        (mujoco.mjtGeom.mjGEOM_CAPSULE, (0.04, 1.2, 0.0), 1.2),
        (mujoco.mjtGeom.mjGEOM_SPHERE, (0.18, 0.0, 0.0), 2.5),
    ):
        _new_geom(scene, kind, colour, size, (x, y, height))


def _new_geom(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    colour: tuple[float, ...],
    size: tuple[Any, ...] = (0.0, 0.0, 0.0),
    position: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> Any:
    geom = scene.geoms[scene.ngeom]
    scene.ngeom += 1
    shape = (np.array(size, np.float64), np.array(position, np.float64), np.eye(3).ravel())
    mujoco.mjv_initGeom(geom, kind.value, *shape, np.array([*colour, 1.0], np.float32))
    return geom


class SketchPainter:
    """Drawn from above with a pen, where there is no OpenGL: walls, path, goal, and the ant's limbs by height."""

    _FINER = 2  # drawn so much larger, then reduced: soft edges

    def __init__(self, task: Task, view: View):
        self._task, self._size = task, (view.width, view.height)
        self._pose = _Pose(build_spec(task.robot, task.arena))
        x, y, half_x, half_y = view.extent
        follows = view.camera == "follow"
        fit = min(view.width / half_x, view.height / half_y) / 2
        self._scale = self._FINER * (view.height / _FOLLOW_DISTANCE if follows else fit)  # px per m
        self._centre = None if follows else np.array([x, y])

    def paint(self, shot: Shot) -> np.ndarray:
        image = Image.new("RGB", (self._FINER * self._size[0], self._FINER * self._size[1]), _byte(_BACKGROUND))
        pen, at = ImageDraw.Draw(image), shot.look_at if self._centre is None else self._centre
        self._pose.take(shot.qpos, shot.tint)
        self._draw_floor(pen, at)
        for wall in self._task.arena.walls:
            corners = [(wall.x - wall.half_x, wall.y + wall.half_y), (wall.x + wall.half_x, wall.y - wall.half_y)]
            pen.rectangle([self._pixel(corner, at) for corner in corners], fill=_byte(_WALL))
        if shot.goal is not None:
            self._disc(pen, shot.goal, self._task.goal_radius or _GOAL_RADIUS, at, _byte(rgb(GOAL_COLOUR)))
        for start, end, colour in shot.path:
            self._limb(pen, start, end, _PATH_HALF_WIDTH, at, colour)
        self._draw_ant(pen, at, shot.tint)
        return np.asarray(image.resize(self._size, Image.Resampling.BOX))

    def _draw_floor(self, pen: ImageDraw.ImageDraw, at: np.ndarray) -> None:
        reach = np.array(self._size) * self._FINER / 2 / self._scale
        for axis in (0, 1):
            for line in range(int(np.floor(at[axis] - reach[axis])), int(np.ceil(at[axis] + reach[axis])) + 1):
                low, high = at - reach, at + reach
                low[axis] = high[axis] = line
                shade = 0.80 if line % 4 == 0 else 0.89
                pen.line([self._pixel(low, at), self._pixel(high, at)], fill=_byte((shade,) * 3), width=self._FINER)

    def _draw_ant(self, pen: ImageDraw.ImageDraw, at: np.ndarray, tint: Colour) -> None:
        model, data = self._pose.model, self._pose.data
        ant = [number for number in range(model.ngeom) if model.geom_bodyid[number] > 0]
        for number in sorted(ant, key=lambda geom: data.geom_xpos[geom, 2]):
            sphere = model.geom_type[number] == mujoco.mjtGeom.mjGEOM_SPHERE
            along = 0.0 if sphere else data.geom_xmat[number].reshape(3, 3)[:2, 2] * model.geom_size[number, 1]
            centre, radius = data.geom_xpos[number, :2], float(model.geom_size[number, 0])
            colour = self._pose.shade(self._pose.parts[number], tint)
            dark = tuple(0.65 * channel for channel in colour)
            for size, shade in ((radius, dark), (0.8 * radius, colour)):
                self._limb(pen, centre - along, centre + along, size, at, shade)

    def _limb(self, pen: Any, a: Any, b: Any, radius: float, at: np.ndarray, colour: tuple[float, ...]) -> None:
        fill = _byte(colour)
        pen.line([self._pixel(a, at), self._pixel(b, at)], fill=fill, width=max(1, round(2 * radius * self._scale)))
        self._disc(pen, a, radius, at, fill)
        self._disc(pen, b, radius, at, fill)

    def _disc(self, pen: Any, centre: Any, radius: float, at: np.ndarray, fill: tuple[int, ...]) -> None:
        (x, y), r = self._pixel(centre, at), radius * self._scale
        pen.ellipse([x - r, y - r, x + r, y + r], fill=fill)

    def _pixel(self, point: Any, at: np.ndarray) -> tuple[float, float]:
        width, height = (self._FINER * side for side in self._size)
        x, y = (np.asarray(point, np.float64) - at) * self._scale
        return width / 2 + float(x), height / 2 - float(y)

    def close(self) -> None:
        """Nothing is held."""


class FilmPainter:
    """Paints the moments of one filmed episode.

    Args:
        footage: the episode.
        width: px.
        height: px.
        camera: as in :class:`View`.
        platform: OpenGL's, or None.
    """

    def __init__(self, footage: Footage, width: int, height: int, camera: CameraName, platform: str | None):
        pieces = -(-footage.num_steps // _PIECE_STEPS)
        self._footage, self._way = footage, smooth_way(footage)
        view = View(width, height, camera, footage.extent(_MARGIN), pieces)
        self._painter = painter(footage.task, view, platform)

    def paint(self, step: int) -> np.ndarray:
        """The moment after ``step`` control steps, [height, width, 3] uint8."""
        footage = self._footage
        tint = colour_of(int(footage.choice[max(step - 1, 0)]))
        goal = footage.goal if footage.has_goal else None
        return self._painter.paint(Shot(footage.qpos[step], tint, goal, self._path(step), self._way[step]))

    def _path(self, step: int) -> list[Piece]:
        places, choice = self._footage.qpos[:, :2], self._footage.choice
        return [
            (places[i], places[min(i + _PIECE_STEPS, step)], colour_of(int(choice[i])))
            for i in range(0, step, _PIECE_STEPS)
        ]

    def close(self) -> None:
        """Give back what the painter holds."""
        self._painter.close()


def smooth_way(footage: Footage, seconds: float = 1.0) -> np.ndarray:
    """Where a following camera looks after each control step, [T + 1, 2] in m: the torso's mean over a while."""
    half = max(1, round(seconds / footage.control_dt / 2))
    padded = np.pad(footage.qpos[:, :2].astype(np.float64), ((half, half), (0, 0)), mode="edge")
    sums = np.cumsum(np.concatenate([np.zeros((1, 2)), padded]), axis=0)
    return (sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1)


def _byte(colour: tuple[float, ...]) -> tuple[int, ...]:
    return tuple(round(255 * min(max(channel, 0.0), 1.0)) for channel in colour)
