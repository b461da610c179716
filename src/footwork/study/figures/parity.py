"""The pictures of ``footwork parity``."""

from __future__ import annotations

import io
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Patch

from footwork.study.figures.style import DPI, WIDTH, empty, styled

# Okabe and Ito's, an engine with its ant each.
_COLOURS = {
    "bullet/heavy": "#D55E00",
    "mujoco/heavy": "#0072B2",
    "mujoco/bullet": "#56B4E9",
    "mujoco/stiff": "#009E73",
    "mujoco/light": "#E69F00",
    "mjx/heavy": "#CC79A7",
}


def parity_figure(found: dict[str, Any]) -> bytes:
    """Engines side by side: what random torque does, hand-overs, and speed; a PNG."""
    with styled():
        figure, ((alive, height), (handover, speed)) = plt.subplots(2, 2, figsize=(WIDTH, 5.4))
        statistics = found.get("statistics", {})
        _grouped(alive, {k: {a: s[k]["alive"] for a, s in statistics.items() if k in s} for k in _kinds(statistics)})
        alive.set_title("share alive at the end, by torque")
        _grouped(
            height, {k: {a: s[k]["height_m"] for a, s in statistics.items() if k in s} for k in _kinds(statistics)}
        )
        height.set_title("height of the torso while alive (m)")
        transfer = found.get("transfer", {})
        _grouped(handover, {_shown(row): {a: f["success"] for a, f in on.items()} for row, on in transfer.items()})
        handover.set_title("hand-overs at right angles that succeed")
        _rates(speed, found.get("speed", {}))
        handles = [Patch(color=colour) for colour in _COLOURS.values()]
        figure.legend(handles, _COLOURS, loc="outside lower center", ncols=3)
        return _png(figure)


def curves_figure(curves: dict[str, list[dict[str, Any]]]) -> bytes:
    """Training speed of ``walker/plain`` over control steps, a line per run; a PNG."""
    with styled():
        figure, ax = plt.subplots(figsize=(WIDTH, 3.2))
        for engine, runs in curves.items():
            for number, run in enumerate(runs):
                step, smooth = _smoothed(np.array(run["step"]) / 1e6, np.array(run["speed_mps"]))
                colour = _COLOURS.get(f"{engine}/heavy", "#444444")
                ax.plot(step, smooth, color=colour, lw=1.2, label=engine if number == 0 else None)
        ax.set_xlabel("million control steps per direction")
        ax.set_ylabel("speed along the direction (m/s)")
        ax.legend()
        return _png(figure)


def _shown(row: str) -> str:
    """A walker row's address in short; runs of an engine begin with its name."""
    engine, _, name = row.rpartition("walker/")
    return f"{engine.strip('/')}: {name}" if engine else name


def _kinds(statistics: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(kind for by_kind in statistics.values() for kind in by_kind))


def _grouped(ax: Any, groups: dict[str, dict[str, float]]) -> None:
    """Groups of bars, one per engine."""
    if not groups:
        empty(ax, "not measured")
        return
    width = 0.8 / len(_COLOURS)
    for number, (name, colour) in enumerate(_COLOURS.items()):
        at = [(x, values[name]) for x, values in enumerate(groups.values()) if name in values]
        ax.bar([x + (number - 2.5) * width for x, _ in at], [value for _, value in at], width, color=colour)
    ax.set_xticks(range(len(groups)), [_broken(name) for name in groups], fontsize=7 if len(groups) < 4 else 5.5)


def _broken(name: str) -> str:
    """A name in lines that fit under a group of bars."""
    return name.replace(", ", ",\n").replace(": ", ":\n").replace("-", "-\n")


def _rates(ax: Any, speeds: dict[str, Any]) -> None:
    ax.set_title("control steps per second, on this machine")
    if not speeds:
        empty(ax, "not measured")
        return
    for y, (name, figures) in enumerate(reversed(speeds.items())):
        ax.barh(y, figures["steps_per_second"]["median"], color=_COLOURS[name])
    ax.set_yticks(range(len(speeds)), [*reversed(speeds)], fontsize=7)
    ax.set_xscale("log")
    ax.xaxis.set_minor_formatter("")


def _smoothed(step: np.ndarray, value: np.ndarray, points: int = 100) -> tuple[np.ndarray, np.ndarray]:
    """Means over equal stretches of a curve."""
    edges = np.unique(np.linspace(0, len(value), min(points, len(value)) + 1).astype(int))
    starts, counts = edges[:-1], np.diff(edges)
    return np.add.reduceat(step, starts) / counts, np.add.reduceat(value, starts) / counts


def _png(figure: Any) -> bytes:
    picture = io.BytesIO()
    figure.savefig(picture, dpi=DPI, format="png", metadata={"Software": None})
    plt.close(figure)
    return picture.getvalue()
