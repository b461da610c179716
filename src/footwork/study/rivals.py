"""Contestants of ``footwork bench`` as processes that answer, and among them the PPO that others use.

Run as a script, it trains Stable-Baselines3's PPO (or another library of its manner) with
Table 1's schedule, in any interpreter that has the library: nothing of Footwork is
imported here. :func:`serve` is what every contestant speaks, ours too (workers.py).
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import sys
import time
from collections.abc import Callable
from typing import Any

Measure = Callable[[float], dict[str, float]]

BATCH = 2048  # Table 1's S: steps of all environments together per update


def serve(build: Callable[[], Measure]) -> None:
    """Build, say so in a line of JSON, then answer every line read (seconds) with a line of what was measured.

    What cannot be imported is named in place of an answer. Libraries that print do so on standard error.
    """
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    try:
        measure = build()
    except ImportError as error:
        answers.write(json.dumps({"absent": error.name or str(error)}) + "\n")
        return
    answers.write(json.dumps({"peak_mb": peak_mb()}) + "\n")
    for line in sys.stdin:
        answers.write(json.dumps({**measure(float(line)), "peak_mb": peak_mb()}) + "\n")


def peak_mb() -> float:
    """The most memory this process ever held; ``ru_maxrss`` would count that of the process it was forked from."""
    try:
        with open("/proc/self/status") as status:
            return next(float(line.split()[1]) for line in status if line.startswith("VmHWM")) / 1024
    except (OSError, StopIteration):
        unit = 1024**2 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def repeat(step: Callable[[], float], seconds: float) -> dict[str, float]:
    """Call ``step`` for at least ``seconds``; how long that took, and the sum of what it returned."""
    begun, steps = time.perf_counter(), 0.0
    while steps == 0.0 or time.perf_counter() - begun < seconds:
        steps += step()
    return {"steps": steps, "seconds": time.perf_counter() - begun}


def ppo(library: str, task: str, num_envs: int, processes: bool) -> Measure:
    """Table 1's PPO; nets of 64-64 tanh are the default of these libraries."""
    learner = importlib.import_module(library).PPO
    if "Bullet" in task:
        task = f"pybullet_envs_gymnasium:{task}"  # who makes one, a process of its own too, imports what registers it
    make = importlib.import_module("stable_baselines3.common.env_util").make_vec_env
    kinds = importlib.import_module("stable_baselines3.common.vec_env")
    envs = make(task, num_envs, seed=0, vec_env_cls=kinds.SubprocVecEnv if processes else kinds.DummyVecEnv)
    model = learner(
        "MlpPolicy",
        envs,
        n_steps=BATCH // num_envs,
        batch_size=64,
        n_epochs=10,
        learning_rate=3e-4,
        gamma=0.99,
        gae_lambda=0.95,
        clip_range=0.2,
        vf_coef=0.5,
        seed=0,
        device="cpu",
    )
    model.learn(BATCH)

    def one_update() -> float:
        model.learn(BATCH, reset_num_timesteps=False)
        return BATCH

    return lambda seconds: repeat(one_update, seconds)


def main() -> None:
    """A contestant, as its command line describes it."""
    spec: dict[str, Any] = json.loads(sys.argv[1])
    serve(lambda: ppo(**spec))


if __name__ == "__main__":
    main()
