"""Copy the first seed of each row's newest finished run into the package, and write beside them how they were made.

    python tools/package_weights.py --runs runs

Rows without a finished run keep what the package has. Sub-policies and flat policies go
without their critics, which nothing reads once they are trained.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import jax

from footwork import checkpoint
from footwork.record import config_to_json
from footwork.study.experiments import EXPERIMENTS
from footwork.study.runs import NEEDED, find_trained, finished_runs, load_policies, load_run

WEIGHTS = Path(__file__).parents[1] / "src" / "footwork" / "weights"
MAX_BYTES = 2_000_000


def package(row, runs):
    """Write one row's weights."""
    for run in finished_runs(row, runs):
        trained = load_run(run)
        _, meta = checkpoint.load_arrays(run.policy_path)
        if replace(trained.experiment, total_steps=EXPERIMENTS[row].total_steps) != EXPERIMENTS[row]:
            raise SystemExit(f"{run.path} was trained with other fields than the table's {row}")
        check_needed(trained, run, runs)
        params = jax.tree.map(lambda leaf: leaf[:1], trained.params)
        if not trained.experiment.is_master:
            params = {"actor": params["actor"]}
        experiment = config_to_json(trained.experiment)
        meta = {**meta, "seeds": list(trained.seeds[:1]), "batch": list(trained.seeds), "experiment": experiment}
        checkpoint.save(WEIGHTS / f"{row}.safetensors", params, meta)
        return


def check_needed(trained, run, runs):
    """A packaged master must stand on the sub-policies that are packaged."""
    if trained.experiment.is_master:
        kept = load_policies(run.path / NEEDED).params["actor"]
        found = find_trained(trained.experiment.needs, runs).params["actor"]
        same = jax.tree.map(lambda a, b: bool((a[0] == b[0]).all()), kept, found)
        if not all(jax.tree.leaves(same)):
            raise SystemExit(f"{run.path} stands on other policies than the newest {trained.experiment.needs}")


def describe():
    """The table of what the package holds."""
    lines = [
        "# Packaged weights",
        "",
        "Made by the project's own commands; the file of a row holds its whole config, seed and versions.",
        "",
        "| row | command | control steps per run | versions |",
        "|---|---|---|---|",
    ]
    for row in EXPERIMENTS:
        path = WEIGHTS / f"{row}.safetensors"
        if path.is_file():
            _, meta = checkpoint.load_arrays(path)
            versions = ", ".join(f"{name} {meta['versions'][name]}" for name in ("footwork", "jax", "mujoco"))
            steps = meta["steps"]
            command = f"footwork train {row} --seeds {' '.join(map(str, meta['batch']))}"
            if meta["experiment"]["total_steps"] != EXPERIMENTS[row].total_steps:
                command += f" --total-steps {json.dumps(meta['experiment']['total_steps'])}"
            lines.append(f"| {row} | `{command}` | {steps:,} | {versions} |")
    return "\n".join(lines) + "\n"


def main():
    """Package every row."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    runs = parser.parse_args().runs
    for row in EXPERIMENTS:
        if row.split("/")[1] != "paper":
            package(row, runs)
    (WEIGHTS / "README.md").write_text(describe(), encoding="utf-8")
    size = sum(path.stat().st_size for path in WEIGHTS.rglob("*.safetensors"))
    print(f"{size:,} bytes in {WEIGHTS.name}")
    if size > MAX_BYTES:
        raise SystemExit(f"more than {MAX_BYTES:,} bytes")


if __name__ == "__main__":
    main()
