"""Write docs/environments: one page per Gymnasium environment, its tables made from the code that computes.

python tools/environment_pages.py
"""

import dataclasses
import inspect
import re
from pathlib import Path

from footwork.arena import DIRECTIONS
from footwork.doors import settings
from footwork.robot import JOINT_NAMES
from footwork.tasks.terms import PENALISED_WEIGHTS, RewardWeights

DOCS = Path(__file__).parents[1] / "docs" / "environments"

TERMS = {
    "progress": "drop of the distance to the goal per second (m/s)",
    "alive": "+1 while the torso is above the fall height, -1 in a step where it is not",
    "electricity": "mean over joints of the action times 0.1 x joint speed, without sign",
    "stall_torque": "mean over joints of the squared action",
    "joints_at_limit": "number of joints at 99 % of a limit or beyond",
    "feet_collision": "number of feet that touch another foot",
    "flip": "1 in every step upside down",
    "goal": "1 in the step that comes within the goal radius",
}

PAGES = {
    "AntWalker-v0": (
        settings.ant_walker,
        "Walk in one direction, as fast as the costs of walking allow. The target lies 10 km away, never reached. "
        "This is the task of the paper's sub-policies (section 3.1). The goal is not observed: a policy learns its "
        "direction.",
    ),
    "AntBandit-v0": (
        settings.ant_bandit,
        "Reach one of the four corners of a square. Which one is drawn for each episode, uniformly, and observed.",
    ),
    "AntMaze-v0": (
        settings.ant_maze,
        "Find the way through a maze. Its walls are not observed, and neither is the goal, unless there are several: "
        "where it is must be learned. The default is a U lying on its side: the goal is 8 m north of the start, behind "
        "a wall.",
    ),
    "AntMazeOptions-v0": (
        settings.ant_maze_options,
        "AntMaze for a master: its action chooses which of four frozen sub-policies walks for the next `option_steps` "
        "control steps, and its reward is the sum of theirs (paper, section 4). An episode that ends within an option "
        "ends the step. No joint is ever reset.",
    ),
}

HISTORY = {
    name: ["v0: first version. Ant `heavy`, calibrated against PyBullet's ([docs/ant.md](../ant.md))."]
    for name in PAGES
}


def page(name):
    """The page of one environment."""
    make, about = PAGES[name]
    setting = make()
    parts = [
        "<!-- Made by tools/environment_pages.py: change that, or the code it reads. -->",
        f"# footwork/{name}",
        about,
        "```python\nimport gymnasium\nimport footwork\n\n"
        f'env = gymnasium.make("footwork/{name}")\n'
        f'envs = gymnasium.make_vec("footwork/{name}", 64, autoreset_mode="SameStep")\n```',
        "## Observation",
        *observation(setting),
        "## Action",
        *action(setting),
        "## Reward",
        *reward(name, setting),
        "## Episode end",
        *ends(setting),
        "## Info",
        *info(setting),
        "## Fields",
        "Keyword arguments of `gymnasium.make` and `make_vec`. `make_vec` also takes `autoreset_mode` (`NextStep`, the "
        "default, `SameStep` or `Disabled`), `num_threads` and `max_episode_steps`.",
        table(("field", "default", "meaning"), fields_of(name)),
        "## Versions",
        "\n".join(f"* {line}" for line in HISTORY[name]),
    ]
    return "\n\n".join(parts) + "\n"


def table(head, rows):
    """A table in Markdown."""
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines)


def observation(setting):
    """What is observed."""
    numbers = settings.observed(setting.task)
    rows = [(i, n.meaning, n.unit, f"{n.low:g} .. {n.high:g}") for i, n in enumerate(numbers)]
    yield f"`Box`, {len(numbers)} float32, clipped to their ranges."
    yield table(("index", "meaning", "unit", "range"), rows)
    if setting.task.name == "AntMaze" and setting.sub_policies is None:
        yield (
            "With several goals, the goal's x and y follow. With `goal_conditioned=True` the observation is a `Dict`: "
            "`observation` (the first 32 numbers), `achieved_goal` (x, y of the torso in m) and `desired_goal`; "
            "`compute_reward(achieved_goal, desired_goal, info)` gives the reward that is paid."
        )


def action(setting):
    """What is done."""
    if setting.sub_policies is not None:
        yield "`Discrete(4)`: the sub-policy that acts."
        yield table(("action", "direction"), list(enumerate(DIRECTIONS)))
        return
    robot = setting.task.robot
    torque = {"hip": robot.hip_torque, "ankle": robot.ankle_torque}
    yield "`Box`, 8 float32 in -1 .. 1. What lies outside is clipped for the motors; costs count it as it was given."
    rows = [(i, joint, f"{torque[joint.split('_')[0]]:g} N m at 1") for i, joint in enumerate(JOINT_NAMES)]
    yield table(("index", "joint", "torque"), rows)
    yield (
        "Legs are numbered counter-clockwise from (+x, +y) at heading zero. "
        f"A step is {1000 * robot.control_dt:g} ms; actions that are not finite are refused, naming their row."
    )


def reward(name, setting):
    """The terms and their weights."""
    weights = setting.task.weights
    variants = {"weight": weights}
    if name in ("AntBandit-v0", "AntMaze-v0"):
        variants["with `penalties=True`"] = dataclasses.replace(PENALISED_WEIGHTS, goal=weights.goal)
    rows = [
        (term, TERMS[term], *(f"{getattr(w, term):g}" for w in variants.values()))
        for term in (field.name for field in dataclasses.fields(RewardWeights))
    ]
    yield "The sum of these terms, each times its weight" + (
        ", over the whole option:" if setting.sub_policies else ":"
    )
    yield table(("term", "value", *variants), rows)
    if setting.has_goal:
        geodesic = setting.task.potential == "geodesic"
        said = f"The distance is {'the length of the shortest way around the walls' if geodesic else 'straight'}"
        if name != "AntBandit-v0":
            said += (
                " (`potential`). `reward='sparse'` pays 1 within the goal radius and else 0, `reward='dense'` minus "
                "the straight distance in m"
            )
        yield said + "."


def ends(setting):
    """When an episode is over."""
    task = setting.task
    falls = {
        "height": f"the torso is at {task.robot.fall_height:g} m or below",
        "flip": "the torso is upside down",
        "either": f"the torso is at {task.robot.fall_height:g} m or below, or upside down",
    }
    lines = []
    if task.fall_rule in falls:
        lines.append(f"terminated when {falls[task.fall_rule]} (`fall_rule`)")
    if task.goal_radius is not None:
        lines.append(f"terminated within {task.goal_radius:g} m of the goal (`goal_radius`)")
    lines.append(
        "terminated when the simulation fails; the row keeps its last finite state, and `info` says `diverged`"
    )
    seconds = task.episode_steps * task.robot.control_dt
    decisions = (
        f", which is {task.episode_steps // setting.option_steps} steps of a master" if setting.sub_policies else ""
    )
    lines.append(f"truncated after {task.episode_steps} control steps ({seconds:g} s){decisions} (`episode_steps`)")
    robot, (x, y) = task.robot, task.arena.start
    start = (
        f"It begins at rest {robot.reset_height:g} m above ({x:g}, {y:g}), joints within "
        f"+-{robot.reset_joint_noise:g} rad of their reset angles."
    )
    return ["\n".join(f"* {line}" for line in lines), start]


def info(setting):
    """What is said beside the reward."""
    rows = [(f"`reward_{term}`", f"the term `{term}`, weighted") for term in settings.term_names(setting.task)]
    if setting.has_goal:
        rows += [
            ("`success`", "within the goal radius"),
            ("`goal_distance`", "m, straight" + (", the smallest of the option" if setting.sub_policies else "")),
        ]
    rows += [
        ("`fallen`", "the torso is low"),
        ("`flipped`", "the torso is upside down"),
        ("`diverged`", "the simulation failed"),
        ("`x_position`, `y_position`", "of the torso, m; after `reset` too"),
    ]
    note = "Terms without weight are left out." + (
        " Flags are up if they were in any control step of the option." if setting.sub_policies else ""
    )
    return [table(("key", "meaning"), rows), note]


def fields_of(name):
    """Keyword arguments, their defaults and meanings, from the functions that read them."""
    make = PAGES[name][0]
    meanings = arguments(make)
    if make is settings.ant_maze_options:
        meanings = {**arguments(settings.ant_maze), **meanings}
    known = settings.known_fields(name.split("-", maxsplit=1)[0])
    return [(f"`{key}`", f"`{default!r}`", meanings[key]) for key, default in known.items()]


def arguments(function):
    """Name and meaning of each argument in a docstring."""
    section = inspect.getdoc(function).split("Args:\n")[1]
    found = re.findall(r"^    \**(\w+): (.*(?:\n        .*)*)", section, flags=re.MULTILINE)
    return {key: " ".join(meaning.split()).replace("``", "`") for key, meaning in found}


def main():
    """Write every page."""
    DOCS.mkdir(parents=True, exist_ok=True)
    for name in PAGES:
        (DOCS / f"{name}.md").write_text(page(name), encoding="utf-8")


if __name__ == "__main__":
    main()
