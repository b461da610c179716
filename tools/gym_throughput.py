"""Steps per second of our vector environments beside the physics alone and beside Gymnasium's vectors of its Ant-v5.

    python tools/gym_throughput.py

All contenders take turns within each round, so that what else the machine does meets all of them;
reported are the best and the median round. "physics alone" steps the same model with the same
torques through `mujoco.batch.Batch`, 256 simulations, and does nothing else.
"""

import argparse
import json
import time

import gymnasium
import mujoco.batch
import numpy as np

import footwork.doors.gym  # noqa: F401 (registers the ids)
from footwork.arena import MAZES, open_field
from footwork.physics.mjcf import build_model
from footwork.robot import HEAVY

ROWS = 256
ALONE = {"physics alone, open field": open_field(), "physics alone, maze": MAZES["u"]}
OF_GYMNASIUM = 8  # environments in a vector of Gymnasium's


class PhysicsAlone:
    """``mujoco.batch.Batch`` and nothing else."""

    num_envs = ROWS

    def __init__(self, arena):
        self.batch = mujoco.batch.Batch(build_model(HEAVY, arena), ROWS, 0)
        self.control, position = self.batch.bind("ctrl"), self.batch.bind("qpos")
        self.generator = np.random.default_rng(0)
        position[:, :3] = (*arena.start, HEAVY.reset_height)

    def sample(self):
        return self.generator.uniform(-1, 1, (ROWS, 8)).astype(np.float32)

    def step(self, action):
        self.control[:] = action
        self.batch.step(None, nstep=HEAVY.substeps)

    def close(self):
        pass


class Vector:
    """A vector environment of Gymnasium's API."""

    def __init__(self, env):
        self.env, self.num_envs = env, env.num_envs
        env.reset(seed=0)
        env.action_space.seed(0)
        self.sample, self.step, self.close = env.action_space.sample, env.step, env.close


def prepare(masters=False):
    """All contenders by name, warmed up."""
    ours = {
        f"ours: {name}": Vector(gymnasium.make_vec(f"footwork/{name}", ROWS, autoreset_mode="SameStep"))
        for name in ("AntWalker-v0", "AntMaze-v0", *(["AntMazeOptions-v0"] if masters else []))
    }
    theirs = {
        f"Gymnasium: Ant-v5, {mode}, {OF_GYMNASIUM}": Vector(
            gymnasium.make_vec("Ant-v5", OF_GYMNASIUM, vectorization_mode=mode)
        )
        for mode in ("sync", "async")
    }
    alone = {name: PhysicsAlone(arena) for name, arena in ALONE.items()}
    contenders = {**alone, **ours, **theirs}
    for contender in contenders.values():
        contender.step(contender.sample())
    return contenders


def measure(contenders, seconds, slice_seconds=0.5):
    """Steps per second of every contender: {name: [one figure per round]}."""
    rates = {name: [] for name in contenders}
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for name, contender in contenders.items():
            actions = [contender.sample() for _ in range(8)]
            count, begun = 0, time.perf_counter()
            while (spent := time.perf_counter() - begun) < slice_seconds:
                contender.step(actions[count % len(actions)])
                count += 1
            options = getattr(getattr(contender, "env", None), "setting", None)
            per_step = contender.num_envs * (options.option_steps if options else 1)
            rates[name].append(count * per_step / spent)
    return rates


def report(rates):
    """Best and median, and the median of what share each round reached of the same arena's physics alone."""
    field, maze = (np.array(rates[name]) for name in ALONE)
    return {
        name: {
            "best": round(max(values)),
            "median": round(float(np.median(values))),
            "share": round(float(np.median(np.array(values) / (maze if "aze" in name else field))), 3),
            "rounds": len(values),
        }
        for name, values in rates.items()
    }


def main():
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--masters", action="store_true", help="AntMazeOptions-v0 too, in control steps")
    args = parser.parse_args()
    contenders = prepare(args.masters)
    print(json.dumps(report(measure(contenders, args.seconds)), indent=2))
    for contender in contenders.values():
        contender.close()


if __name__ == "__main__":
    main()
