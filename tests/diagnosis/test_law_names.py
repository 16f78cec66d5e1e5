"""A law that the catalogue has takes its name; one that it lacks keeps its own. Behind smoothers, no law is tried."""

from dataclasses import replace

import pytest
from scipy.signal import butter, filtfilt

import nsde_torch
from nsde_torch.diagnosis.beyond_catalogue import same_effect
from nsde_torch.diagnosis.candidates import joined
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.search import Search
from nsde_torch.simulation import simulate
from nsde_torch.systems import make_system
from nsde_torch.systems.vocabulary import vocabulary
from tests.helpers.diagnosed import recorded


@pytest.mark.parametrize(
    ("law", "values", "name"),
    [
        ("force = c1 q^3", {"c1": -2.0}, "cubic_stiffness"),
        ("force = c1 sign(q_dot, k1)", {"c1": -0.2, "k1": 0.05}, "coulomb_friction"),
        ("force = c1 q q_dot", {"c1": 0.8}, None),
    ],
)
def test_a_law_that_is_a_multiple_of_an_effect_takes_its_name(
    law: str, values: dict[str, float], name: str | None
) -> None:
    data, system = recorded("mass_spring_damper", {law: values}), make_system("mass_spring_damper")
    steps = Search(system, data.runs, 1.0, Options()).steps
    found = same_effect(steps, joined(system, law, {**values}), law)
    assert (found and found[0]) == name


@pytest.mark.slow
def test_behind_a_smoother_no_law_is_tried() -> None:
    law = {"force = c1 q q_dot": {"c1": 0.8}}
    made = simulate("mass_spring_damper", effects=[law], durations=(8.0,) * 4, seed=1)
    b, a = butter(2, 0.16)
    runs = [replace(run, x=filtfilt(b, a, run.x, axis=0)) for run in made.runs]
    found = nsde_torch.diagnose(runs, system="mass_spring_damper")
    assert all(run.band for run in found.data.runs)
    assert not [name for name in found.content()["added"] if "=" in name]


@pytest.mark.parametrize("machine", ["mass_spring_damper", "cartpole", "hexacopter", "quadrotor"])
@pytest.mark.slow
def test_a_law_is_compared_with_every_candidate_of_a_machine_within_its_bounds(machine: str) -> None:
    data, system = recorded(machine, durations=(2.0, 2.0)), make_system(machine)
    steps = Search(system, data.runs, 1.0, Options()).steps
    for port in system.residual_ports:
        row = dict(vocabulary(type(system)).ports)[port.value].names[0]
        place = f"[{row}]" if row else ""
        law = f"{port.value}{place} = c1 {system.state_names[-1]}^5"
        law = system.effect_key(law)
        assert same_effect(steps, system.with_effects(system.make_effect(law, {"c1": 1.0})), law) is None
