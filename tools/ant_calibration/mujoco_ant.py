"""Our ant in MuJoCo, measured as bullet_ant.py measures PyBullet's (docs/ant/mujoco_*.json), and a scan.

python tools/ant_calibration/mujoco_ant.py --robot heavy --out docs/ant/mujoco_heavy.json
python tools/ant_calibration/mujoco_ant.py --set hip_armature=0.6 --set limit_solref=-10,-242 --set substeps=4
python tools/ant_calibration/mujoco_ant.py --robot heavy --stability 1000
"""

from __future__ import annotations

import argparse
import functools
import time
from dataclasses import fields, replace
from pathlib import Path

import measure
import mujoco
import mujoco.batch
import numpy as np

from footwork import arena, robot
from footwork.physics import mjcf

OPEN = arena.open_field()
ROBOT_FIELDS = {f.name for f in fields(robot.Robot)}


def model_of(row, extra, gravity, held):
    """The compiled model of a robot row with settings beyond its fields written over it."""
    spec = mjcf.build_spec(row, OPEN)
    if not gravity:
        spec.option.gravity = [0, 0, 0]
    if "cone" in extra:
        spec.option.cone = int(extra["cone"])
    if "impratio" in extra:
        spec.option.impratio = extra["impratio"]
    if "noslip" in extra:
        spec.option.noslip_iterations = int(extra["noslip"])
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            continue
        if "limit_solimp" in extra:
            joint.solimp_limit = list(extra["limit_solimp"])
        if "limit_margin" in extra:
            joint.margin = extra["limit_margin"]
        if joint.name.startswith("ankle") and "ankle_armature" in extra:
            joint.armature = extra["ankle_armature"]
    for actuator in spec.actuators:
        if actuator.name.startswith("ankle") and "ankle_torque" in extra:
            actuator.gear[0] = extra["ankle_torque"]
    for geom in spec.geoms:
        if "contact_solref" in extra:
            geom.solref = list(extra["contact_solref"])
        if "contact_solimp" in extra:
            geom.solimp = list(extra["contact_solimp"])
        if "foot_gap" in extra and geom.name.startswith("shin"):
            geom.gap = extra["foot_gap"]  # seen by the contact sensor, felt by nothing
    if held:
        spec.delete(next(j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_FREE))
        for leg in (1, 2, 3, 4):  # a torso welded to the world is no parent that collisions leave out
            spec.add_exclude(bodyname1="torso", bodyname2=f"thigh_{leg}")
    return spec.compile()


class MujocoAnts:
    """N ants with the interface that measure.py expects."""

    def __init__(self, num_envs, gravity=True, held=False, row=robot.HEAVY, extra=None, threads=1):
        model = model_of(row, extra or {}, gravity, held)
        self.n, self.held, self.substeps = num_envs, held, row.substeps
        self.batch = mujoco.batch.Batch(model, num_envs, threads)
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.ctrl, self.sensors = self.batch.bind("ctrl"), self.batch.bind("sensordata")
        self.warm = self.batch.bind("qacc_warmstart")
        self.base = np.zeros((num_envs, 7))
        self.failed = np.zeros(num_envs, bool)

    def reset(self, qpos, qvel, mask=None):
        rows = np.arange(self.n) if mask is None else np.flatnonzero(mask)
        at = 7 if self.held else 0
        self.base[rows] = qpos[rows, :7]
        self.qpos[rows] = qpos[rows, at:]
        self.qvel[rows] = qvel[rows, at - 1 if at else 0 :]
        self.warm[rows] = 0
        self.ctrl[rows] = 0
        self.batch.forward(rows)
        return self.read()

    def step(self, action):
        self.ctrl[:] = np.clip(action, -1, 1)
        try:
            self.batch.step(nstep=self.substeps)
        except mujoco.batch.SimulationError as error:
            self.failed[error.ids] = True
        return self.read()

    def read(self):
        contact = (self.sensors[:, :4] > 0).astype(float)
        if self.held:
            still = np.zeros((self.n, 6))
            return np.hstack([self.base, self.qpos]), np.hstack([still, self.qvel]), contact
        return self.qpos.copy(), self.qvel.copy(), contact

    def diverged(self):
        """Rows that failed, warned or hold a non-finite number since the start."""
        kinds = [mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC]
        warned = (self.batch.warning[:, [int(k) for k in kinds], 1] > 0).any(1)
        return self.failed | warned | ~np.isfinite(self.qpos).all(1) | ~np.isfinite(self.qvel).all(1)


def stability(make, episodes=1000, steps=1000, rows=250):
    """Diverged simulations and the highest speeds under uniform and bang-bang torque held for 1..20 steps."""
    out = {"episodes": 0, "diverged": 0, "max_joint_speed": 0.0, "max_base_speed": 0.0, "max_z": 0.0}
    for chunk in range(-(-episodes // rows)):
        rng = np.random.default_rng(100 + chunk)
        ants = make(rows)
        ants.reset(*measure.start(rows, rng))
        hold, bang = (((1, 1), False), ((1, 20), True), ((1, 20), False), ((1, 1), True))[chunk % 4]
        act = measure.random_actions(rng, rows, hold, bang)
        for t in range(steps):
            q, v, _ = ants.step(act(t))
            out["max_joint_speed"] = max(out["max_joint_speed"], float(np.abs(v[:, 6:]).max()))
            out["max_base_speed"] = max(out["max_base_speed"], float(np.abs(v[:, :3]).max()))
            out["max_z"] = max(out["max_z"], float(q[:, 2].max()))
        out["episodes"] += rows
        out["diverged"] += int(ants.diverged().sum())
    return {k: round(v, 2) if isinstance(v, float) else v for k, v in out.items()}


def speed(make, rows=128, steps=300):
    """Control steps per second of processor time, one thread, random torque."""
    ants = make(rows)
    rng = np.random.default_rng(0)
    ants.reset(*measure.start(rows, rng))
    actions = rng.uniform(-1, 1, (steps, rows, 8))
    for t in range(50):
        ants.step(actions[t])
    began = time.process_time()
    for t in range(steps):
        ants.step(actions[t])
    return round(rows * steps / (time.process_time() - began))


def settings(pairs, row):
    """Robot fields and settings beyond them, from ``name=value[,value...]``."""
    extra = {}
    for pair in pairs:
        name, text = pair.split("=")
        old = getattr(row, name, None)
        value = text if isinstance(old, str) else tuple(float(x) for x in text.split(","))
        if isinstance(value, tuple) and (len(value) == 1):
            value = int(value[0]) if isinstance(old, int) else value[0]
        if name in ROBOT_FIELDS:
            row = replace(row, **{name: value})
        else:
            extra[name] = value
    return row, extra


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="heavy")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--stability", type=int, default=0, help="episodes of the stability test")
    arguments = parser.parse_args()
    chosen, beyond = settings(arguments.set, robot.ROBOTS[arguments.robot])
    make = functools.partial(MujocoAnts, row=chosen, extra=beyond)
    made = {"engine": f"mujoco {mujoco.__version__}", "robot": repr(chosen), "beyond": repr(beyond)}
    made.update(measure.everything(make, arguments.episodes))
    made["speed_128_rows_1_thread"] = speed(make)
    if arguments.stability:
        made["stability"] = stability(make, arguments.stability)
        print(made["stability"], flush=True)
    measure.headline(made)
    print("speed", made["speed_128_rows_1_thread"])
    if arguments.out:
        measure.save(arguments.out, made)
