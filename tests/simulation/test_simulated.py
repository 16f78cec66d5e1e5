"""The built-in data sets: flights, episodes, springs, the checks that files pass, and the cache that keeps them."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nsde_torch.simulation.registry as registry
from nsde_torch.data import DataSet
from nsde_torch.errors import ConfigError
from nsde_torch.simulation import cartpole_episodes, simulated, spring_runs
from nsde_torch.simulation.flights import START, TARGETS, Pilot, attained, figures
from nsde_torch.systems import Hexacopter

FIGURES = (
    *("speed_q95_m_per_s", "speed_max_m_per_s", "roll_q95_deg", "roll_max_deg"),
    *("pitch_q95_deg", "pitch_max_deg", "yaw_q95_deg", "yaw_max_deg"),
)


def off(envelope: Mapping[str, float] | None) -> dict[str, float]:
    """Figures of the envelope over those of the supplement's Figure 15."""
    assert envelope is not None
    return {name: envelope[name] / target for name, target in zip(FIGURES, TARGETS, strict=True)}


@pytest.fixture(scope="module")
def flights() -> DataSet:
    return simulated("hexacopter", use_cache=False)


def _is_a_manual_flight(data: DataSet) -> None:
    assert [round(run.duration) for run in data.runs] == [73, 66, 64]
    assert data.kind == "simulated"
    assert data.clock_scale == 1.0
    assert all(len(run.segments) == 1 for run in data.runs)
    assert {f.kind for f in data.summary.findings} == {"rank_deficient_inputs"}
    for run in data.runs:
        assert run.u.min() >= 0.0
        assert run.u.max() <= 1.0
        assert np.abs(run.x[:, :3]).max() < 4.0
        assert run.x[:, 2].min() > 0.2
        assert np.linalg.norm(run.x[[0, -1], 3:6], axis=1).max() < 0.5


@pytest.mark.slow
def test_the_default_flights_have_the_envelope_of_figure_15(flights: DataSet) -> None:
    _is_a_manual_flight(flights)
    assert off(flights.summary.envelope) == pytest.approx(dict.fromkeys(FIGURES, 1.0), abs=0.1)
    assert flights.summary.input_rank.rank == 4
    hover = np.median(np.concatenate([run.u for run in flights.runs]))
    assert 0.35 < hover < 0.45


def test_a_short_flight_of_a_quadrotor_with_an_effect_stays_in_the_room_and_is_repeatable() -> None:
    settings = {"durations": [3.0, 2.5], "seed": 3, "effects": ["quadratic_drag"], "use_cache": False}
    settings |= {"variants": 4, "rounds": 1}
    a, b = (simulated("quadrotor", **settings) for _ in range(2))  # type: ignore[arg-type]
    assert a.names == ("flight_0", "flight_1")
    assert a.fingerprint == b.fingerprint
    assert a[0].x.shape == (301, 13)
    assert a[1].u.shape == (251, 4)
    assert np.abs(a[0].x[:, :3]).max() < 4.0


@pytest.mark.parametrize("seed", range(2))
def test_a_rehearsal_reaches_the_quantiles_of_any_seed(seed: int) -> None:
    pilot = Pilot([73.0, 66.0, 64.0], dt=0.01, seed=seed)
    paths = pilot.paths(pilot.rehearse(START, pilot.targets))
    found = figures(np.concatenate([attained(path) for path in paths], axis=1))
    np.testing.assert_allclose(found[::2] / pilot.targets[::2], 1.0, atol=0.03)
    np.testing.assert_allclose(found[1::2] / pilot.targets[1::2], 1.0, atol=0.2)


@pytest.mark.slow
def test_the_swing_up_brings_every_pole_upright_and_random_pushes_do_not() -> None:
    def upright(policy: str) -> float:
        runs = cartpole_episodes(durations=[8.0] * 12, seed=1, policy=policy)
        return float(np.mean([np.cos(run.x[-25:, 2]).min() > 0.9 for run in runs]))

    assert upright("on_policy") == 1.0
    assert upright("random") < 0.5


def test_episodes_start_where_the_supplement_starts_them_and_push_within_25_newtons() -> None:
    data = simulated("cartpole", use_cache=False, sensor_noise=0.0)
    assert len(data) == 20
    start = np.stack([run.x[0] for run in data.runs])
    low, high = [-1, -1, np.pi - 0.8, -0.8], [1, 1, np.pi + 0.8, 0.8]
    assert (start >= low).all()
    assert (start <= high).all()
    assert max(np.abs(run.u).max() for run in data.runs) <= 25.0


def test_springs_start_in_the_region_and_carry_the_noise_of_the_supplement() -> None:
    clean = simulated("mass_spring_damper", use_cache=False, sensor_noise=0.0)
    noisy = simulated("mass_spring_damper", use_cache=False)
    assert [len(run) for run in clean.runs] == [501] * 5
    assert max(np.abs(run.x[0]).max() for run in clean.runs) <= 0.1
    assert all(not run.u.any() for run in clean.runs)
    difference = np.concatenate([a.x - b.x for a, b in zip(clean.runs, noisy.runs, strict=True)])
    assert difference.std(0).tolist() == pytest.approx([0.005, 0.01], rel=0.05)


class Mine(Hexacopter):  # type: ignore[misc]
    name = "mine"


def test_a_system_of_the_users_own_has_no_plant_and_the_remedy_is_named() -> None:
    with pytest.raises(ConfigError, match=r"'mine' has no plant.*data=csv data.path=FOLDER"):
        simulated(Mine())
    with pytest.raises(ConfigError, match="no module 'package'"):
        simulated("package.module:Class")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"durations": []}, "`durations`"),
        ({"durations": [-1.0]}, "`durations`"),
        ({"durations": [1e-3]}, "`durations`"),
        ({"seed": -1}, "`seed`"),
        ({"process_noise": -1.0}, "`process_noise`"),
        ({"sensor_noise": float("nan")}, "`sensor_noise`"),
        ({"effects": ["linear_drag"]}, "does not act on system"),
        ({"effects": [{"viscous_friction": 0.3}]}, "takes"),
        ({"effects": [{"viscous_friction": {"daming": 0.3}}]}, "no parameter 'daming'"),
        ({"policy": "random"}, "policy"),
        ({"force": "square"}, "`force` must be one of"),
        ({"region": [[0.1, -0.1], [0, 1]]}, "`region`"),
        ({"system": "cartpole", "policy": "drunk"}, "`policy` must be one of"),
        ({"system": "hexacopter", "durations": [1.0]}, "`durations` of flights"),
    ],
)
def test_faults_of_the_caller_are_named(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        simulated(**{"system": "mass_spring_damper", "use_cache": False, **wrong})


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one for each simulation."""
    made: list[int] = []

    def counted(*args: object, **options: object) -> object:
        made.append(1)
        return spring_runs(*args, **options)  # type: ignore[arg-type]

    known = registry.RECORDINGS["mass_spring_damper"]
    monkeypatch.setitem(registry.RECORDINGS, "mass_spring_damper", replace(known, make=counted))
    return made


def test_a_second_call_reads_what_the_first_wrote(tmp_path: Path, calls: list[int]) -> None:
    first = simulated("mass_spring_damper", durations=[2.0], cache=tmp_path)
    second = simulated("mass_spring_damper", durations=[2.0], cache=tmp_path)
    assert len(calls) == 1
    assert first.fingerprint == second.fingerprint
    assert [p.suffix for p in tmp_path.iterdir()] == [".npz"]


@pytest.mark.parametrize(
    "other",
    [
        *({"seed": 1}, {"durations": [3.0]}, {"effects": []}, {"sensor_noise": 2.0}, {"process_noise": 0.0}),
        *({"force": "multisine"}, {"effects": {"coulomb_friction": None}}),  # the last names the same effect
    ],
)
def test_any_other_setting_is_simulated_anew_and_another_name_of_one_effect_is_none(
    tmp_path: Path, calls: list[int], other: dict[str, Any]
) -> None:
    setting: dict[str, Any] = {"cache": tmp_path, "effects": ["coulomb_friction"], "durations": [2.0]}
    simulated("mass_spring_damper", **setting)
    simulated("mass_spring_damper", **{**setting, **other})
    assert len(calls) == (1 if other.get("effects") else 2)


@pytest.mark.parametrize("damage", ["cut", "flipped", "pickle", "other"])
def test_a_damaged_entry_is_made_anew(tmp_path: Path, calls: list[int], damage: str) -> None:
    first = simulated("mass_spring_damper", durations=[2.0], cache=tmp_path)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    if damage == "pickle":
        np.savez(path, key=np.array([{"a": 1}], dtype=object))
    elif damage == "other":
        np.savez(path, key=np.array("another key"))
    else:
        half = len(whole) // 2
        flipped = whole[:half] + bytes((whole[half] ^ 0xFF,)) + whole[half + 1 :]
        path.write_bytes(whole[:half] if damage == "cut" else flipped)
    second = simulated("mass_spring_damper", durations=[2.0], cache=tmp_path)
    third = simulated("mass_spring_damper", durations=[2.0], cache=tmp_path)
    assert len(calls) == 2
    assert first.fingerprint == second.fingerprint == third.fingerprint
