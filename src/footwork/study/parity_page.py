"""PARITY.md: what ``footwork parity`` found, as tables with a sentence before each."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from footwork.checkpoint import write_atomically
from footwork.study.figures import curves_figure, parity_figure

PAGE, DATA, PICTURE, CURVES = "PARITY.md", "parity.json", "parity.png", "curves.png"


def write_parity(found: dict[str, Any], to: Path) -> list[Path]:
    """Write ``parity.json``, the pictures and ``PARITY.md`` into a folder, each whole or not at all.

    Raises:
        CheckpointError: the system refused.
    """
    files = {DATA: json.dumps(found, indent=2).encode() + b"\n", PICTURE: parity_figure(found)}
    if found.get("curves"):
        files[CURVES] = curves_figure(found["curves"])
    files[PAGE] = page(found).encode()
    for name, content in files.items():
        write_atomically(to / name, content)
    return [to / name for name in files]


def page(found: dict[str, Any]) -> str:
    """The page."""
    machine = found["machine"]
    head = [
        "# How far the engines agree",
        f"Measured by `footwork parity` on {machine['processor']}, {machine['cores']} cores."
        + ("" if found.get("complete") else " **It was interrupted: some of it is missing.**"),
        "An ant is an engine with a row of the table of robots: `mujoco` is MuJoCo in C, `bullet` PyBullet, `mjx` "
        "MuJoCo in JAX. `heavy` is the paper's ant, and on `bullet` it is PyBullet's own.",
        f"![The engines side by side]({PICTURE})",
        *(f"Skipped: {name}: {why}." for name, why in found["skipped"].items()),
    ]
    parts: dict[str, Callable[[Any], Iterable[str]]] = {
        "bodies": _bodies,
        "single_steps": _single_steps,
        "statistics": _statistics,
        "transfer": _transfer,
        "speed": _speed,
        "curves": _curves,
    }
    body = [block for key, part in parts.items() if found.get(key) for block in part(found[key])]
    return "\n\n".join([*head, *body]) + "\n"


def _bodies(found: dict[str, Any]) -> Iterable[str]:
    yield "## Masses, limits, and how heavy a joint feels"
    yield (
        "Masses and limits are read from the engine's own model. Felt inertia is what the torque of one control "
        "step says, on one joint of an ant at rest in the air. The torques are nominal: PyBullet's ankles turn "
        "with 1/√2 of theirs (docs/ant.md)."
    )
    yield _table(
        "ant",
        {
            name: {
                **{f"{part} (kg)": f"{mass:.2f}" for part, mass in figures["mass_kg"].items()},
                "hips (°)": _range(figures["limits_deg"]["hip"]),
                "ankles (°)": _range(figures["limits_deg"]["ankle"]),
                "torque hip / ankle (N m)": f"{figures['hip_torque']:g} / {figures['ankle_torque']:g}",
                "felt inertia hip / ankle (kg m²)": f"{figures['hip_inertia']:.2f} / {figures['ankle_inertia']:.2f}",
            }
            for name, figures in found.items()
        },
    )


def _single_steps(found: dict[str, Any]) -> Iterable[str]:
    yield "## One control step in C and in MJX, from the same state"
    yield (
        "States of random torque in C; of each state the largest difference of any number (m, rad, m/s, rad/s). "
        "`u`: ants beside the walls of the maze."
    )
    yield _table(
        "arena",
        {
            name: {
                "states": f"{figures['states']:,}",
                **{f"qpos, {at}": f"{value:.1e}" for at, value in figures["qpos"].items()},
                **{f"qvel, {at}": f"{value:.1e}" for at, value in figures["qvel"].items()},
                "contact bits equal": f"{100 * figures['bits_equal']:.3f} %",
            }
            for name, figures in found.items()
        },
    )


def _statistics(found: dict[str, Any]) -> Iterable[str]:
    yield "## Torque that nobody chose"
    yield "Alive: the torso has not come down to 0.26 m. Height, speed and feet are means while alive."
    for kind in dict.fromkeys(kind for figures in found.values() for kind in figures):
        yield f"Torque: {kind}."
        yield _table(
            "ant",
            {
                name: {
                    "steps": f"{figures[kind]['steps']}",
                    "alive at the end": f"{figures[kind]['alive']:.2f}",
                    "fallen at step (median)": f"{figures[kind]['fallen_at']:.0f}"
                    if figures[kind]["alive"] < 0.5
                    else "–",
                    "upside down": f"{figures[kind]['upside_down']:.2f}",
                    "height (m)": f"{figures[kind]['height_m']:.3f}",
                    "speed (m/s)": f"{figures[kind]['speed_mps']:.2f}",
                    "feet down": f"{figures[kind]['feet_down']:.2f}",
                }
                for name, figures in found.items()
                if kind in figures
            },
        )


def _transfer(found: dict[str, Any]) -> Iterable[str]:
    yield "## Policies on engines they were not trained on"
    yield (
        "Speed straight on (m/s), and hand-overs at right angles: speed after, share that succeed, fall, turn over. "
        "A row without an engine's name was trained in C."
    )
    for row, on in found.items():
        yield f"`{row}`"
        yield _table(
            "ant", {name: {key: f"{value:.2f}" for key, value in figures.items()} for name, figures in on.items()}
        )


def _speed(found: dict[str, Any]) -> Iterable[str]:
    yield "## Control steps per second on this machine's processor"
    yield "Alternating rounds, all cores; median, least and largest; ratios within rounds. Nothing here ran on a GPU."
    yield _table(
        "ant",
        {
            name: {"steps/s": _spread(figures["steps_per_second"], "{:,.0f}"), "over `mujoco/heavy`": ratio}
            for name, figures in found.items()
            for ratio in [_spread(figures["over_shipped"], "{:.3g}") if figures["over_shipped"] else "–"]
        },
    )


def _curves(found: dict[str, Any]) -> Iterable[str]:
    yield "## Learning curves of plain sub-policies"
    yield f"![Speed over control steps]({CURVES})"
    rows = {f"{engine}: {run['run']}": run for engine, runs in found.items() for run in runs}
    last = lambda run: " / ".join(f"{speed:.2f}" for speed in run["last_mps"])  # noqa: E731
    steps = {
        name: {"steps": f"{run['step'][-1]:,}", "last (m/s, each learner)": last(run)} for name, run in rows.items()
    }
    yield _table("run", steps)


def _table(first: str, rows: dict[str, dict[str, str]]) -> str:
    columns = list(dict.fromkeys(column for row in rows.values() for column in row))
    lines = [[first, *columns], ["---"] * (1 + len(columns))]
    lines += [[f"`{name}`", *(row.get(column, "") for column in columns)] for name, row in rows.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _range(degrees: tuple[float, float]) -> str:
    return f"{degrees[0]:g}..{degrees[1]:g}"


def _spread(values: dict[str, Any], form: str) -> str:
    median, low, high = (form.format(values[key]) for key in ("median", "low", "high"))
    return f"{median} ({low} to {high})"
