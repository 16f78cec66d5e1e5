"""What is there in one run only is told as that, and never where every run has it or none."""

from functools import cache

import numpy as np
import pytest

from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.pipeline import diagnose
from nsde_torch.diagnosis.residual_tests import (
    Dependence,
    dependences,
    in_one_run,
)
from nsde_torch.diagnosis.text import short_lines
from nsde_torch.models.identified import SysidSpec
from nsde_torch.recording import assemble
from nsde_torch.simulation import simulate
from nsde_torch.systems import make_system
from tests.helpers.residuals import MadeResiduals, Push


@cache
def springs(runs: int) -> MadeResiduals:
    return MadeResiduals((8.0,) * runs)


def found(push: Push | None, runs: int, seed: int = 0, *, loud: float = 1.0) -> Dependence | None:
    """The test of one run on the speed, of white innovations and a push; the last run may be louder."""
    left = springs(runs).made(push, seed, loud=loud)
    functions, odd = left.functions["q_dot"]()
    return in_one_run(left, 0, "q_dot", functions, odd)


@pytest.mark.parametrize("runs", [3, 6])
def test_the_run_is_named_that_a_friction_acts_in(runs: int) -> None:
    this = found(lambda q, v, t, run: np.where(run == 1, -0.03 * np.sign(v), 0.0), runs)
    assert this.run == 1
    assert this.p < 1e-3


def test_a_friction_in_all_runs_or_in_two_of_them_is_in_no_run_only() -> None:
    for where in ({0, 1, 2, 3, 4, 5}, {1, 4}):
        own = list(where)
        this = found(lambda q, v, t, run, own=own: np.where(np.isin(run, own), -0.01 * np.sign(v), 0.0), 6)  # type: ignore[misc]
        assert this.p > 1e-4  # of a hundred tests that is nothing


def test_a_line_for_each_run_does_not_hide_a_friction_in_one() -> None:
    left = MadeResiduals((10.0,) * 8).made(lambda q, v, t, run: np.where(run == 2, -0.02 * np.sign(v), 0.0))
    tests = dependences(left)
    best = {d.variable: d for d in tests if d.everywhere}
    (this,) = (d for d in tests if d.variable == "q_dot" and d.run is not None and d.moment is None)
    # eight slopes of the speed, which say nothing of friction
    assert best["q_dot by run"].excess > this.excess
    assert this.run == 2
    assert this.p < 1e-3


def test_of_two_runs_nobody_knows_which_is_the_odd_one() -> None:
    assert found(lambda q, v, t, run: np.where(run == 1, -0.1 * v, 0.0), 2) is None


@pytest.mark.slow
def test_noise_and_a_louder_run_give_chances_that_are_none_too_small() -> None:
    p = []
    for seed in range(100):
        this = found(None, 4, seed, loud=1.0 if seed % 2 else 2.0)
        p.append(1.0 if this is None else this.p)
    assert np.mean(np.array(p) < 0.1) <= 0.16
    assert min(p) > 1e-4


@pytest.mark.slow
def test_a_friction_in_one_of_five_runs_is_named_with_its_size_in_each() -> None:
    rough = {"coulomb_friction": {"size": 0.3, "width": 0.01}}
    sound, worn = (
        simulate("mass_spring_damper", effects=e, durations=(8.0,) * 5, seed=3).runs for e in ([], [rough])
    )
    system = make_system("mass_spring_damper")
    data = assemble([*sound[:3], worn[3], sound[4]], system, kind="simulated")
    name = data.runs[3].name
    spec = SysidSpec(system.name, dt=data.dt, horizon=system.defaults.horizon)
    content = diagnose(system, spec, data, data.runs, Options()).content()
    differs = "run_difference[coulomb_friction/size]"
    assert content["verdict"] == "effect_found"
    assert set(content["added"]) == {"coulomb_friction", differs}
    each = {p["run"]: p["value"] for k, p in content["parameters"].items() if k.startswith(differs)}
    assert each.pop(name) == pytest.approx(0.3, rel=0.1)
    assert max(map(abs, each.values())) < 0.05
    assert any(f"{name} 0." in line for line in short_lines(content))
