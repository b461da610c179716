"""``footwork parity``: figures that must come out as they do, what is refused, and that the report is whole."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np
import pytest

from footwork import physics as engines
from footwork.arena import DEFAULT_MAZE, inside_walls
from footwork.doors.cli import run
from footwork.robot import ROBOTS
from footwork.study import parity
from footwork.study.parity import QUICK, Ant, Parity, body, read_curves, wander
from footwork.study.parity_page import write_parity
from footwork.study.runs import train_row
from test_train import tiny

slow = pytest.mark.skipif(os.environ.get("FOOTWORK_SLOW") != "1", reason="takes minutes: FOOTWORK_SLOW=1 runs it")

SHIPPED, QUIRKY, LIGHT = (Ant("mujoco", robot) for robot in ("heavy", "bullet", "light"))


def test_a_felt_inertia_shows_an_armature_and_a_mass():
    heavy, quirky, light = (body(ant) for ant in (SHIPPED, QUIRKY, LIGHT))
    assert heavy["mass_kg"]["ant"] == pytest.approx(200 * light["mass_kg"]["ant"])
    legs = 4 * (heavy["mass_kg"]["thigh"] + heavy["mass_kg"]["shin"])
    assert heavy["mass_kg"]["torso"] + legs == pytest.approx(heavy["mass_kg"]["ant"])
    for part in ("hip", "ankle"):  # what is added to all joints of a free ant adds to each at least as much
        added = getattr(ROBOTS["bullet"], f"{part}_armature") - getattr(ROBOTS["heavy"], f"{part}_armature")
        assert quirky[f"{part}_inertia"] - heavy[f"{part}_inertia"] > 0.99 * added
    assert light["hip_inertia"] > 1.0  # almost nothing but its armature


def test_pybullet_reads_the_same_ant():
    pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'footwork[bullet]'")
    theirs, ours = body(parity.REFERENCE), body(SHIPPED)
    assert theirs["mass_kg"] == pytest.approx(ours["mass_kg"], rel=1e-3)
    for part, limits in ours["limits_deg"].items():
        assert theirs["limits_deg"][part] == pytest.approx(limits, abs=0.1)
    assert theirs["ankle_inertia"] > 1.5 * ours["ankle_inertia"]  # docs/ant.md: its ankles are slower


def test_without_torque_the_heavy_ant_drops_flat():
    """docs/ant.md: fallen at step 19."""
    figures = wander(SHIPPED, 30)["zero"]
    assert figures["alive"] == 0.0
    assert 15 <= figures["fallen_at"] <= 25
    assert figures["upside_down"] == 0.0


def test_places_beside_walls_are_beside_walls():
    places = parity.beside_walls(DEFAULT_MAZE, np.random.default_rng(0))
    assert places.shape == (parity.ROWS, 2)
    assert not inside_walls(DEFAULT_MAZE, places, 1.15).any()
    assert inside_walls(DEFAULT_MAZE, places, 1.65).all()


def test_curves_are_found_by_engine(tmp_path):
    train_row(tiny("walker/plain", 2), (0,), tmp_path)
    train_row(tiny("walker/symmetric", 1), (0,), tmp_path)
    curves = read_curves(tmp_path, print)
    assert list(curves) == ["mujoco"]
    (curve,) = curves["mujoco"]
    assert curve["step"] == [12, 24]
    assert len(curve["speed_mps"]) == 2
    assert len(curve["last_mps"]) == 4


def test_the_report_names_what_is_skipped_and_is_whole(tmp_path, monkeypatch):
    """On the engine that is always there; the others are as if they were not installed."""
    monkeypatch.setattr(engines, "find_spec", lambda name: None)
    monkeypatch.setattr(parity, "ANTS", (parity.REFERENCE, SHIPPED, parity.DEVICE))
    monkeypatch.setattr(parity, "race", lambda *arguments: ({}, {}))
    monkeypatch.setattr(parity, "handover", lambda *arguments: {"straight_mps": 1.0, "success": 0.5})
    said = []
    work = Parity(replace(QUICK, episode=3), None, said.append)
    work.run()
    assert work.complete
    assert set(work.found["skipped"]) == {"bullet/heavy", "mjx/heavy"}
    assert any("footwork[mjx]" in line for line in said)
    files = {path.name for path in write_parity(work.found, tmp_path / "report")}
    assert files == {"parity.json", "parity.png", "PARITY.md"}
    page = (tmp_path / "report" / "PARITY.md").read_text()
    assert "footwork[bullet]" in page
    assert "`mujoco/heavy`" in page
    assert "single control step" not in page
    assert json.loads((tmp_path / "report" / "parity.json").read_text())["complete"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--states", "0"], "states must be >= 1"),
        (["--curves", "nowhere"], "no folder of runs at nowhere"),
        (["--to", __file__], "is not a folder"),
    ],
)
def test_bad_arguments_are_refused_at_the_door(arguments, message, capsys):
    assert run(["parity", *arguments]) == 1
    assert message in capsys.readouterr().err


@slow
def test_a_quick_run_measures_every_engine_that_is_installed(tmp_path, capsys):
    assert run(["parity", "--quick", "--to", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "parity.json").read_text())
    names = [ant.name for ant in parity.ANTS if ant.name not in found["skipped"]]
    assert list(found["bodies"]) == list(found["statistics"]) == list(found["speed"]) == names
    for figures in found.get("single_steps", {}).values():
        assert figures["bits_equal"] >= parity.BITS_ASKED
