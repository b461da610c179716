"""The replay: filmed episodes as one HTML file that opens from disk, plays, scrubs and fetches nothing.

Forward kinematics and WebGL are a few hundred lines of JavaScript beside this module
(``viewer/``); a pose is 15 numbers of 16 bits, so that 1000 control steps take 70 KB.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from footwork.arena import DIRECTIONS
from footwork.checkpoint import write_atomically
from footwork.footage import Footage, film
from footwork.palette import DIRECTION_COLOURS, FLAT_COLOUR
from footwork.physics.skeleton import skeleton
from footwork.study.runs import find_needed, find_trained, which_policies
from footwork.train import Trained, choices_of

OUTCOMES = {
    "reached": "reached the goal",
    "fallen": "fell",
    "flipped": "turned over",
    "diverged": "simulation failed",
    "truncated": "time is up",
    "cut": "not over yet",
}


@dataclass(frozen=True, eq=False)
class Replay:
    """Episodes side by side. Shows itself in a notebook; ``save`` writes it.

    Args:
        footage: of one or several rows.
        title: of the page.
        height: px, in a notebook.
    """

    footage: tuple[Footage, ...]
    title: str = "Footwork"
    height: int = 560

    def __post_init__(self) -> None:
        if not self.footage:
            raise ValueError("footage must hold at least one episode, got none")
        if len({episode.task.robot for episode in self.footage}) > 1:
            names = sorted({episode.task.robot.name for episode in self.footage})
            raise ValueError(f"episodes of different ants do not share a page: {', '.join(names)}")

    def html(self) -> str:
        """The page."""
        text = json.dumps(_payload(self.footage), separators=(",", ":"), allow_nan=False)
        return page("replay.html", self.title, ("style.css",), ("scene.js", "replay.js"), text)

    def save(self, path: Path) -> Path:
        """Write the page."""
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, self.html().encode())
        return path

    def _repr_html_(self) -> str:
        page = html.escape(self.html(), quote=True)
        style = f"width: 100%; height: {self.height}px; border: 0; border-radius: 10px"
        return f'<iframe title="{html.escape(self.title)}" srcdoc="{page}" style="{style}"></iframe>'


def replay(
    *rows: str,
    episodes: int = 1,
    seed: int = 0,
    runs: Path = Path("runs"),
    deterministic: bool = False,
    most_steps: int | None = None,
    num_threads: int = 0,
    report: Callable[[str], None] | None = None,
) -> Replay:
    """Film episodes of rows and put them side by side, for a notebook or a file.

    Args:
        rows: names of rows, or run directories.
        episodes: of each row; of a walker row of each direction.
        seed: of the episodes.
        runs: where runs are kept.
        deterministic: act by the mode of the distribution instead of a sample.
        most_steps: control steps to show of each episode; None: all.
        num_threads: of the physics; changes no number.
        report: gets a line for each row that says which policies it means.

    Raises:
        ValueError: no row, an unknown row, or not at least one episode.
        RunError: a row has no trained policies.
    """
    if not rows:
        raise ValueError("replay needs at least one row or run directory")
    footage = [
        episode
        for row in rows
        for episode in film_row(row, runs, episodes, seed, deterministic, num_threads, most_steps, report)
    ]
    return Replay(tuple(footage), title="Footwork: " + ", ".join(dict.fromkeys(item.row for item in footage)))


def film_row(
    row: str,
    runs: Path,
    episodes: int = 1,
    seed: int = 0,
    deterministic: bool = False,
    num_threads: int = 0,
    most_steps: int | None = None,
    report: Callable[[str], None] | None = None,
) -> list[Footage]:
    """Film a row by name, or the run in a directory; of a walker row, ``episodes`` in each direction."""
    _check_amounts(episodes, most_steps)  # before anything is said
    trained = find_trained(row, runs)
    if report is not None:
        report(which_policies(trained))
    return film_trained(trained, find_needed(trained, runs), episodes, seed, deterministic, num_threads, most_steps)


def _check_amounts(episodes: int, most_steps: int | None) -> None:
    if episodes < 1:
        raise ValueError(f"episodes must be >= 1, got {episodes}")
    if most_steps is not None and most_steps < 1:
        raise ValueError(f"steps must be >= 1, got {most_steps}")


def film_trained(
    trained: Trained,
    needed: Trained | None,
    episodes: int = 1,
    seed: int = 0,
    deterministic: bool = False,
    num_threads: int = 0,
    most_steps: int | None = None,
) -> list[Footage]:
    """Film the first seed's policies; of a walker row, ``episodes`` in each direction.

    Raises:
        ValueError: not at least one episode, or one step.
    """
    _check_amounts(episodes, most_steps)
    subs = choices_of(trained.experiment, needed)
    count = episodes * (len(DIRECTIONS) if trained.experiment.is_walker else 1)
    return film(trained, subs, count, seed, 0, deterministic, num_threads, most_steps)


def page(template: str, title: str, styles: Sequence[str], scripts: Sequence[str], data: str) -> str:
    """A page of ``viewer/`` with styles, scripts and JSON data written into it."""
    parts = {
        "title": html.escape(title),
        "style": "\n".join(_asset(name) for name in styles),
        "script": "\n".join(_asset(name) for name in scripts),
        "data": data.replace("<", "\\u003c"),
    }
    pieces = _asset(template).split("{{")
    text = [pieces[0]]
    for piece in pieces[1:]:  # once, left to right: what is written in is not searched again
        name, rest = piece.split("}}", 1)
        text += [parts[name], rest]
    return "".join(text)


def _asset(name: str) -> str:
    return resources.files("footwork").joinpath("doors", "viewer", name).read_text(encoding="utf-8")


def _payload(footage: Sequence[Footage]) -> dict[str, Any]:
    return {
        "control_dt": footage[0].control_dt,
        "skeleton": skeleton(footage[0].task.robot),
        "directions": DIRECTIONS,
        "colours": DIRECTION_COLOURS,
        "flat_colour": FLAT_COLOUR,
        "episodes": [_episode(episode) for episode in footage],
    }


def _episode(footage: Footage) -> dict[str, Any]:
    arena = footage.task.arena
    low, step, codes = quantise(footage.qpos)
    seconds = footage.num_steps * footage.control_dt
    return {
        "row": footage.row,
        "label": label(footage),
        "walls": [[wall.x, wall.y, wall.half_x, wall.half_y] for wall in arena.walls],
        "wall_height": arena.wall_height,
        "start": arena.start,
        "goal": footage.goal.tolist() if footage.has_goal else None,
        "goal_radius": footage.task.goal_radius,
        "extent": list(footage.extent()),
        "low": low,
        "step": step,
        "frames": _base64(codes),
        "choice": _base64(footage.choice.astype(np.int8)),
        "total": _base64(np.cumsum(footage.reward, dtype=np.float64).astype("<f4")),
        "distance": _base64(footage.distance.astype("<f4")),
        "flags": _base64((footage.fallen + 2 * footage.flipped).astype(np.uint8)),
        "odds": _base64(np.rint(255 * footage.odds).astype(np.uint8)),
        "value": _base64(footage.value.astype("<f4")),
        "option_steps": footage.option_steps,
        "outcome": f"{OUTCOMES[footage.outcome]} after {seconds:.1f} s",
        "good": footage.outcome == "reached",
    }


def label(footage: Footage) -> str:
    """Which episode it is."""
    return f"seed {footage.seed}, episode {footage.episode}, {footage.task.arena.name.replace('_', ' ')}"


def quantise(values: np.ndarray) -> tuple[list[float], list[float], np.ndarray]:
    """Columns of [T, C] in 16 bits: lower bounds [C], steps [C] and codes [T, C]; the error is half a step."""
    low = values.min(axis=0).astype(np.float64)
    step = (values.max(axis=0).astype(np.float64) - low) / 65535
    codes = np.rint((values - low) / np.where(step > 0, step, 1.0)).astype("<u2")
    return low.tolist(), step.tolist(), codes


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


__all__ = ["Replay", "film_row", "film_trained", "page", "replay"]
