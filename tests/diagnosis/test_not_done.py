"""A stage whose numbers fail costs itself and not the run."""

import json
import warnings
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, final

import numpy as np
import pytest
import torch
from torch import Tensor

import nsde_torch
from nsde_torch.data import DataSet, RawRun
from nsde_torch.diagnosis import pipeline
from nsde_torch.diagnosis.cross_validation import HeldOut
from nsde_torch.diagnosis.result import Diagnosis
from nsde_torch.diagnosis.stages import needed
from nsde_torch.diagnosis.text import lines
from nsde_torch.effects import Parameter, Port
from nsde_torch.errors import DataError, NsdeError
from nsde_torch.systems import Defaults, ResidualPort, System
from tests.helpers.diagnosed import recorded
from tests.helpers.machines import Array, simulated

OPTIONAL = ("undone", "without_standstill", "guard_of", "cross_validated", "ceiling")


def _fails(*_: object, **__: object) -> None:
    raise np.linalg.LinAlgError("Singular matrix")


@cache
def rubbing() -> DataSet:
    """Runs of a spring with dry friction."""
    dry = {"coulomb_friction": {"size": 0.3}}
    return recorded("mass_spring_damper", dry, durations=[3.0] * 3, dt=0.02)


def diagnosed_without(monkeypatch: pytest.MonkeyPatch, *stages: str) -> Diagnosis:
    """Of a spring with dry friction, where these stages fail."""
    for name in stages:
        monkeypatch.setattr(pipeline, name, _fails)
    return nsde_torch.diagnose(rubbing(), system="mass_spring_damper", candidates=["coulomb_friction"])


@pytest.mark.slow
def test_stages_that_fail_are_told_and_cost_themselves(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found = diagnosed_without(monkeypatch, *OPTIONAL)
    assert found.added == ["coulomb_friction"]
    content = found.content()
    assert len(content["not_done"]) == len(OPTIONAL)
    ceiling = content["not_done"][-1]
    assert ceiling == {
        "stage": "what functions could still explain",
        "why": "it could not be computed (LinAlgError: Singular matrix)",
    }
    said = f"{ceiling['stage']}: {ceiling['why']}."
    assert f"not done: {said}" in lines(content)
    assert said in found.save(tmp_path).read_text(encoding="utf-8")


def test_a_selection_that_fails_leaves_the_tests_of_the_declared_physics(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = diagnosed_without(monkeypatch, "JointSearch")
    assert (found.added, found.verdict) == ([], "unexplained")
    assert pipeline.SELECTION in [n["stage"] for n in found.content()["not_done"]]


@pytest.mark.slow
def test_laws_that_fail_leave_what_the_catalogue_found(monkeypatch: pytest.MonkeyPatch) -> None:
    found = diagnosed_without(monkeypatch, "with_laws")
    assert found.added == ["coulomb_friction"]
    assert [n["stage"] for n in found.content()["not_done"]] == ["laws beyond the catalogue"]


def raising(error: Exception) -> Callable[[], Any]:
    def fails() -> None:
        raise error

    return fails


def refuting(monkeypatch: pytest.MonkeyPatch, **interval: float) -> None:
    """Runs left out are 20 nats likelier without each effect."""
    measured = pipeline.cross_validated

    def errors(*given: Any, **more: Any) -> HeldOut:
        found = measured(*given, **more)
        worse = {name: replace(one, nats=-20.0, **interval) for name, one in found.own.items()}
        return replace(found, own=worse)

    monkeypatch.setattr(pipeline, "cross_validated", errors)


def test_what_runs_left_out_surely_refute_is_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    refuting(monkeypatch, low=-30.0, high=-10.0, rest=-5.0)
    found = diagnosed_without(monkeypatch)
    assert (found.added, found.verdict) == ([], "unexplained")
    assert "coulomb_friction would explain something, and is not named: runs" in str(found)
    (aside,) = found.content()["aside"]
    assert aside["effect"] == "coulomb_friction"
    assert aside["reason"] == "runs that it was not fitted to are likelier without it, by 20 nats"


@pytest.mark.slow
def test_one_run_alone_refutes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    refuting(monkeypatch, low=-30.0, high=-10.0, rest=1.0)
    found = diagnosed_without(monkeypatch)
    assert found.added == ["coulomb_friction"]
    assert (
        found.outcome.found[0].provisional == "it does not raise the log-likelihood of q_dot on runs left out"
    )


def test_a_search_that_fails_numerically_is_an_error_with_a_remedy() -> None:
    words = r"the search .* \(LinAlgError: SVD did not converge\)\. Look at .* inspect"
    with pytest.raises(DataError, match=words):
        needed("the search for effects", raising(np.linalg.LinAlgError("SVD did not converge")))


ONE_ROW = "a run needs at least two"
SHORT = "no stretch of 20 steps without a gap: the longest has "


@final
class FreePendulum(System):
    """A pendulum that nothing drives."""

    name = "free_pendulum"
    state_names, state_units = ("theta", "theta_dot"), ("rad", "rad/s")
    input_names = input_units = ()
    position_derivatives = (("theta", "theta_dot", "world"),)
    ports = {Port.TORQUE: 1}
    residual_ports = {Port.TORQUE: ResidualPort(1, 1.0, "rad/s2")}
    sensor_noise = True
    defaults = Defaults(0.02, 25, (0.002, 0.1), 0.1, 1.0, "euler_maruyama")
    PARAMETERS = {"gravity": Parameter(15.0, "1/s2", low=0.0), "damping": Parameter(0.2, "1/s", low=0.0)}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        swing = -self.value("gravity") * torch.sin(x[:, :1]) - self.value("damping") * x[:, 1:]
        return torch.cat((x[:, 1:], swing + forces.get(Port.TORQUE, 0.0)), 1)


def swinging(rows: int, noise: float) -> list[RawRun]:
    """Two runs of a pendulum that swings out, at 100 Hz."""
    how = {"noise": (0.002 * noise, 0.01 * noise), "rng": np.random.default_rng(0)}

    def rates(x: Array, u: Array) -> list[float]:
        return [x[1], -19.6 * np.sin(x[0]) - 0.3 * x[1]]

    none = np.zeros((rows, 0))
    return [simulated(k, rates, [theta, 0.0], none, 0.01, **how) for k, theta in enumerate((1.0, -0.7))]


@cache
def springs(noise: float) -> tuple[RawRun, ...]:
    options = {"sensor_noise": noise, "process_noise": noise, "durations": [4.0, 4.0]}
    return nsde_torch.simulate("mass_spring_damper", seed=1, **options).runs


Change = Callable[[RawRun], RawRun]


def cut(change: Change = lambda run: run, rows: int = 400, noise: float = 1.0) -> list[RawRun]:
    """The first rows of runs of a spring, changed."""
    return [change(RawRun(r.name, r.t[:rows], r.x[:rows], r.u[:rows])) for r in springs(noise)]


def at_rate(hertz: float) -> Change:
    return lambda run: replace(run, x=run.x * (1.0, 0.01 * hertz), t=np.arange(len(run.t)) / hertz)


def still(run: RawRun) -> RawRun:
    return replace(run, x=0.0 * run.x + (0.2, 0.0), u=0.0 * run.u + 0.5)


def pieces(run: RawRun) -> RawRun:
    return replace(run, t=run.t + 0.5 * (np.arange(len(run.t)) // 5))


def constant(run: RawRun) -> RawRun:
    return replace(run, u=0.0 * run.u + 0.3)


def no_rates(run: RawRun) -> RawRun:
    return replace(run, x=run.x * (1.0, np.nan))


def case(name: str, runs: Callable[[], list[RawRun]], expected: str = "", *, slow: bool = False) -> Any:
    return pytest.param(runs, expected, id=name, marks=[pytest.mark.slow] if slow else [])


@pytest.mark.parametrize(
    ("runs", "expected"),
    [
        case("one row", lambda: cut(rows=1), ONE_ROW),
        case("two rows", lambda: cut(rows=2), SHORT),
        case("nineteen rows", lambda: cut(rows=19), SHORT),
        case("forty rows", lambda: cut(rows=40)),
        case("pieces of five rows", lambda: cut(pieces, rows=100), SHORT),
        case("nothing moves", lambda: cut(still), "nothing moves: q, q_dot never change"),
        case("an input that never moves", lambda: cut(constant, rows=150)),
        case("two kilohertz", lambda: cut(at_rate(2000.0), rows=60)),
        case("two hertz", lambda: cut(at_rate(2.0), rows=60)),
        case("two kilohertz, longer", lambda: cut(at_rate(2000.0), rows=150), slow=True),
        case("no noise", lambda: cut(noise=0.0), slow=True),
        case("positions alone", lambda: cut(no_rates), slow=True),
        case("no inputs, one row", lambda: swinging(1, 1.0), ONE_ROW),
        case("no inputs, thirty rows", lambda: swinging(30, 1.0)),
        case("no inputs, a second and a half", lambda: swinging(150, 1.0)),
        case("no inputs, no noise", lambda: swinging(300, 0.0), slow=True),
    ],
)
def test_every_cut_ends_in_an_answer_or_a_remedy(runs: Callable[[], list[RawRun]], expected: str) -> None:
    """The package's own error, or an answer; anything else, warnings too, is raised."""
    made = runs()
    system: Any = "mass_spring_damper" if made[0].u.shape[1] else FreePendulum
    told = pytest.raises(NsdeError, match=expected) if expected else nullcontext()
    with warnings.catch_warnings(), told:
        warnings.simplefilter("error")
        data = nsde_torch.read(made, system=system)
        found = nsde_torch.diagnose(data, system=system, candidates=["coulomb_friction"])
        json.dumps(found.content(), allow_nan=False)
        nsde_torch.train(data, system=system, model="sysid", test=[], say=lambda text: None)
        assert found.report
