"""Draws docs/ant/calibration.png from the measured JSON files: PyBullet's ant beside ours.

python tools/ant_calibration/figures.py
"""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

HERE = Path(__file__).resolve().parents[2] / "docs" / "ant"
ENGINES = (  # file, legend, short legend, colour, line
    ("bullet", "PyBullet", "PyBullet", "black", "-"),
    ("mujoco_calibrated", "MuJoCo, row bullet (2 substeps)", "bullet", "tab:blue", "-"),
    ("mujoco_calibrated_4_substeps", "the same, 4 substeps", "4 substeps", "tab:cyan", "--"),
    ("mujoco_heavy", "MuJoCo, row heavy", "heavy", "tab:green", "-."),
    ("mujoco_stiff", "MuJoCo's default limits", "default", "tab:red", ":"),
)
DT = 0.0165


def series(axis, results, read, title, unit, step=DT):
    for name, label, _, colour, line in ENGINES:
        values = np.array(read(results[name]))
        axis.plot(np.arange(1, len(values) + 1) * step, values, line, color=colour, label=label)
    axis.set_title(title, fontsize=9)
    axis.set_xlabel("s", fontsize=8)
    axis.set_ylabel(unit, fontsize=8)


def quantiles(axis, results, part, key, title, unit):
    """Boxes from the 5, 25, 50, 75, 95 % quantiles."""
    boxes = []
    for name, *_ in ENGINES:
        low, q1, middle, q3, high = results[name][part][key]
        boxes.append({"whislo": low, "q1": q1, "med": middle, "q3": q3, "whishi": high})
    drawn = axis.bxp(boxes, showfliers=False, patch_artist=True)
    for box, (_, _, _, colour, _) in zip(drawn["boxes"], ENGINES, strict=True):
        box.set_facecolor(colour)
        box.set_alpha(0.4)
    axis.set_xticks(range(1, len(ENGINES) + 1), [row[2] for row in ENGINES], fontsize=7)
    axis.set_title(title, fontsize=9)
    axis.set_ylabel(unit, fontsize=8)


def case(result, joint, start, torque):
    wanted = (joint, start, torque)
    return next(r["deg"] for r in result["limits"] if (r["joint"], r["start"], r["torque"]) == wanted)


def main():
    results = {name: json.loads((HERE / f"{name}.json").read_text(encoding="utf-8")) for name, *_ in ENGINES}
    figure, axes = plt.subplots(3, 4, figsize=(15, 9))
    a = axes.flat
    series(a[0], results, lambda r: r["zero_torque"]["z_mean"], "(a) zero torque: torso height", "m")
    series(a[1], results, lambda r: r["zero_torque"]["ankle_deg_mean"], "(a) zero torque: ankles", "deg")
    series(a[2], results, lambda r: r["random_torque"]["alive_share"], "(b) random torque: alive", "share", 10 * DT)
    series(a[3], results, lambda r: r["random_held_10"]["alive_share"], "(b) held 10 steps: alive", "share", 10 * DT)
    quantiles(a[4], results, "random_torque", "z_quantiles_late", "(b) random torque: height, 5..95 %", "m")
    quantiles(a[5], results, "random_held_10", "z_quantiles_late", "(b) held 10 steps: height", "m")
    quantiles(a[6], results, "random_held_10", "ankle_deg_quantiles_late", "(b) held 10 steps: ankles", "deg")
    quantiles(a[7], results, "random_bang_20", "z_quantiles_late", "(b) +-1 held 20 steps: height", "m")
    for axis, (joint, start, torque, title) in zip(
        a[8:11],
        (
            ("ankle", "below by 0.3", 0.0, "(c) ankle released 17 deg outside"),
            ("ankle", "below by 0.3", -0.5, "(c) ankle pushed outwards from outside"),
            ("hip", "middle", 1.0, "(c) hip driven into its limit at full torque"),
        ),
        strict=True,
    ):
        series(axis, results, lambda r, c=(joint, start, torque): case(r, *c), title, "deg", 3 * DT)
    a[10].axhline(40, color="grey", linewidth=0.5)
    series(a[11], results, lambda r: r["sliding"]["speed_x"], "(d) flat ant thrown at 2 m/s", "m/s")
    for axis in a:
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.25)
    a[0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(HERE / "calibration.png", dpi=80)


if __name__ == "__main__":
    main()
