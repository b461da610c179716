"""What an environment's ``render`` shows: MuJoCo's renderer where OpenGL works, else the ant drawn from above."""

from __future__ import annotations

import importlib
import os
import warnings
from functools import cache
from typing import Any, Protocol

import mujoco
import mujoco.viewer
import numpy as np

from footwork.physics.mjcf import build_spec
from footwork.tasks.task import Task

HEIGHT, WIDTH = 480, 640  # px
_PLATFORMS = ("egl", "osmesa")
_FLOOR, _WALL, _GOAL = (242, 240, 235), (74, 78, 87), (213, 94, 0)
_TORSO, _LEG, _SHIN = (0, 114, 178), (86, 150, 190), (60, 66, 76)
_VIEW = 10.0  # m of height that a picture shows
_NO_GOAL = 1000.0  # m; a goal beyond is not drawn


class Painter(Protocol):
    """Shows one ant."""

    def draw(self, qpos: np.ndarray, goal: np.ndarray | None) -> np.ndarray | None:
        """A picture [HEIGHT, WIDTH, 3] uint8 of an ant at ``qpos`` [15] with its goal [2] (m), or None in a window."""

    def close(self) -> None:
        """Give back what it holds."""


def painter(task: Task, render_mode: str) -> Painter:
    """A window, or pictures by OpenGL, or drawn from above where there is no OpenGL (said once)."""
    if render_mode == "human":
        return _Window(task)
    platform, why = _platform()
    if platform is not None:
        return _GLPainter(task, platform)
    warnings.warn(f"no OpenGL here ({why}): frames are drawn from above", stacklevel=4)
    return _Sketch(task)


@cache
def _platform() -> tuple[Any, str]:
    """The first OpenGL platform that makes a context here, and why none does. MUJOCO_GL names the only one to try."""
    asked = os.environ.get("MUJOCO_GL", "").lower()
    if asked in ("disable", "disabled", "off", "false", "0"):
        return None, f"MUJOCO_GL={asked}"
    reasons = []
    for name in (asked,) if asked in _PLATFORMS else _PLATFORMS:
        try:
            platform = importlib.import_module(f"mujoco.{name}")
            context = platform.GLContext(16, 16)
            context.make_current()
            context.free()
        except Exception as error:  # drivers fail in many ways, and each of them means the next platform
            reasons.append(f"{name}: {error}")
        else:
            return platform, ""
    return None, "; ".join(reasons)


class _Pose:
    """A model that is posed, never stepped; a disc marks the goal."""

    def __init__(self, task: Task):
        spec = build_spec(task.robot, task.arena)
        spec.visual.global_.offwidth, spec.visual.global_.offheight = WIDTH, HEIGHT
        marker = spec.worldbody.add_body(name="goal", mocap=True, pos=[0.0, 0.0, -5.0])
        size = [task.goal_radius or 0.5, 0.02, 0.0]
        marker.add_geom(
            name="goal",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=size,
            rgba=[*np.array(_GOAL) / 255.0, 1.0],
            contype=0,
            conaffinity=0,
        )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def set(self, qpos: np.ndarray, goal: np.ndarray | None) -> None:
        """Put the ant and its goal where they are."""
        self.data.qpos[:] = qpos
        if goal is not None and np.abs(goal).max() < _NO_GOAL:
            self.data.mocap_pos[0] = (*goal, 0.02)
        mujoco.mj_forward(self.model, self.data)


class _GLPainter:
    """MuJoCo's renderer; the camera follows the ant."""

    def __init__(self, task: Task, platform: Any):
        self._pose = _Pose(task)
        self._context = platform.GLContext(WIDTH, HEIGHT)
        self._context.make_current()
        self._scene = mujoco.MjvScene(self._pose.model, maxgeom=1000)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._renderer = mujoco.MjrContext(self._pose.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._renderer)
        self._rectangle = mujoco.MjrRect(0, 0, WIDTH, HEIGHT)

    def draw(self, qpos: np.ndarray, goal: np.ndarray | None) -> np.ndarray:
        self._context.make_current()
        self._pose.set(qpos, goal)
        camera = mujoco.MjvCamera()
        camera.lookat[:] = (*qpos[:2], 0.3)
        camera.distance, camera.azimuth, camera.elevation = _VIEW, 90.0, -55.0
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        scene, model, data = self._scene, self._pose.model, self._pose.data
        mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), mujoco.MjvPerturb(), camera, everything, scene)
        mujoco.mjr_render(self._rectangle, scene, self._renderer)
        pixels = np.empty((HEIGHT, WIDTH, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._rectangle, self._renderer)
        return np.flipud(pixels).copy()

    def close(self) -> None:
        self._context.make_current()
        self._renderer.free()
        self._context.free()


class _Sketch:
    """The ant, the walls and the goal from above, filled into an array."""

    def __init__(self, task: Task):
        self._pose, self._task = _Pose(task), task
        self._metres = _VIEW / HEIGHT  # per px

    def draw(self, qpos: np.ndarray, goal: np.ndarray | None) -> np.ndarray:
        self._pose.set(qpos, goal)
        columns, rows = np.meshgrid(np.arange(WIDTH) - WIDTH / 2, HEIGHT / 2 - np.arange(HEIGHT))
        x, y = qpos[0] + columns * self._metres, qpos[1] + rows * self._metres
        tiles = (np.floor(x / 2) + np.floor(y / 2)) % 2
        image = np.where(tiles[..., None] > 0, _FLOOR, np.array(_FLOOR) - 8).astype(np.uint8)
        for wall in self._task.arena.walls:
            image[(np.abs(x - wall.x) < wall.half_x) & (np.abs(y - wall.y) < wall.half_y)] = _WALL
        if goal is not None:
            image[np.hypot(x - goal[0], y - goal[1]) < (self._task.goal_radius or 0.5)] = _GOAL
        self._draw_ant(image, x, y)
        return image

    def _draw_ant(self, image: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
        """Parts from the lowest to the highest; a capsule is all that is near its axis."""
        model, data = self._pose.model, self._pose.data
        colours = {"shin": _SHIN, "thigh": _LEG, "stub": _LEG, "torso": _TORSO}
        for geom in np.argsort(data.geom_xpos[:, 2]):
            colour = colours.get(model.geom(int(geom)).name.split("_")[0])
            if colour is None:
                continue
            axis = data.geom_xmat[geom].reshape(3, 3)[:2, 2] * model.geom_size[geom, 1]
            along_x, along_y = x - data.geom_xpos[geom, 0], y - data.geom_xpos[geom, 1]
            length = max(float(axis @ axis), 1e-9)
            share = np.clip((along_x * axis[0] + along_y * axis[1]) / length, -1.0, 1.0)
            near = np.hypot(along_x - share * axis[0], along_y - share * axis[1]) < model.geom_size[geom, 0]
            image[near] = colour

    def close(self) -> None:
        pass


class _Window:
    """MuJoCo's viewer; the camera is the user's."""

    def __init__(self, task: Task):
        self._pose = _Pose(task)
        self._viewer = mujoco.viewer.launch_passive(self._pose.model, self._pose.data)

    def draw(self, qpos: np.ndarray, goal: np.ndarray | None) -> None:
        with self._viewer.lock():
            self._pose.set(qpos, goal)
            self._viewer.cam.lookat[:] = (*qpos[:2], 0.3)
        self._viewer.sync()

    def close(self) -> None:
        self._viewer.close()
