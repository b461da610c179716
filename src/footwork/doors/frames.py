"""What an environment's ``render`` shows: one ant and its goal, as a picture or in a window."""

from __future__ import annotations

import warnings
from typing import Protocol

import mujoco
import mujoco.viewer
import numpy as np

from footwork.arena import extent_of
from footwork.footage import NOBODY
from footwork.palette import GOAL_COLOUR, rgb
from footwork.render import Shot, View, choose_platform, colour_of, furnished, painter
from footwork.tasks.task import Task

HEIGHT, WIDTH = 480, 640  # px


class Shower(Protocol):
    """Shows one ant."""

    def draw(self, qpos: np.ndarray, goal: np.ndarray | None, choice: int) -> np.ndarray | None:
        """Show an ant at ``qpos`` [15] with its goal [2] (m) in the colour of the sub-policy that acts.

        Returns:
            A picture [HEIGHT, WIDTH, 3] uint8, or None from a window.
        """

    def close(self) -> None:
        """Give back what it holds."""


def shower(task: Task, render_mode: str) -> Shower:
    """A window; or pictures by OpenGL, or drawn from above where there is no OpenGL (said once)."""
    if render_mode == "human":
        return _Window(task)
    platform, why = choose_platform()
    if platform is None:
        warnings.warn(f"no OpenGL here ({why}): frames are drawn from above", stacklevel=4)
    return _Camera(task, platform)


def _view(task: Task) -> View:
    return View(WIDTH, HEIGHT, "follow", extent_of(task.arena, [task.arena.start]))


class _Camera:
    """Follows the ant."""

    def __init__(self, task: Task, platform: str | None):
        self._painter = painter(task, _view(task), platform)

    def draw(self, qpos: np.ndarray, goal: np.ndarray | None, choice: int = NOBODY) -> np.ndarray:
        return self._painter.paint(Shot(qpos, colour_of(choice), goal, (), qpos[:2].astype(np.float64)))

    def close(self) -> None:
        self._painter.close()


class _Window:
    """MuJoCo's viewer; the camera is the user's."""

    def __init__(self, task: Task):
        spec = furnished(task, _view(task))
        marker = spec.worldbody.add_body(name="goal", mocap=True, pos=[0.0, 0.0, -5.0])
        marker.add_geom(
            name="goal",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[task.goal_radius or 0.5, 0.02, 0.0],
            rgba=[*rgb(GOAL_COLOUR), 1.0],
            contype=0,
            conaffinity=0,
        )
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._viewer = mujoco.viewer.launch_passive(self._model, self._data, show_left_ui=False, show_right_ui=False)
        with self._viewer.lock():  # where the user's camera begins
            self._viewer.cam.distance, self._viewer.cam.azimuth, self._viewer.cam.elevation = 10.0, 90.0, -45.0

    def draw(self, qpos: np.ndarray, goal: np.ndarray | None, choice: int = NOBODY) -> None:
        with self._viewer.lock():
            self._data.qpos[:] = qpos
            if goal is not None:
                self._data.mocap_pos[0] = (*goal, 0.02)
            mujoco.mj_forward(self._model, self._data)
            self._viewer.cam.lookat[:] = (*qpos[:2], 0.3)
        self._viewer.sync()

    def close(self) -> None:
        self._viewer.close()
