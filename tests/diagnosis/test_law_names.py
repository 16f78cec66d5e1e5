"""A law has one name, the catalogue's where it has one, and none beside what it contains or behind smoothers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, filtfilt

import nsde_torch
from nsde_torch.diagnosis.between_runs import reference
from nsde_torch.diagnosis.beyond_catalogue import same_effect, zero_of_an_input
from nsde_torch.diagnosis.candidates import candidate_names, effect_of, joined, starts, values_of
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.search import Search, fitted_system
from nsde_torch.effects import effect_class
from nsde_torch.inference.steps import data_sizes
from nsde_torch.simulation import simulate
from nsde_torch.systems import System, make_system
from tests.helpers.diagnosed import recorded
from tests.helpers.two_joints import HOME


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


SPRING = "mass_spring_damper"
FRICTION = {"coulomb_friction": {"size": 0.3, "width": 0.002}}
_FRICTIONS = ("asymmetric_friction", "coulomb_friction", "stribeck_friction")


def spring(*effects: str) -> System:
    return make_system(SPRING, effects=effects)


def test_a_spring_is_sought_where_none_is_declared() -> None:
    assert "linear_spring[cart]" in candidate_names(make_system("cartpole"))
    assert not [n for n in candidate_names(spring()) if n.startswith("linear_spring")]


def test_what_an_effect_contains_is_not_tried_beside_it() -> None:
    assert "coulomb_friction" in candidate_names(spring())
    assert "coulomb_friction" not in candidate_names(spring("asymmetric_friction"))
    assert "coulomb_friction" not in candidate_names(spring("stribeck_friction"))
    assert "asymmetric_friction" in candidate_names(spring("coulomb_friction"))


@pytest.mark.parametrize("name", ["asymmetric_friction", "stribeck_friction"])
def test_what_stands_in_for_an_effect_starts_as_that_effect(name: str) -> None:
    made = recorded(SPRING, FRICTION, seed=3, dt=0.02, durations=(6.0,) * 4)
    rubbing = Search(spring(), made.runs, 1.0, Options(candidates=_FRICTIONS))
    friction = spring().make_effect("coulomb_friction", FRICTION["coulomb_friction"])
    system = fitted_system(rubbing.quick(spring().with_effects(friction)))
    scales = data_sizes(system, rubbing.steps)
    begun = starts(system, name, scales, ())
    coulomb = effect_of(system, "coulomb_friction")
    size = values_of(coulomb)["size"]
    sizes = [own for own, theirs in effect_class(name).shared(type(coulomb)).items() if theirs == "size"]
    assert any(all(start[key] == pytest.approx(size) for key in sizes) for start in begun)
    assert len(begun) == len({tuple(map(str, start.items())) for start in begun})


@pytest.mark.parametrize(
    ("law", "said"),
    [
        ("torque[q1] = c1", "a zero that is off: what 0.3 N m more of tau1 would do"),
        ("torque[q1] = c1 q2", None),
    ],
)
def test_a_law_that_does_what_a_constant_in_an_input_does_says_so(law: str, said: str | None) -> None:
    plant = {"inputs": [0.1, 0.1], "noise": [0.01] * 4}
    data, system = recorded(HOME, durations=(4.0,), dt=0.01, plant=plant), make_system(HOME)
    steps = Search(system, data.runs, 1.0, Options()).steps
    assert zero_of_an_input(steps, system, system.make_effect(law, {"c1": 0.3})) == said


def test_the_reference_is_the_sound_run_by_the_number_that_differs_most() -> None:
    """Of motors of which the third breaks in the second run, the run before that; of whole runs the middle one."""
    rng = np.random.default_rng(0)
    numbers = 0.003 * rng.normal(size=(4, 6))
    numbers[2, 2] += 0.12
    numbers[2, 0] = np.median(numbers[:, 0])
    assert reference(numbers, [False, True, True, False]) == 1
    assert reference(np.array([[0.3], [0.1], [0.2]]), [False] * 3) == 2
