"""Identification of whole systems: exact without noise, honest with it, and plain about what the data show."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.simulation import simulated
from nsde_torch.sysid.guard import Guarded, Objection
from nsde_torch.sysid.identify import identify, identify_in_loop
from nsde_torch.sysid.result import Identification
from nsde_torch.systems import MACHINES, System, make_plant_system, make_system
from nsde_torch.systems.parameters import ParameterVector
from nsde_torch.training.fit_sysid import summary

OPTIONS: dict[str, dict[str, Any]] = {
    "mass_spring_damper": {"force": "multisine"},
    "cartpole": {"durations": [4.0] * 6},
    "hexacopter": {"durations": [10.0] * 2},
}


@cache
def runs_of(name: str, noise: float) -> tuple[Run, ...]:
    """Runs of a plant, every effect of which the declared physics has."""
    process = noise if MACHINES[name].gusts else 1.0
    return tuple(simulated(name, seed=0, sensor_noise=noise, process_noise=process, **OPTIONS[name]).runs)


def declared(name: str) -> System:
    return make_system(name, effects=list(MACHINES[name].effects))


def truth(name: str) -> np.ndarray:
    return ParameterVector(make_plant_system(name)).start


@pytest.mark.parametrize("name", ["mass_spring_damper", "cartpole", "hexacopter"])
def test_without_noise_parameters_are_exact(name: str) -> None:
    system = declared(name)
    before = ParameterVector(system).start
    found = identify(system, runs_of(name, 0.0))
    np.testing.assert_allclose(found.values, truth(name), rtol=1e-3)
    assert found.converged
    assert found.linear == (name == "mass_spring_damper")
    assert found.shown.rank == len(found.vector)
    assert found.unexplained < 1e-3
    np.testing.assert_array_equal(ParameterVector(system).start, before)


def test_the_mass_is_not_shown_by_a_spring_without_force() -> None:
    data = simulated("mass_spring_damper", seed=0)
    found = identify(make_system("mass_spring_damper"), data.runs)
    assert found.shown.rank == 2
    assert found.findings == ["force_gain: nothing in the data depends on it"]
    at = found.vector.labels.index("force_gain")
    assert np.isnan(found.standard_errors[at])
    assert found.values[at] == found.vector.start[at]
    assert found.parameters()["force_gain"]["half_width_90"] == [None]
    assert found.as_dict()["estimates"]["force_gain"]["interval_95"] is None


def test_gain_and_offset_of_the_thrust_are_only_known_together_in_hover() -> None:
    t = 0.01 * np.arange(800)
    x = np.zeros((len(t), 13))
    x[:, 6] = 1.0
    x[:, 12] = 0.3 * np.sin(2.0 * t)  # it yaws a little, so that something moves
    u = np.full((len(t), 6), 0.39)
    u[:, [0, 2, 5]] += 0.02 * np.cos(2.0 * t)[:, None]
    u[:, [1, 3, 4]] -= 0.02 * np.cos(2.0 * t)[:, None]
    x += 1e-3 * np.random.default_rng(0).normal(size=x.shape)
    found = identify(make_system("hexacopter"), [Run("hover", t, x, u)])
    assert any("thrust_gain and thrust_offset: only together" in said for said in found.findings)
    assert any(said.startswith("roll_gain: nothing") for said in found.findings)


def test_estimates_stay_inside_their_bounds() -> None:
    """A spring without damping: in half of the recordings the best damping would be negative."""
    t = 0.01 * np.arange(1500)
    truth = np.stack([0.1 * np.cos(t), -0.1 * np.sin(t)], 1)
    at_bound = 0
    for seed in range(6):
        noise = np.random.default_rng(seed).normal(size=truth.shape) * [0.005, 0.01]
        run = Run("r", t, truth + noise, np.zeros((len(t), 1)))
        found = identify(make_system("mass_spring_damper"), [run])
        values = dict(zip(found.vector.labels, found.values, strict=True))
        assert 0 < values["viscous_friction.damping"] < 0.03
        assert abs(values["linear_spring.stiffness"] - 1.0) < 0.02
        at_bound += values["viscous_friction.damping"] < 1e-5
    assert 1 <= at_bound <= 5


def test_nothing_reaches_across_a_gap() -> None:
    """The state jumps over the gap: the same rows without the gap would give another stiffness."""
    run, other, *_ = runs_of("mass_spring_damper", 0.0)
    n = len(run)
    t = np.concatenate((run.t, run.t[-1] + 0.5 + other.t))
    x, u = np.vstack((run.x, other.x)), np.vstack((run.u, other.u))
    both = Run("both", t, x, u, segments=((0, n), (n, n + len(other))))
    split = identify(declared("mass_spring_damper"), [both])
    np.testing.assert_allclose(split.values, truth("mass_spring_damper"), rtol=1e-6)
    unsplit = replace(both, t=0.01 * np.arange(len(t)), segments=())
    blind = identify(declared("mass_spring_damper"), [unsplit])
    assert np.abs(blind.values - truth("mass_spring_damper")).max() > 0.01


def test_a_clock_that_runs_wrong_is_taken_into_account() -> None:
    slow = [Run(r.name, r.t / 1.05, r.x, r.u) for r in runs_of("cartpole", 0.0)]
    found = identify(declared("cartpole"), slow, clock=1.05)
    np.testing.assert_allclose(found.values, truth("cartpole"), rtol=1e-3)


@pytest.mark.parametrize("name", ["mass_spring_damper", "cartpole"])
def test_finite_differences_come_near_without_noise_and_have_no_law_of_noise(name: str) -> None:
    found = identify(declared(name), runs_of(name, 0.0), method="differences")
    assert found.method == "differences"
    np.testing.assert_allclose(found.values, truth(name), rtol=0.02)
    assert all(channel.noise is None for channel in found.channels)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"iterations": 0}, "`max_iterations` must be at least 1"),
        ({"method": "magic"}, "`method` must be weak or differences"),
        ({"width": 0.001}, r"`model\.width`"),
    ],
)
def test_options_that_cannot_be_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        identify(make_system("mass_spring_damper"), runs_of("mass_spring_damper", 1.0), **options)
    with pytest.raises(DataError, match="no run"):
        identify(make_system("mass_spring_damper"), [])


@pytest.mark.parametrize("size", [1e-9, 1e-4])
def test_inputs_too_small_to_show_anything_leave_no_interval_and_no_error(size: float) -> None:
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(500)
    q = 1e-3 * np.cumsum(np.cumsum(rng.normal(size=(2, 500)), axis=1), axis=1)
    runs = [
        Run(str(i), t, np.stack((q[i], np.gradient(q[i], t)), 1), size * np.sin(t)[:, None]) for i in range(2)
    ]
    found = identify_in_loop(make_system("mass_spring_damper", declared=[]), runs)
    assert found.shown.rank == 0
    assert np.isnan(found.standard_errors).all()
    assert found.findings == ["force_gain: nothing in the data depends on it"]


def test_a_log_in_which_nothing_moves_is_refused_with_its_columns() -> None:
    rest = np.repeat([[0.2, 0.0]], 300, axis=0)
    run = Run("still", 0.01 * np.arange(300), rest, np.full((300, 1), 0.5))
    words = (
        r"nothing moves: q, q_dot never change\. .* write what the sensors .* Record runs in which the mach"
    )
    with pytest.raises(DataError, match=words):
        identify(make_system("mass_spring_damper"), [run])


@pytest.fixture(scope="module")
def found() -> Identification:
    return identify(make_system("mass_spring_damper"), runs_of("mass_spring_damper", 1.0))


def test_no_interval_is_given_for_a_fit_that_had_not_settled(found: Identification) -> None:
    assert np.isfinite(found.half_widths(0.9)).all()
    unsettled = replace(found, converged=False)
    assert np.isnan(unsettled.half_widths(0.9)).all()
    assert all(p["half_width_90"] == [None] * len(p["value"]) for p in unsettled.parameters().values())  # type: ignore[arg-type]
    notes = [{p.get("note") for p in one.parameters().values()} for one in (unsettled, found)]
    assert notes == [{"no interval: the fit had not settled"}, {None}]
    assert any("no interval is given" in line for line in unsettled.findings)
    assert "had not settled" in summary(unsettled)


def test_no_interval_is_given_for_a_fit_that_the_guard_speaks_against(found: Identification) -> None:
    assert not found.warnings
    told = replace(
        found, guard=Guarded((Objection("worse", "it leaves more than was measured", "look at it"),))
    )
    assert np.isnan(told.half_widths(0.9)).all()
    assert told.warnings[0] == "it leaves more than was measured; look at it"
    assert "no interval is given" in summary(told)
    assert "rejected" in summary(told)
