"""The engines that step the ant, behind one protocol (:class:`footwork.types.Physics`).

An engine is a module here and a line in :data:`ENGINES`. Nothing of it is imported before it is asked for.
"""

from __future__ import annotations

import math
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from footwork.arena import Arena
from footwork.robot import Robot
from footwork.types import Physics

DEFAULT_ENGINE = "mujoco"
PYBULLET_MEGABYTES = 33  # of an ant's own world; measured, in huge pages


class Engine(NamedTuple):
    """Where an engine is: ``factory(robot, arena, num_envs, num_threads)`` makes its Physics."""

    module: str
    factory: str
    library: str = ""  # that comes with the extra of the same name as the module
    about: str = ""
    megabytes: int = 0  # that every ant takes; 0: too little to count

    @property
    def large(self) -> bool:
        """Whether memory bounds how many ants there can be at once."""
        return self.megabytes > 0


ENGINES: dict[str, Engine] = {
    "mujoco": Engine("batch", "BatchPhysics", about="MuJoCo in C on a thread pool"),
    "mjx": Engine("mjx", "MjxPhysics", "mujoco.mjx", "MuJoCo in JAX, for GPUs"),
    "bullet": Engine("bullet", "BulletPhysics", "pybullet", "PyBullet, the paper's engine", PYBULLET_MEGABYTES),
    "bullet-original": Engine(
        "bullet", "OriginalEnvPhysics", "pybullet", "the same, seen as AntBulletEnv-v0 sees it", PYBULLET_MEGABYTES
    ),
}


def libraries_of(name: str) -> tuple[str, ...]:
    """The distributions whose versions the numbers of a run on this engine depend on."""
    extra = ENGINES[name].library.replace(".", "-")
    return ("jax", "mujoco", *([extra] if extra else []))


def free_megabytes(
    meminfo: Path = Path("/proc/meminfo"),
    cgroups: Path = Path("/sys/fs/cgroup"),
    own: Path = Path("/proc/self/cgroup"),
) -> float | None:
    """Memory that programs can still have on this machine, in this container or in this batch job; None if not known.

    Args:
        meminfo: what Linux says of the machine.
        cgroups: where it keeps what it says of control groups, version 2.
        own: which of them this process is in. It has what that one and all around it leave it.
    """
    try:
        available = next(line for line in meminfo.read_text("ascii").splitlines() if line.startswith("MemAvailable:"))
        free = int(available.split()[1]) * 1024 / 1e6
    except (OSError, StopIteration):
        return None
    try:
        name = next(line for line in own.read_text("utf-8").splitlines() if line.startswith("0::/")).removeprefix(
            "0::/"
        )
    except (OSError, StopIteration):
        name = ""
    groups = [cgroups / name, *(cgroups / around for around in Path(name).parents)]
    return min(free, *(_free_in(group) for group in groups))


def _free_in(group: Path) -> float:
    """Megabytes that a control group leaves; infinite where there is none, or none with a limit (``max``)."""
    try:
        limit, used = (int((group / name).read_text("ascii")) for name in ("memory.max", "memory.current"))
        held = dict(line.split() for line in (group / "memory.stat").read_text("ascii").splitlines())
    except (OSError, ValueError):
        return math.inf
    return (limit - used + int(held.get("inactive_file", 0))) / 1e6  # files not lately read give way to who wants it


def check_engine(name: str) -> None:
    """Refuse an engine that does not exist.

    Raises:
        ValueError: lists those that do.
    """
    if name not in ENGINES:
        raise ValueError(f"unknown engine {name!r}; known engines: {', '.join(ENGINES)}")


def require_engine(name: str, robot: Robot | None = None) -> None:
    """Refuse, before anything was begun, an engine that does not exist, is not installed or has no such ant.

    Raises:
        ValueError: there is no such engine, or its module's ``check_robot`` refuses the ant.
        ImportError: its library is missing; names the extra that brings it.
    """
    check_engine(name)
    engine = ENGINES[name]
    if engine.library and find_spec(engine.library) is None:
        raise ImportError(f"engine {name} needs an extra: pip install 'footwork[{engine.module}]'")
    check_robot = getattr(import_module(f"footwork.physics.{engine.module}"), "check_robot", None)
    if robot is not None and check_robot is not None:
        check_robot(robot)


def physics_for(engine: str, robot: Robot, arena: Arena, num_envs: int, num_threads: int = 0) -> Physics:
    """N ants on an engine.

    Args:
        engine: one of :data:`ENGINES`.
        robot: the ant.
        arena: whose walls stand around every ant.
        num_envs: N.
        num_threads: threads or worker processes; 0 means all cores. Changes no number.

    Raises:
        ValueError: there is no such engine, or it has no such ant.
        ImportError: the engine's library is missing; names the extra that brings it.
    """
    require_engine(engine, robot)
    home = import_module(f"footwork.physics.{ENGINES[engine].module}")
    return getattr(home, ENGINES[engine].factory)(robot, arena, num_envs, num_threads)
