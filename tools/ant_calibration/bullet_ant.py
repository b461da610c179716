"""PyBullet's own ant as a vector of ants in MuJoCo's layout, and its measurements (docs/ant/bullet.json).

A development tool: it needs pybullet and pybullet_data, nothing of Footwork.

    python tools/ant_calibration/bullet_ant.py --out docs/ant/bullet.json
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import measure
import numpy as np
import pybullet as pb
import pybullet_data
from pybullet_utils.bullet_client import BulletClient

JOINTS = (1, 3, 6, 8, 11, 13, 16, 18)  # hip_1, ankle_1, ..., as getJointInfo counts
SHINS = (4, 9, 14, 19)
TORQUE = 250.0


class BulletAnts:
    """N ants, each in a world of its own, set up as pybullet_envs sets up its own.

    One stepSimulation of 0.0165 s (4 substeps, 5 solver iterations) per control step; floor friction 0.8
    times the ant's 1.5; torque 250 N m at action 1; motors off.
    """

    control_dt = 0.0165

    def __init__(self, num_envs, gravity=True, held=False, ant_xml=None):
        self.n = num_envs
        self.held = held
        self.gravity = 9.8 if gravity else 0.0
        xml = ant_xml or os.path.join(pybullet_data.getDataPath(), "mjcf", "ant.xml")
        self.worlds = [self._world(xml) for _ in range(num_envs)]

    def _world(self, xml):
        client = BulletClient(pb.DIRECT)
        client.setGravity(0, 0, -self.gravity)
        client.setDefaultContactERP(0.9)
        client.setPhysicsEngineParameter(fixedTimeStep=0.0165, numSolverIterations=5, numSubSteps=4)
        floor = client.loadSDF(os.path.join(pybullet_data.getDataPath(), "plane_stadium.sdf"))[0]
        client.changeDynamics(floor, -1, lateralFriction=0.8, restitution=0.5)
        flags = pb.URDF_USE_SELF_COLLISION | pb.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS
        ant = client.loadMJCF(xml, flags=flags)[0]
        for joint in range(client.getNumJoints(ant)):
            client.setJointMotorControl2(
                ant, joint, pb.POSITION_CONTROL, targetPosition=0, positionGain=0.1, velocityGain=0.1, force=0
            )
        if self.held:
            client.changeDynamics(ant, -1, mass=0)
        return client, floor, ant

    def reset(self, qpos, qvel, mask=None):
        rows = range(self.n) if mask is None else np.flatnonzero(mask)
        for i in rows:
            client, _, ant = self.worlds[i]
            q, v = qpos[i], qvel[i]
            quaternion = [q[4], q[5], q[6], q[3]]
            turn = np.array(pb.getMatrixFromQuaternion(quaternion)).reshape(3, 3)
            client.resetBasePositionAndOrientation(ant, q[:3].tolist(), quaternion)
            client.resetBaseVelocity(ant, v[:3].tolist(), (turn @ v[3:6]).tolist())
            for k, joint in enumerate(JOINTS):
                client.resetJointState(ant, joint, float(q[7 + k]), float(v[6 + k]))
        return self.read()

    def step(self, action, active=None):
        torque = TORQUE * np.clip(np.asarray(action, float), -1, 1)
        rows = range(self.n) if active is None else np.flatnonzero(active)
        for i in rows:
            client, _, ant = self.worlds[i]
            client.setJointMotorControlArray(ant, JOINTS, pb.TORQUE_CONTROL, forces=torque[i].tolist())
            client.stepSimulation()
        return self.read()

    def read(self):
        qpos, qvel = np.zeros((self.n, 15)), np.zeros((self.n, 14))
        contact = np.zeros((self.n, 4))
        for i, (client, floor, ant) in enumerate(self.worlds):
            position, (x, y, z, w) = client.getBasePositionAndOrientation(ant)
            linear, angular = client.getBaseVelocity(ant)
            turn = np.array(pb.getMatrixFromQuaternion((x, y, z, w))).reshape(3, 3)
            states = client.getJointStates(ant, JOINTS)
            qpos[i, :3], qpos[i, 3:7] = position, (w, x, y, z)
            qpos[i, 7:] = [s[0] for s in states]
            qvel[i, :3], qvel[i, 3:6] = linear, turn.T @ np.array(angular)
            qvel[i, 6:] = [s[1] for s in states]
            touching = {p[3] for p in client.getContactPoints(ant, floor)}
            contact[i] = [shin in touching for shin in SHINS]
        return qpos, qvel, contact


def self_contacts():
    """Which pairs of the ant's own links touch while hips are pushed together (names and counts)."""
    ants = BulletAnts(1, gravity=False, held=True)
    client, _, ant = ants.worlds[0]
    names = {-1: "torso"} | {j: client.getJointInfo(ant, j)[12].decode() for j in range(client.getNumJoints(ant))}
    found = {}
    for hips in ((0.69, -0.69), (0.0, 0.0)):
        qpos, qvel = measure.start(1, z=3.0, ankle=65 * measure.DEG)
        qpos[0, 7], qpos[0, 9] = hips
        qpos[0, [8, 10]] = 0.55, -0.55
        ants.reset(qpos, qvel)
        ants.step(np.array([[0, 0, 0, 0, 0, 0, 0, 0.0]]))
        for point in client.getContactPoints(ant, ant):
            pair = " - ".join(sorted((names[point[3]], names[point[4]])))
            found[f"hips {hips}: {pair}"] = round(point[8], 3)
    return found


def masses():
    """Mass, inertia about the centre of mass and friction of every link that has mass."""
    client, _, ant = BulletAnts(1).worlds[0]
    out = {}
    for link in range(-1, client.getNumJoints(ant)):
        info = client.getDynamicsInfo(ant, link)
        if info[0] > 0:
            name = "torso" if link < 0 else client.getJointInfo(ant, link)[12].decode()
            out[name] = {"mass": round(info[0], 4), "inertia": [round(x, 4) for x in info[2]], "friction": info[1]}
    out["total_mass"] = round(sum(v["mass"] for v in out.values()), 3)
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/ant/bullet.json"))
    parser.add_argument("--episodes", type=int, default=64)
    arguments = parser.parse_args()
    made = {"engine": "pybullet 3.2.7", "masses": masses(), "self_contacts": self_contacts()}
    made.update(measure.everything(BulletAnts, arguments.episodes))
    measure.save(arguments.out, made)
    print(made["self_contacts"])
    measure.headline(made)
