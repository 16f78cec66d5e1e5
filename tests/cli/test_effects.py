"""`nsde effects`: the catalogue as a table and as JSON."""

import json
import re
from pathlib import Path

import pytest

from nsde_torch.cli.commands import effects
from nsde_torch.diagnosis.candidates import check_candidates
from nsde_torch.effects import EFFECTS
from nsde_torch.errors import ConfigError
from nsde_torch.systems import SYSTEMS, make_system
from tests.helpers.commands import Said


def test_every_effect_is_listed_with_what_a_user_needs(shown: Said) -> None:
    printed = shown("effects")
    out = " ".join(printed.split())
    for name, cls in EFFECTS.items():
        assert name in out
        assert all(f"{p}" in out for p in cls.PARAMETERS)
    assert "motor_efficiency_loss" in out
    assert "loss per input [1]" in out
    assert "memory: 2" in out  # the cell wraps behind it where names are long
    assert "reads battery_voltage" in out
    assert max(map(len, printed.splitlines())) <= 120


def test_a_system_lists_what_it_can_have(shown: Said) -> None:
    rows = {
        row["name"]: row for row in json.loads(shown("effects", "system=quadrotor", "format=json"))["effects"]
    }
    assert "motor_lag" in rows
    assert not {"actuator_lag", "track_tilt", "coulomb_friction"} & set(rows)
    assert rows["input_delay"]["memory_per_input"] == 2
    wind = {"name": "wind", "unit": "m/s", "low": None, "high": None, "axes": 2}
    assert rows["constant_wind"]["parameters"][1] == wind | {"help": "velocity of the air, east and north"}


def test_what_a_diagnosis_does_not_try_is_said_with_its_reason(shown: Said) -> None:
    for name in SYSTEMS:
        machine, able = make_system(name), []
        for row in effects.catalogue(name):
            if row["no_candidate"]:
                with pytest.raises(ConfigError, match=re.escape(row["no_candidate"])):
                    check_candidates(machine, [row["name"]])
            else:
                able.append(row["name"])
        check_candidates(machine, able)
    out = " ".join(shown("effects", "system=quadrotor").split())
    assert "no candidate of a diagnosis of this machine: thrust_sag is the same term" in out
    assert "a candidate of a diagnosis where the log has battery_voltage" in out


def test_a_machine_without_a_coordinate_is_told_of_the_line_that_adds_one(shown: Said, root: Path) -> None:
    out = shown("effects", "--config-dir", str(root / "examples" / "body_rates"), "system=body_rates")
    assert "no friction and no force is among the candidates" in out.lower()
    assert 'coordinates = (Coordinate("w_x", "w_x", Port.TORQUE, row=0), ' in out
    assert "Coordinate(" not in shown("effects", "system=cartpole")
    assert "Coordinate(" not in shown("effects", "system=quadrotor")
