"""How many control steps per second an engine takes with many ants at once, on the device that JAX computes on.

    python tools/accelerator_rate.py [--engine mjx] [--task AntWalker] [--rows 1024] [--lock FILE]

One line of JSON: the time to build and compile, and the rate through the Physics protocol over five
rounds, by median, least and largest. Ants act at random, hold an action for ten control steps and are put
back after two hundred. Several of these may compile side by side and measure in turn: with one --lock.
"""

import argparse
import contextlib
import fcntl
import json
import statistics
import time

import jax
import numpy as np

from footwork.env import loop_over
from footwork.physics import ENGINES, physics_for
from footwork.study.experiments import ANT_MAZE, ANT_WALKER

TASKS = {task.name: task for task in (ANT_WALKER, ANT_MAZE)}
HOLD, PUT_BACK = 10, 200  # control steps
ROUNDS, ROUND_SECONDS = 5, 1.0


@contextlib.contextmanager
def turn(path):
    """Alone among those who name the same file."""
    if path is None:
        yield
        return
    with open(path, "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--engine", choices=ENGINES, default="mjx")
    parser.add_argument("--task", choices=TASKS, default=ANT_WALKER.name)
    parser.add_argument("--rows", type=int, default=1024)
    parser.add_argument("--lock")
    asked = parser.parse_args()
    task, begun = TASKS[asked.task], time.perf_counter()
    physics = physics_for(asked.engine, task.robot, task.arena, asked.rows)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (PUT_BACK // HOLD, asked.rows, 8)).astype(np.float32)
    if physics.traceable:
        actions = jax.numpy.asarray(actions)  # on the device already, as a policy's are
    hold = loop_over(physics, lambda carry, _: ((physics.step(carry[0], carry[1]), carry[1]), None))

    def episode():
        state = physics.initial()
        for action in actions:
            (state, _), _ = hold((state, action), np.arange(HOLD))
        jax.block_until_ready(state)
        return PUT_BACK * asked.rows

    jax.block_until_ready(hold((physics.initial(), actions[0]), np.arange(HOLD)))
    compiled, rates = time.perf_counter() - begun, []
    with turn(asked.lock):
        episode()
        for _ in range(ROUNDS):
            begun, steps = time.perf_counter(), 0
            while (spent := time.perf_counter() - begun) < ROUND_SECONDS:
                steps += episode()
            rates.append(steps / spent)
    physics.close()
    device = jax.devices()[0]
    found = {
        "device": f"{device.platform}: {device.device_kind}" if physics.traceable else "cpu",
        "engine": asked.engine,
        "task": asked.task,
        "rows": asked.rows,
        "start_s": round(compiled, 1),
        "control_steps_per_second": [round(f(rates)) for f in (statistics.median, min, max)],
    }
    print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
