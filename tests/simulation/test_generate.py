"""Data sets whose files do not say what is in them, and the truth beside."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nsde_torch.effects import effects_of
from nsde_torch.errors import ConfigError
from nsde_torch.recording import read
from nsde_torch.simulation.battery import FULL, LOAD
from nsde_torch.simulation.generate import Simulation, simulate, write
from nsde_torch.systems import MACHINES, make_plant_system, make_system, system_class

SHORT: dict[str, dict[str, Any]] = {
    "mass_spring_damper": {"durations": [2.0, 1.0]},
    "cartpole": {"durations": [1.0, 1.0]},
    "hexacopter": {"durations": [3.0], "options": {"variants": 12, "rounds": 1}},
}


def short(system: str, **settings: Any) -> Simulation:
    return simulate(system, **{**SHORT[system], "seed": 1, **settings})


@pytest.fixture(scope="module")
def flown() -> Simulation:
    """A short flight of the hexacopter."""
    return short("hexacopter")


def first(made: Simulation) -> np.ndarray:
    return made.runs[0].x


WHERE_IT_SHOWS: dict[str, Any] = {
    "actuator_saturation": {"hexacopter": {"level": 0.7}, "mass_spring_damper": {"level": 0.3}},
    "actuator_deadband": {"hexacopter": {"width": 0.02}},
}


@pytest.mark.parametrize("system", sorted(SHORT))
@pytest.mark.slow
def test_every_effect_of_the_catalogue_can_be_held_by_a_plant_and_changes_its_data(system: str) -> None:
    plain = short(system)
    there = {*make_system(system).effect_names, *MACHINES[system].effects}
    cls = system_class(system)
    there.add("position_bias[cart]")  # no equation knows where the cart is
    for name in set(effects_of(system, cls.ports, cls.bound_coordinates())) - there:
        made = short(system, effects=[{name: WHERE_IT_SHOWS.get(name, {}).get(system)}])
        assert name in made.truth["effects"]
        assert not np.array_equal(first(made), first(plain)), name


def test_files_hold_columns_and_nothing_that_tells(tmp_path: Path) -> None:
    made = short("mass_spring_damper", effects=[{"coulomb_friction": {"size": 0.2}}])
    files = write(made, tmp_path / "data")
    assert sorted(p.name for p in (tmp_path / "data").iterdir()) == ["run_0.csv", "run_1.csv"]
    assert files[-1] == tmp_path / "data.truth.json"
    lines = (tmp_path / "data" / "run_0.csv").read_text().splitlines()
    assert lines[0] == "t,q,q_dot,force"
    assert len(lines) == 1 + 201
    truth = json.loads(files[-1].read_text())
    assert truth["effects"]["coulomb_friction"]["parameters"] == {"size": 0.2, "width": 0.01}
    assert truth["effects"]["coulomb_friction"]["units"] == {"size": "m/s2", "width": "m/s"}
    assert truth["files"] == ["run_0.csv", "run_1.csv"]
    data = read("csv", make_system("mass_spring_damper"), path=tmp_path / "data")
    np.testing.assert_array_equal(data.runs[0].x, made.runs[0].x)


def test_a_wind_blows_against_the_drag_that_the_machine_has() -> None:
    system = make_plant_system("hexacopter", effects=[{"constant_wind": {"wind": [2.0, 0.0]}}])
    assert set(system.effect_names) == {"motor_lag", "constant_wind"}
    assert system.all_declared()["constant_wind.drag"][0].tolist() == pytest.approx([0.15, 0.15, 0.05])


def test_an_input_delay_is_a_pure_one() -> None:
    delay = 0.035
    options: dict[str, Any] = {"sensor_noise": 0.0, "durations": [3.0]}
    plain = short("mass_spring_damper", **options)
    late = short("mass_spring_damper", effects=[{"input_delay": {"delay": delay}}], **options)
    assert late.truth["effects"]["input_delay"]["parameters"]["delay"] == pytest.approx(delay, rel=0.02)
    # what a later force adds to the speed: the force itself, moved
    change = first(late)[1:40, 1] - first(plain)[1:40, 1]
    assert abs(change[3]) < abs(plain.runs[0].u[0, 0]) * 0.05
    assert "input_delay" not in make_plant_system("mass_spring_damper").effect_names


@pytest.mark.slow
def test_a_battery_falls_with_use_and_is_logged_where_asked(flown: Simulation) -> None:
    made = short("hexacopter", effects=["battery_voltage"], durations=[3.0, 3.0])
    unloaded = [run.extra["battery_voltage"] + LOAD * run.u.mean(1) for run in made.runs]
    assert pytest.approx(unloaded[0][0]) == FULL
    assert all(bool((np.diff(v) < 0).all()) for v in unloaded)
    assert unloaded[1][0] == pytest.approx(unloaded[0][-1], abs=0.01)
    assert "battery_voltage" in short("hexacopter", battery=True).runs[0].extra
    assert flown.runs[0].extra == {}
    with pytest.raises(ConfigError, match="battery"):
        short("cartpole", battery=True)


def test_nothing_is_written_over(tmp_path: Path) -> None:
    made = short("mass_spring_damper")
    write(made, tmp_path / "data")
    with pytest.raises(ConfigError, match="overwrite=true"):
        write(made, tmp_path / "data")
    write(short("mass_spring_damper", durations=[1.0]), tmp_path / "data", overwrite=True)
    assert [p.name for p in (tmp_path / "data").iterdir()] == ["run_0.csv"]
    with pytest.raises(ConfigError, match="outside"):
        write(made, tmp_path / "other", truth=tmp_path / "other" / "truth.json")
