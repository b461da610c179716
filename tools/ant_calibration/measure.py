"""What is measured on an ant, whatever engine moves it (numpy only: it runs in two environments).

An engine is a factory ``make(num_envs, gravity=True, held=False)`` of objects with

    reset(qpos [N,15], qvel [N,14]) -> (qpos, qvel, foot_contact)
    step(action [N,8] in [-1,1])    -> (qpos, qvel, foot_contact)     one control step of 0.0165 s

in MuJoCo's layout (position 3, quaternion wxyz 4, joints 8; velocities in the world frame, angular ones
in the torso frame). ``held`` fixes the torso where the reset puts it; ``gravity=False`` switches it off.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np

DT = 0.0165
FALL = 0.26
SIGN = np.array([1.0, -1.0, -1.0, 1.0])  # of the ankles
HIP, ANKLE = slice(7, 15, 2), slice(8, 15, 2)
DEG = np.pi / 180
RANGE = {"hip": (-40 * DEG, 40 * DEG), "ankle": (30 * DEG, 100 * DEG)}


def start(n, rng=None, z=0.75, hip=0.0, ankle=0.0, noise=0.1):
    """The reset of PyBullet's ant: joints at 0 (or at the given angles) +- noise, at rest."""
    qpos = np.zeros((n, 15))
    qpos[:, 2] = z
    qpos[:, 3] = 1.0
    qpos[:, HIP] = hip
    qpos[:, ANKLE] = ankle * SIGN
    if rng is not None:
        qpos[:, 7:] += rng.uniform(-noise, noise, (n, 8))
    return qpos, np.zeros((n, 14))


def rollout(ants, action, steps, n):
    """Arrays [T,N,...] of qpos, qvel and contacts; ``action`` is a function of the step."""
    qs, vs, cs = [], [], []
    for t in range(steps):
        q, v, c = ants.step(action(t))
        qs.append(np.array(q))
        vs.append(np.array(v))
        cs.append(np.array(c))
    return np.array(qs), np.array(vs), np.array(cs)


def up(qpos):
    """Z component of the torso's up vector."""
    return 1 - 2 * (qpos[..., 4] ** 2 + qpos[..., 5] ** 2)


def rounded(x, digits=4):
    return np.round(np.asarray(x, float), digits).tolist()


def zero_torque(make, n=32, steps=120):
    """(a) Dropped from the reset pose with no torque."""
    ants = make(n)
    ants.reset(*start(n, np.random.default_rng(0)))
    q, _, _ = rollout(ants, lambda t: np.zeros((n, 8)), steps, n)
    z = q[..., 2]
    fallen = np.where((z <= FALL).any(0), (z <= FALL).argmax(0) + 1, steps + 1)
    ankle = q[..., ANKLE] * SIGN / DEG
    return {
        "z_mean": rounded(z.mean(1)),
        "ankle_deg_mean": rounded(ankle.mean((1, 2)), 2),
        "ankle_deg_std": rounded(ankle.std((1, 2)), 2),
        "hip_deg_abs_mean": rounded(np.abs(q[..., HIP] / DEG).mean((1, 2)), 2),
        "fall_step_mean": float(fallen.mean()),
        "fall_step_range": [int(fallen.min()), int(fallen.max())],
        "fallen_share": float((fallen <= steps).mean()),
    }


def random_actions(rng, n, hold, bang):
    """A stateful action function: uniform or +-1, redrawn every ``hold`` steps (a range: per draw)."""
    current = np.zeros((n, 8))
    left = np.zeros(n, int)

    def act(t):
        redraw = left <= 0
        fresh = rng.uniform(-1, 1, (n, 8))
        if bang:
            fresh = np.sign(fresh)
        current[redraw] = fresh[redraw]
        left[redraw] = rng.integers(hold[0], hold[1] + 1, redraw.sum())
        left[:] -= 1
        return current.copy()

    return act


def random_torque(make, n=64, steps=1000, hold=(1, 1), bang=False, seed=1):
    """(b) Random torque from the reset pose; a fall ends an episode, its row goes on unseen."""
    rng = np.random.default_rng(seed)
    ants = make(n)
    ants.reset(*start(n, rng))
    began = time.perf_counter()
    q, v, c = rollout(ants, random_actions(rng, n, hold, bang), steps, n)
    seconds = time.perf_counter() - began
    z = q[..., 2]
    alive = np.logical_and.accumulate(z > FALL, axis=0)
    zz = np.where(alive, z, np.nan)
    late = alive.copy()
    late[:200] = False
    ankle = (q[..., ANKLE] * SIGN / DEG)[late]
    hip = (q[..., HIP] / DEG)[late]
    some = late.any()
    at_limit = 0.99 * 35
    quantiles = [5, 25, 50, 75, 95]
    with np.errstate(all="ignore"):
        speed = np.linalg.norm(v[..., :2], axis=-1)
        return {
            "alive_share": rounded(alive.mean(1)[9::10]),
            "z_q10_50_90": rounded([np.nanquantile(zz[9::10], p, axis=1) for p in (0.1, 0.5, 0.9)])
            if alive[-1].any()
            else None,
            "z_mean_late": float(z[late].mean()) if some else None,
            "z_quantiles_late": rounded(np.percentile(z[late], quantiles)) if some else None,
            "ankle_deg_quantiles_late": rounded(np.percentile(ankle, quantiles), 1) if some else None,
            "hip_deg_abs_quantiles_late": rounded(np.percentile(np.abs(hip), quantiles), 1) if some else None,
            "ankle_speed_rms": float(np.sqrt((v[..., 7::2][late] ** 2).mean())) if some else None,
            "hip_speed_rms": float(np.sqrt((v[..., 6::2][late] ** 2).mean())) if some else None,
            "joints_at_limit": float((np.abs(ankle - 65) > at_limit).mean() * 4 + (np.abs(hip) > 0.99 * 40).mean() * 4)
            if some
            else None,
            "feet_on_floor": float(c[late].mean()) if some else None,
            "torso_speed_mean": float(speed[late].mean()) if some else None,
            "alive_at_end": float(alive[-1].mean()),
            "upside_down_at_end_all": float((up(q[-1]) < 0).mean()),
            "distance_alive_median_m": float(np.median(np.linalg.norm(q[-1, :, :2], axis=-1)[alive[-1]]))
            if alive[-1].any()
            else None,
            "seconds": round(seconds, 2),
        }


def limits(make):
    """(c) One joint of leg 1 pushed against, beyond and back from its limits; torso held, no gravity."""
    cases = []
    for joint, (low, high) in RANGE.items():
        mid = (low + high) / 2
        for label, angle in (("middle", mid), ("below by 0.3", low - 0.3), ("above by 0.3", high + 0.3)):
            for torque in (-1.0, -0.5, -0.1, 0.0, 0.1, 0.5, 1.0):
                cases.append((joint, label, angle, torque))
    n = len(cases)
    qpos, qvel = start(n, z=3.0, ankle=65 * DEG)
    action = np.zeros((n, 8))
    for i, (joint, _, angle, torque) in enumerate(cases):
        column = 0 if joint == "hip" else 1
        qpos[i, 7 + column] = angle
        action[i, column] = torque
    ants = make(n, gravity=False, held=True)
    ants.reset(qpos, qvel)
    q, _, _ = rollout(ants, lambda t: action, 60, n)
    rows = []
    for i, (joint, label, _, torque) in enumerate(cases):
        low, high = RANGE[joint]
        path = q[:, i, 7 if joint == "hip" else 8]
        rows.append(
            {
                "joint": joint,
                "start": label,
                "torque": torque,
                "deg": rounded(path[::3] / DEG, 2),
                "past_limit_max_deg": round(float(max(path.max() - high, low - path.min()) / DEG), 3),
                "past_limit_end_deg": round(float(max(path[-1] - high, low - path[-1]) / DEG), 3),
            }
        )
    return rows


def sliding(make):
    """(d) The flat ant (joints at 0, torso on the floor) thrown at 2 m/s along x and along the diagonal."""
    ants = make(2)
    qpos, qvel = start(2, z=0.25)
    ants.reset(qpos, qvel)
    rollout(ants, lambda t: np.zeros((2, 8)), 20, 2)
    q, _, _ = ants.step(np.zeros((2, 8)))
    qvel[0, 0] = 2.0
    qvel[1, :2] = 2.0 / np.sqrt(2)
    ants.reset(np.array(q), qvel)
    q, v, _ = rollout(ants, lambda t: np.zeros((2, 8)), 40, 2)
    speed = np.linalg.norm(v[..., :2], axis=-1)
    out = {"speed_x": rounded(speed[:, 0]), "speed_diagonal": rounded(speed[:, 1])}
    for i, name in enumerate(("x", "diagonal")):
        moving = np.concatenate([[2.0], speed[:, i]])
        use = int((moving > 0.5).sum())
        slope = np.polyfit(np.arange(use) * DT, moving[:use], 1)[0] if use > 2 else np.nan
        out[f"friction_{name}"] = round(float(-slope / 9.8), 3)
        out[f"distance_{name}_m"] = round(float(np.linalg.norm(q[-1, i, :2])), 3)
    return out


def free_motion(make):
    """(e) Without gravity: joint speed decay, base speed decay, acceleration for a torque (torso held)."""
    ants = make(2, gravity=False, held=True)
    qpos, qvel = start(2, z=3.0, ankle=65 * DEG)
    qvel[0, 6] = 1.0
    qvel[1, 7] = 1.0
    ants.reset(qpos, qvel)
    _, v, _ = rollout(ants, lambda t: np.zeros((2, 8)), 24, 2)
    out = {
        "hip_speed_decay_per_s": round(float(-np.log(v[-1, 0, 6] / v[0, 0, 6]) / (23 * DT)), 4),
        "ankle_speed_decay_per_s": round(float(-np.log(v[-1, 1, 7] / v[0, 1, 7]) / (23 * DT)), 4),
    }
    ants.reset(qpos, np.zeros((2, 14)))
    action = np.zeros((2, 8))
    action[0, 0] = action[1, 1] = 0.04  # 10 N m
    _, v, _ = ants.step(action)
    out["hip_inertia"] = round(float(10.0 * DT / v[0, 6]), 4)
    out["ankle_inertia"] = round(float(10.0 * DT / v[1, 7]), 4)
    ants = make(2, gravity=False)
    qvel = np.zeros((2, 14))
    qvel[0, 0] = 1.0
    qvel[1, 5] = 0.3
    ants.reset(start(2, z=3.0, ankle=65 * DEG)[0], qvel)
    _, v, _ = rollout(ants, lambda t: np.zeros((2, 8)), 60, 2)
    out["base_linear_decay_per_s"] = round(float(-np.log(v[-1, 0, 0] / 1.0) / (60 * DT)), 4)
    return out


def lifting(make, steps=180):
    """(f) How strong the ankles are: flat on the floor at the lower limit of the ankles, all ankles push with u."""
    pushes = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0])
    n = len(pushes)
    ants = make(n)
    qpos, qvel = start(n, z=0.4, ankle=30 * DEG)
    ants.reset(qpos, qvel)
    rollout(ants, lambda t: np.zeros((n, 8)), 60, n)
    action = np.zeros((n, 8))
    action[:, 1::2] = pushes[:, None] * SIGN
    q, _, _ = rollout(ants, lambda t: action, steps, n)
    return {
        "push": pushes.tolist(),
        "z_end": rounded(q[-30:, :, 2].mean(0), 3),
        "z_max": rounded(q[..., 2].max(0), 3),
        "ankle_deg_end": rounded((q[-30:, :, ANKLE] * SIGN / DEG).mean((0, 2)), 1),
        "z": rounded(q[::6, :, 2].T, 3),
    }


GAITS = (  # amplitude hip, amplitude ankle, frequency Hz, ankle phase, ankle offset
    (0.5, 0.5, 1.5, np.pi / 2, 0.3),
    (0.5, 0.5, 1.5, -np.pi / 2, 0.3),
    (1.0, 1.0, 2.0, np.pi / 2, 0.3),
    (1.0, 1.0, 2.0, -np.pi / 2, 0.3),
    (1.0, 1.0, 3.0, np.pi / 2, 0.3),
    (1.0, 1.0, 3.0, -np.pi / 2, 0.3),
    (0.3, 1.0, 3.0, np.pi / 2, 0.2),
    (0.3, 1.0, 3.0, -np.pi / 2, 0.2),
)
PHASE = np.array([0.0, np.pi, 0.0, np.pi])  # trot


def gaits(make, per_gait=8, steps=600):
    """(g) Open-loop torque waves, the same for every engine: speed, height, falls."""
    g = np.repeat(np.array(GAITS), per_gait, axis=0)
    n = len(g)
    rng = np.random.default_rng(2)
    ants = make(n)
    ants.reset(*start(n, rng, z=0.6, ankle=60 * DEG))

    def act(t):
        phase = 2 * np.pi * g[:, 2:3] * t * DT + PHASE
        action = np.zeros((n, 8))
        action[:, 0::2] = g[:, 0:1] * np.sin(phase)
        action[:, 1::2] = (g[:, 1:2] * np.sin(phase + g[:, 3:4]) + g[:, 4:5]) * SIGN
        return np.clip(action, -1, 1)

    q, v, _ = rollout(ants, act, steps, n)
    distance = np.linalg.norm(q[-1, :, :2] - q[100, :, :2], axis=-1).reshape(-1, per_gait)
    shape = (steps, len(GAITS), per_gait)
    return {
        "speed_mps": rounded(distance.mean(1) / ((steps - 101) * DT), 3),
        "z_mean": rounded(q[100:, :, 2].reshape(steps - 100, len(GAITS), per_gait).mean((0, 2)), 3),
        "low_share": rounded((q[..., 2] <= FALL).any(0).reshape(-1, per_gait).mean(1), 3),
        "flipped_share": rounded((up(q[-1]) < 0).reshape(-1, per_gait).mean(1), 3),
        "instant_speed": rounded(np.linalg.norm(v[..., :2], axis=-1).reshape(shape)[100:].mean((0, 2)), 3),
    }


def everything(make, episodes=64):
    """All of it, as one JSON-able dict."""
    return {
        "zero_torque": zero_torque(make),
        "random_torque": random_torque(make, episodes),
        "random_held_10": random_torque(make, episodes, hold=(10, 10), seed=3),
        "random_bang_20": random_torque(make, episodes, hold=(20, 20), bang=True, seed=7),
        "limits": limits(make),
        "sliding": sliding(make),
        "free_motion": free_motion(make),
        "lifting": lifting(make),
        "gaits": gaits(make),
    }


def headline(r):
    """One screen."""
    a, b, h = r["zero_torque"], r["random_torque"], r["random_held_10"]
    print(
        f"(a) fall step {a['fall_step_mean']:.1f} {a['fall_step_range']} share {a['fallen_share']}; z20/60/120",
        [a["z_mean"][t - 1] for t in (20, 60, 120)],
        "ankle20/60/120",
        [a["ankle_deg_mean"][t - 1] for t in (20, 60, 120)],
        "hip120",
        a["hip_deg_abs_mean"][-1],
    )
    for name, x in (("(b)", b), ("(b10)", h)):
        print(name, {key: x[key] for key in x if key not in ("alive_share", "z_q10_50_90", "seconds")})
    for row in r["limits"]:
        if row["torque"] in (-1.0, -0.1, 0.0, 1.0):
            past = row["past_limit_max_deg"], row["past_limit_end_deg"]
            print("(c)", row["joint"], row["start"], row["torque"], "past limit, max and end:", past)
    d = r["sliding"]
    print("(d)", {k: d[k] for k in d if k[:5] != "speed"}, d["speed_x"][::5])
    print("(e)", r["free_motion"])
    f = r["lifting"]
    print("(f)", f["push"], "z", f["z_end"], "zmax", f["z_max"], "ankle", f["ankle_deg_end"])
    print("(g)", r["gaits"])


def save(path, result):
    """Writes the result as compact JSON, one key a line."""
    lines = ",\n".join(f"{json.dumps(k)}: {json.dumps(v, separators=(',', ':'))}" for k, v in result.items())
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text("{\n" + lines + "\n}\n", encoding="utf-8")
