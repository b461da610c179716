"""PyBullet, the paper's own engine, behind the Physics protocol (extra ``[bullet]``).

Every ant has a world of its own: ``ant.xml`` of pybullet_data on ``plane_stadium.sdf``, set up as pybullet_envs sets
up its AntBulletEnv. PyBullet holds Python's lock while it steps, so threads gain nothing; the worlds are shared out
among worker processes, which read and write one piece of shared memory and are told by pipes when to.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import signal
import subprocess
import sys
import tempfile
import weakref
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import IO, Any, NamedTuple

import numpy as np

from footwork.arena import Arena
from footwork.physics import PYBULLET_MEGABYTES, free_megabytes
from footwork.robot import HEAVY, JOINT_NAMES, Robot
from footwork.types import NUM_FEET, NUM_JOINTS, QPOS_SIZE, QVEL_SIZE, PhysicsState

SHIN_NAMES = ("front_left_foot", "front_right_foot", "left_back_foot", "right_back_foot")  # links, in the legs' order
MAX_WORLDS = 1000  # per process; PyBullet has room for 1024 clients
NOWHERE = (0.0, 0.0, 1000.0)  # m; touches nothing
HUGE_PAGES = "glibc.malloc.hugetlb=1"  # for so many worlds: a tenth faster with 128 of them; elsewhere not heeded
# pybullet_envs: scene_abstract.World, scene_stadium.StadiumScene, robot_bases.MJCFBasedRobot
GRAVITY = 9.8  # m/s^2
SUBSTEPS, SOLVER_ITERATIONS, CONTACT_ERP = 4, 5, 0.9
GROUND = {"lateralFriction": 0.8, "restitution": 0.5}  # times the ant's own friction of 1.5

CANNOT_RESUME = (
    "engine bullet-original reports the mean of the ant's parts as its position, and contacts a step late: no ant can "
    "be put back from that, so a run on it cannot go on bit for bit; train it anew under another --name"
)
_NOT_ITS_OWN = ("name", "reset_height", "reset_ankle_deg", "reset_joint_noise", "fall_height")  # the task's, of a Robot


class BulletPhysics:
    """PyBullet's ant, N of them in worker processes, as a Physics.

    The numbers are the same on any number of workers. Contacts are those of the last
    step, so a row that was just reset touches nothing; a contact is reported up to 2 cm
    early, as PyBullet does. Feet never collide: in spite of the flags that ask for it, PyBullet's
    ant passes through itself (``conaffinity="0"`` in its ant.xml). A world that comes to hold
    a number that float32 cannot, or is given one, is reported in ``diverged`` and is not
    stepped until it is reset.

    PyBullet keeps its solver's memory of contacts to itself. So ``restore`` forgets it: it puts every
    ant down anew, where it was and as fast as it was. All that are restored from a snapshot go on
    alike, the engine that it was taken from only if it is restored too.

    Args:
        robot: must be PyBullet's ant as far as physics goes: masses, torques, limits and friction
            are those of ``heavy``; fields that only MuJoCo reads are ignored but must be ``heavy``'s too.
        arena: whose walls stand in every world.
        num_envs: N. Each takes 33 MB, most of them PyBullet's buffers.
        num_workers: processes; 0 means all cores.
        original_env: report what AntBulletEnv-v0 reports, with its peculiarities, for comparisons with it: x and y
            are the mean over the ant's 21 parts and the floor (which lies at 0 and joins the
            mean after a world's first reset), and contact bits come one step late.

    Raises:
        ValueError: PyBullet has no such ant, a number is out of range, or there is not enough memory for so many.
        ChildProcessError: a worker process ended.
    """

    traceable = False

    def __init__(
        self, robot: Robot, arena: Arena, num_envs: int, num_workers: int = 0, *, original_env: bool = False
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be >= 1, got {num_envs}")
        if num_workers < 0:
            raise ValueError(f"num_workers must be >= 0, got {num_workers}")
        check_robot(robot)
        num_workers = min(num_workers or _num_cores(), num_envs)
        _check_room(num_envs, num_workers)
        self.control_dt = robot.control_dt
        self.num_envs = num_envs
        self.resumable = not original_env
        self.restore_alters = self.resumable
        self._reset_height = robot.reset_height
        with tempfile.TemporaryFile() as file:
            file.truncate(_Shared.size(num_envs))
            self._shared = _Shared.over(mmap.mmap(file.fileno(), 0), num_envs)
            settings = {
                "num_envs": num_envs,
                "file": file.fileno(),
                "control_dt": robot.control_dt,
                "torque": robot.hip_torque,
                "walls": [[w.x, w.y, w.half_x, w.half_y] for w in arena.walls],
                "wall_height": arena.wall_height,
                "original_env": original_env,
            }
            self._workers = [_start_worker(settings, worker, num_workers) for worker in range(num_workers)]
        weakref.finalize(self, _stop_workers, self._workers)
        self._await()  # their worlds are built

    def initial(self) -> PhysicsState:
        """All rows at the reset height with straight joints, at rest."""
        everyone = np.arange(self.num_envs, dtype=np.int32)
        self._shared.qpos[:] = [0.0, 0.0, self._reset_height, 1.0] + [0.0] * (QPOS_SIZE - 4)
        self._shared.qvel[:] = 0.0
        self._command(b"i", everyone)
        return self.read(everyone)

    def reset(self, state: PhysicsState, mask: Any, qpos: Any, qvel: Any) -> PhysicsState:
        """Put the masked rows at ``qpos``, ``qvel`` as if nothing had gone before."""
        rows = np.flatnonzero(mask)
        if rows.size == 0:
            return state
        simulation = np.asarray(state.engine)
        ids = simulation[rows]
        self._shared.qpos[ids] = np.asarray(qpos)[rows]
        self._shared.qvel[ids] = np.asarray(qvel)[rows]
        self._command(b"r", ids)
        return self.read(simulation)

    def step(self, state: PhysicsState, action: Any, active: Any | None = None) -> PhysicsState:
        """One control step; actions are clipped to [-1, 1] and a non-finite one counts as divergence."""
        simulation = np.asarray(state.engine)
        self._shared.action[simulation] = np.asarray(action)
        self._command(b"s", simulation if active is None else simulation[np.flatnonzero(active)])
        return self.read(simulation)

    def snapshot(self) -> dict[str, Any]:
        """Where all ants are and how fast, in float64, contacts and failures; nothing with ``original_env``."""
        if not self.resumable:
            return {}
        shared = self._shared
        return {
            "qpos": shared.qpos.copy(),
            "qvel": shared.qvel.copy(),
            "touching": shared.touching.copy(),
            "failed": shared.failed.copy(),
        }

    def restore(self, arrays: dict[str, Any]) -> None:
        """Put all ants where they were, with every contact forgotten; refused with ``original_env``.

        Raises:
            ValueError: :data:`CANNOT_RESUME`.
        """
        if not self.resumable:
            raise ValueError(CANNOT_RESUME)
        failed = np.asarray(arrays["failed"])
        self._shared.qpos[:], self._shared.qvel[:] = arrays["qpos"], arrays["qvel"]
        self._command(b"i", np.flatnonzero(~failed))
        self._shared.failed[failed] = True  # they stay where they are until they are reset
        self._shared.touching[:] = arrays["touching"]  # what the last step reported is still to be observed

    def close(self) -> None:
        """End the worker processes."""
        _stop_workers(self._workers)

    def read(self, simulation: np.ndarray, dtype: Any = np.float32) -> PhysicsState:
        """The rows of these simulations; float32 is what crosses the door, float64 what the engine holds."""
        untouched: Any = np.zeros((simulation.size, NUM_FEET), np.float32)
        with np.errstate(over="ignore"):  # what was refused at a reset may be of any size
            qpos, qvel = self._shared.qpos[simulation].astype(dtype), self._shared.qvel[simulation].astype(dtype)
        return PhysicsState(
            qpos=qpos,
            qvel=qvel,
            foot_contact=self._shared.touching[simulation].astype(np.float32),
            foot_collision=untouched,
            diverged=self._shared.failed[simulation],
            engine=simulation,
        )

    def _command(self, what: bytes, ids: np.ndarray) -> None:
        """Have the workers do it with these simulations, and wait for them."""
        if ids.size == 0:
            return
        self._shared.chosen[:] = False
        self._shared.chosen[ids] = True
        for worker in self._workers:
            with contextlib.suppress(BrokenPipeError):  # it ended: the missing answer says so
                _pipe(worker.stdin).write(what)
        self._await()

    def _await(self) -> None:
        for worker in self._workers:
            if _pipe(worker.stdout).read(1) != b".":
                raise ChildProcessError(f"a PyBullet process ended with status {worker.wait()}")


OriginalEnvPhysics = partial(BulletPhysics, original_env=True)


def check_robot(robot: Robot) -> None:
    """Refuse an ant that PyBullet would silently not be.

    Raises:
        ValueError: names a field that differs from PyBullet's ant.
    """
    nominal = replace(HEAVY, **{name: getattr(robot, name) for name in _NOT_ITS_OWN})
    other = [name for name in robot.__dataclass_fields__ if getattr(robot, name) != getattr(nominal, name)]
    if other:
        raise ValueError(f"engine bullet has PyBullet's own ant, robot 'heavy': {robot.name!r} differs in {other[0]}")


def describe(robot: Robot) -> dict[str, dict[str, Any]]:
    """What :func:`footwork.physics.mjcf.describe` tells, of PyBullet's own ant."""
    check_robot(robot)
    nowhere = {"walls": [], "wall_height": 0.0, "original_env": False}
    return World({"control_dt": robot.control_dt, "torque": robot.hip_torque, **nowhere}).describe()


def _num_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _check_room(num_envs: int, num_workers: int) -> None:
    """Refuse at once what would be killed for want of memory after minutes."""
    if num_envs > MAX_WORLDS * num_workers:
        raise ValueError(f"PyBullet holds {MAX_WORLDS} ants per process, got {num_envs} for {num_workers}")
    needed, free = num_envs * PYBULLET_MEGABYTES, free_megabytes()
    if free is not None and needed > free:
        raise ValueError(
            f"{num_envs} ants on engine bullet take {needed / 1e3:.0f} GB, {free / 1e3:.0f} are free: ask for fewer"
        )


class _Shared(NamedTuple):
    """What parent and workers share; the row is the simulation. Conventions are those of PhysicsState."""

    qpos: np.ndarray
    qvel: np.ndarray
    action: np.ndarray
    touching: np.ndarray  # foot_contact
    chosen: np.ndarray  # whom the next command is for
    failed: np.ndarray

    @classmethod
    def over(cls, buffer: Any, num_envs: int) -> _Shared:
        """The arrays on a buffer of :meth:`size` bytes."""
        widths = (QPOS_SIZE, QVEL_SIZE, NUM_JOINTS, NUM_FEET)
        starts = np.cumsum((0, *widths)) * 8 * num_envs
        arrays = [
            np.ndarray((num_envs, width), np.float64, buffer, start)
            for width, start in zip(widths, starts, strict=False)
        ]
        flags = [np.ndarray(num_envs, bool, buffer, starts[-1] + i * num_envs) for i in (0, 1)]
        return cls(*arrays, *flags)

    @staticmethod
    def size(num_envs: int) -> int:
        """Bytes."""
        return (QPOS_SIZE + QVEL_SIZE + NUM_JOINTS + NUM_FEET) * 8 * num_envs + 2 * num_envs


# ---------------------------------------------------------------- workers


def _start_worker(settings: dict[str, Any], worker: int, num_workers: int) -> subprocess.Popen[bytes]:
    """A process with every ``num_workers``-th world; it answers a dot when it is ready, and after each command."""
    text = json.dumps({**settings, "worker": worker, "num_workers": num_workers})
    return subprocess.Popen(
        [sys.executable, "-c", "from footwork.physics.bullet import serve; serve()", text],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        bufsize=0,
        pass_fds=(settings["file"],),
        env={
            "GLIBC_TUNABLES": HUGE_PAGES,
            **os.environ,
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        },
    )


def _stop_workers(workers: list[subprocess.Popen[bytes]]) -> None:
    """A closed pipe is the command to end."""
    for worker in workers:
        for pipe in (worker.stdin, worker.stdout):
            with contextlib.suppress(OSError):
                _pipe(pipe).close()
    for worker in workers:
        worker.wait()


def _pipe(pipe: IO[bytes] | None) -> IO[bytes]:
    assert pipe is not None
    return pipe


def serve() -> None:
    """A worker's life: build the worlds, then obey until the pipe closes. For :class:`BulletPhysics` alone."""
    settings = json.loads(sys.argv[1])
    for number in (signal.SIGINT, signal.SIGTERM):  # they may reach the whole process group: the parent decides
        signal.signal(number, signal.SIG_IGN)
    commands, answers = os.fdopen(os.dup(0), "rb", 0), os.fdopen(os.dup(1), "wb", 0)
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 0)
    os.dup2(nowhere, 1)  # PyBullet prints as it pleases, and on stderr when it is imported
    errors = os.dup(2)
    os.dup2(nowhere, 2)
    try:
        import_module("pybullet")
    finally:
        os.dup2(errors, 2)
    num_envs = settings["num_envs"]
    shared = _Shared.over(mmap.mmap(settings["file"], _Shared.size(num_envs)), num_envs)
    own = range(settings["worker"], num_envs, settings["num_workers"])
    worlds = {i: World(settings) for i in own}
    with contextlib.suppress(BrokenPipeError):  # the parent is gone
        answers.write(b".")
        while command := commands.read(1):
            for i in own:
                if shared.chosen[i]:
                    _obey(command, worlds[i], shared, i)
            answers.write(b".")


def _obey(command: bytes, world: World, shared: _Shared, i: int) -> None:
    """One command for one world."""
    if command == b"s":
        if shared.failed[i]:
            return
        if not np.isfinite(shared.action[i]).all():
            shared.failed[i] = True
            return
        world.step(np.clip(shared.action[i], -1.0, 1.0).tolist())
    else:
        bad = not (_is_sane(shared.qpos[i]) and _is_sane(shared.qvel[i]))
        spoilt, shared.failed[i] = bool(shared.failed[i]), bad
        if bad:
            return
        if spoilt:
            world.rebuild()
        world.reset(shared.qpos[i].tolist(), shared.qvel[i].tolist(), is_episode=command == b"r")
    qpos, qvel = np.array(world.qpos()), np.array(world.qvel())
    shared.failed[i] = not (_is_sane(qpos) and _is_sane(qvel))
    if not shared.failed[i]:
        shared.qpos[i], shared.qvel[i], shared.touching[i] = qpos, qvel, world.touching


def _is_sane(numbers: np.ndarray) -> bool:
    """Whether all of them are finite, in float32 too."""
    return bool((np.abs(numbers) < np.finfo(np.float32).max).all())


class World:
    """One ant in a PyBullet client of its own. Angles in rad, quaternions wxyz, as in PhysicsState.

    Args:
        settings: what :class:`BulletPhysics` tells its workers.
    """

    def __init__(self, settings: dict[str, Any]) -> None:
        import pybullet

        self._bullet = pybullet
        self._settings = settings
        self._original = settings["original_env"]
        self._now = self.touching = [0.0] * NUM_FEET  # foot_contact
        self._episodes = 0
        self._floor_counts = False  # in the mean over the parts
        self._build()

    def rebuild(self) -> None:
        """A new world for one that failed: Bullet throws out what is no longer anywhere."""
        self._bullet.disconnect(self._client)
        self._build()

    def reset(self, qpos: list[float], qvel: list[float], is_episode: bool = True) -> None:
        """Place the ant, with everything that went before forgotten."""
        w, x, y, z = qpos[3:7]
        self._call("restoreState", stateId=self._start)
        self._call("resetBasePositionAndOrientation", self._ant, NOWHERE, (0.0, 0.0, 0.0, 1.0))
        self._call("performCollisionDetection")  # or contacts at where it was would be remembered
        self._call("resetBasePositionAndOrientation", self._ant, qpos[:3], (x, y, z, w))
        self._call("resetBaseVelocity", self._ant, qvel[:3], _turn(self._matrix((x, y, z, w)), qvel[3:6]))
        for joint, angle, speed in zip(self._joints, qpos[7:], qvel[6:], strict=True):
            self._call("resetJointState", self._ant, joint, angle, speed)
        self._now = self.touching = [0.0] * NUM_FEET
        self._episodes = self._episodes + 1 if is_episode else 0
        self._floor_counts = self._episodes > 1

    def step(self, action: list[float]) -> None:
        """One control step."""
        torques = [self._settings["torque"] * a for a in action]
        self._call("setJointMotorControlArray", self._ant, self._joints, self._bullet.TORQUE_CONTROL, forces=torques)
        self._call("stepSimulation")
        before, self._now = self._now, self._contacts()
        self.touching = before if self._original else self._now
        self._floor_counts = True

    def describe(self) -> dict[str, dict[str, Any]]:
        """Of the ant as PyBullet reads it, what :func:`footwork.physics.mjcf.describe` tells."""
        mass = [self._call("getDynamicsInfo", self._ant, link)[0] for link in range(-1, self._num_links)]
        thigh, shin = mass[1 + self._thigh], mass[1 + self._shins[0]]
        torso = sum(mass) - 4 * (thigh + shin)
        joints = [self._call("getJointInfo", self._ant, joint)[8:10] for joint in self._joints[:2]]
        limits = {
            part: np.degrees(found).round(3).tolist() for part, found in zip(("hip", "ankle"), joints, strict=True)
        }
        return {"mass_kg": {"ant": sum(mass), "torso": torso, "thigh": thigh, "shin": shin}, "limits_deg": limits}

    def qpos(self) -> list[float]:
        """Torso and joints; with ``original_env``, x and y are the mean over parts."""
        position, (x, y, z, w) = self._call("getBasePositionAndOrientation", self._ant)
        if self._original:
            links = self._call("getLinkStates", self._ant, list(range(self._num_links)))
            parts = [position, *(link[0] for link in links)]
            count = len(parts) + self._floor_counts
            position = (sum(p[0] for p in parts) / count, sum(p[1] for p in parts) / count, position[2])
        angles = [state[0] for state in self._call("getJointStates", self._ant, self._joints)]
        return [*position, w, x, y, z, *angles]

    def qvel(self) -> list[float]:
        """Linear velocity in the world, angular velocity in the torso's frame, joint speeds."""
        _, quaternion = self._call("getBasePositionAndOrientation", self._ant)
        linear, angular = self._call("getBaseVelocity", self._ant)
        speeds = [state[1] for state in self._call("getJointStates", self._ant, self._joints)]
        return [*linear, *_turn(_transposed(self._matrix(quaternion)), angular), *speeds]

    def _contacts(self) -> list[float]:
        """Which shins touch the floor."""
        touching = {point[3] for point in self._call("getContactPoints", self._ant, self._floor)}
        return [float(shin in touching) for shin in self._shins]

    def _call(self, name: str, *args: Any, **options: Any) -> Any:
        return getattr(self._bullet, name)(*args, **options, physicsClientId=self._client)

    def _matrix(self, quaternion: Any) -> tuple[float, ...]:
        """Of a quaternion xyzw, as Bullet has them: torso to world, nine numbers row by row."""
        return self._bullet.getMatrixFromQuaternion(quaternion)

    def _build(self) -> None:
        from pybullet_data import getDataPath

        bullet = self._bullet
        self._client = bullet.connect(bullet.DIRECT)
        self._call("setPhysicsEngineParameter", deterministicOverlappingPairs=1)
        self._call("setGravity", 0, 0, -GRAVITY)
        self._call("setDefaultContactERP", CONTACT_ERP)
        self._call(
            "setPhysicsEngineParameter",
            fixedTimeStep=self._settings["control_dt"],
            numSolverIterations=SOLVER_ITERATIONS,
            numSubSteps=SUBSTEPS,
        )
        (self._floor,) = self._call("loadSDF", os.path.join(getDataPath(), "plane_stadium.sdf"))
        self._call("changeDynamics", self._floor, -1, **GROUND)
        self._build_walls()
        flags = bullet.URDF_USE_SELF_COLLISION | bullet.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS
        (self._ant,) = self._call("loadMJCF", os.path.join(getDataPath(), "mjcf", "ant.xml"), flags=flags)
        self._num_links = self._call("getNumJoints", self._ant)
        names = [self._call("getJointInfo", self._ant, link) for link in range(self._num_links)]
        links = {info[12].decode(): link for link, info in enumerate(names)}
        joints = {info[1].decode(): link for link, info in enumerate(names)}
        self._joints = [joints[name] for name in JOINT_NAMES]
        self._shins = [links[name] for name in SHIN_NAMES]
        self._thigh = links["aux_1"]
        for link in range(self._num_links):  # no motor brakes a joint
            self._call(
                "setJointMotorControl2",
                self._ant,
                link,
                bullet.POSITION_CONTROL,
                targetPosition=0,
                positionGain=0.1,
                velocityGain=0.1,
                force=0,
            )
        self._start = self._call("saveState")

    def _build_walls(self) -> None:
        half_height = self._settings["wall_height"] / 2
        for x, y, half_x, half_y in self._settings["walls"]:
            shape = self._call("createCollisionShape", self._bullet.GEOM_BOX, halfExtents=[half_x, half_y, half_height])
            wall = self._call("createMultiBody", 0, shape, basePosition=[x, y, half_height])
            self._call("changeDynamics", wall, -1, **GROUND)


def _turn(matrix: tuple[float, ...], vector: Any) -> list[float]:
    return [sum(matrix[3 * i + j] * vector[j] for j in range(3)) for i in range(3)]


def _transposed(matrix: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(matrix[3 * j + i] for i in range(3) for j in range(3))
