"""Checks of the paper's figures follow the models and the numbers: cartpole, spring and policies."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from nsde_benchmarks.paper.cartpole import state_evolution, uncertainty_map
from nsde_benchmarks.paper.outcome import PARTICLES, rollout
from nsde_benchmarks.paper.policies import learned_in
from nsde_benchmarks.paper.spring import SECONDS, together
from nsde_benchmarks.paper.spring import state_evolution as evolution_of_the_spring
from nsde_torch.data import Run
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.models import Model, NeuralSDE, SDESpec


def episodes(count: int, seed: int) -> list[Run]:
    rng = np.random.default_rng(seed)
    t = 0.02 * np.arange(201)
    out = []
    for k in range(count):
        x = np.zeros((201, 4))
        x[:, 0] = 0.3 * np.sin(2 * t + k)
        x[:, 1] = 0.6 * np.cos(2 * t + k)
        x[:, 2] = math.pi + 0.5 * np.sin(3 * t + rng.uniform())
        x[:, 3] = 1.5 * np.cos(3 * t)
        out.append(Run(f"episode_{seed}_{k}", t, x, rng.uniform(-5, 5, (201, 1))))
    return out


def model(seed: int = 0) -> NeuralSDE:
    spec = SDESpec("cartpole", dt=0.02, horizon=10, step="euler_maruyama")
    return NeuralSDE(spec, generator=torch.Generator().manual_seed(seed))


def test_a_model_that_knows_nothing_of_the_data_fails_the_map() -> None:
    blind = model()
    with torch.no_grad():
        for parameter in blind.eta.parameters():
            parameter.zero_()
    outcome = uncertainty_map(blind, episodes(2, 0), episodes(1, 1), data_name="test data", seed=0)
    assert outcome.checks[0].passed is False
    assert set(outcome.figures) == {"map"}
    assert "test data" in outcome.title


def test_a_model_that_knows_the_data_passes_the_map() -> None:
    knowing = model()

    def distance(x: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(x[:, 1].abs() + x[:, 3].abs() - 3.0)

    knowing.distance = distance  # type: ignore[method-assign]
    outcome = uncertainty_map(knowing, episodes(2, 0), episodes(1, 1), data_name="test data", seed=0)
    assert outcome.values["sigma_theta_dot"]["away"] > outcome.values["sigma_theta_dot"]["held_out"]
    assert outcome.values["auroc"] > 0.6


def test_the_evolution_compares_both_models_on_the_same_episodes() -> None:
    outcome = state_evolution({"sde": [model(0)], "ensemble": [model(1)]}, episodes(2, 2), seed=0)
    assert len(outcome.checks) == 3
    assert set(outcome.values) == {"sde", "ensemble"}
    assert outcome.values["sde"]["error_position"].keys() == {"0.5", "1"}


def study(folder: Path, sde: float, ensemble: float, blackbox: float = 0.5) -> Path:
    rows = []
    scores = {"truth": 1.0, "limited": 0.2, "nsde": sde, "blackbox_nsde": blackbox, "ensemble": ensemble}
    for kind, score in scores.items():
        policy = folder / f"{kind}_0"
        policy.mkdir()
        curve = [{"interactions": n, "truth_reward": n / 10, "environment_reward": n / 9} for n in (0, 100)]
        (policy / "policy.json").write_text(json.dumps({"curve": curve}))
        data = "published" if kind in ("truth", "limited") else "random"
        row = {"data": data, "truth": "published", "environment": kind, "seeds": 1, "policies": [str(policy)]}
        row |= {"reward": 10 * score, "reward_std_over_seeds": 0.0, "score": score}
        rows.append({**row, "score_std_over_seeds": 0.0, "random_reward": -300.0, "truth_reward": 10.0})
    (folder / "policies.json").write_text(json.dumps({"rows": rows}))
    return folder


@pytest.mark.parametrize(
    ("sde", "ensemble", "passed"), [(0.97, 0.3, [True, True]), (0.9, 0.96, [False, False])]
)
def test_checks_follow_the_scores(tmp_path: Path, sde: float, ensemble: float, passed: list[bool]) -> None:
    folder = study(tmp_path, sde, ensemble)
    outcome = learned_in(folder, ("nsde", "ensemble"), title="policies", source="a claim")
    assert [check.passed for check in outcome.checks] == passed
    assert set(outcome.figures) == {"random"}
    assert outcome.values["random"]["limited"]["score"] == 0.2


@pytest.mark.parametrize(("blackbox", "passed"), [(0.5, True), (0.98, False)])
def test_physics_is_worth_something_where_policies_without_it_earn_less(
    tmp_path: Path, blackbox: float, passed: bool
) -> None:
    folder = study(tmp_path, 0.97, 0.3, blackbox)
    outcome = learned_in(folder, ("nsde", "blackbox_nsde"), title="policies", source="a claim")
    assert [check.passed for check in outcome.checks] == [True, passed]
    assert "one seed" in outcome.checks[1].measured


def test_a_folder_without_a_study_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"bench_policy\.py"):
        learned_in(tmp_path, ("nsde",), title="policies", source="a claim")


def spring(*, damping: float, step: str = "euler_maruyama", sigma: float = 0.003) -> NeuralSDE:
    """The supplement's spring with another damping, without residuals."""
    spec = SDESpec("mass_spring_damper", dt=0.01, horizon=50, step=step)
    values = {"viscous_friction.damping": damping, "linear_spring.stiffness": 1.0}
    model = NeuralSDE(spec, generator=torch.Generator().manual_seed(0), values=values)
    with torch.no_grad():
        for network in model.residuals.parameters():
            network.zero_()
        model.h.log_sigma_max.fill_(torch.tensor(sigma).log())
    return model


def ode(damping: float) -> NeuralSDE:
    return spring(damping=damping, step="rk4")


class Lost(NeuralSDE):
    """A model that leaves the finite numbers after 0.3 s."""

    def sample(self, x0: Tensor, u: Tensor, **options: object) -> Tensor:
        if u.shape[1] > 30:
            raise NonFiniteError("lost")
        return super().sample(x0, u, **options)  # type: ignore[arg-type]


def lost() -> Model:
    spec = SDESpec("mass_spring_damper", dt=0.01, horizon=50, step="euler_maruyama")
    return Lost(spec, generator=torch.Generator().manual_seed(0))


@pytest.mark.slow
def test_a_right_sde_passes_every_check_beside_a_wrong_ode_and_a_lost_ensemble() -> None:
    models = {"sde": [spring(damping=0.5)], "ode": [ode(0.9)], "ensemble": [lost()]}
    outcome = evolution_of_the_spring(models, title="spring", seed=0)
    assert [check.passed for check in outcome.checks] == [True, True, True]
    assert "0.3 s" in outcome.checks[2].measured
    assert outcome.passed
    assert set(outcome.figures) == {"evolution"}


@pytest.mark.slow
def test_a_wrong_sde_fails() -> None:
    wrong = [spring(damping=1.5, sigma=1e-5)]
    models = {"sde": wrong, "ode": [ode(0.5)], "ensemble": wrong}
    outcome = evolution_of_the_spring(models, title="spring", seed=0)
    assert [check.passed for check in outcome.checks] == [False, False, False]
    assert not outcome.passed


@pytest.mark.slow
def test_several_seeds_are_averaged_and_several_outcomes_joined() -> None:
    models = {"sde": [spring(damping=d) for d in (0.5, 0.6)], "ode": [ode(0.5)]}
    one = evolution_of_the_spring(models, title="spring; unknown", seed=0)
    joined = together(one, evolution_of_the_spring(models, title="spring; declared", seed=0))
    assert joined.title == "spring"
    assert len(joined.checks) == 2 * len(one.checks)
    assert [c.claim.split(":")[0] for c in joined.checks] == ["unknown"] * 2 + ["declared"] * 2


@pytest.mark.slow
def test_pairs_of_seeds_say_whether_sde_and_ode_differ_by_more_than_seeds_do() -> None:
    sde = [spring(damping=d, sigma=1e-5) for d in (0.50, 0.51)]
    alike, worse = (
        evolution_of_the_spring({"sde": sde, "ode": [ode(d) for d in dampings]}, title="spring", seed=0)
        for dampings in ((0.51, 0.50), (0.9, 0.91))
    )
    assert "less than twice what seeds account for" in alike.notes[0]
    assert "more than twice what seeds account for" in worse.notes[0]
    assert "±" in alike.checks[1].measured


def test_one_model_of_each_kind_is_said_to_decide_nothing_between_alike_ones() -> None:
    one = evolution_of_the_spring({"sde": [spring(damping=0.5)], "ode": [ode(0.5)]}, title="spring", seed=0)
    assert "cannot tell" in one.notes[0]


def test_a_rollout_is_kept_up_to_where_it_leaves_the_finite_numbers() -> None:
    model = lost()
    x0, u = torch.tensor([[0.1, 0.0]]), torch.zeros(1, round(SECONDS / 0.01), 1)
    paths = rollout(model, x0, u, seed=0, measurement=False)
    assert paths.shape == (PARTICLES, 1, 801, 2)
    assert bool(torch.isfinite(paths[:, :, :31]).all())
    assert bool(torch.isnan(paths[:, :, 31:]).all())
