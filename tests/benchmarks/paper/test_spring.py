"""The spring's checks tell a right model from a wrong one, and a model that diverges from one that does not."""

import pytest
import torch
from torch import Tensor

from nsde_benchmarks.paper.outcome import PARTICLES, rollout
from nsde_benchmarks.paper.spring import SECONDS, state_evolution, together
from nsde_torch.errors import NonFiniteError
from nsde_torch.models import Model, NeuralSDE, SDESpec


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
    outcome = state_evolution(models, title="spring", seed=0)
    assert [check.passed for check in outcome.checks] == [True, True, True]
    assert "0.3 s" in outcome.checks[2].measured
    assert outcome.passed
    assert set(outcome.figures) == {"evolution"}


@pytest.mark.slow
def test_a_wrong_sde_fails() -> None:
    wrong = [spring(damping=1.5, sigma=1e-5)]
    models = {"sde": wrong, "ode": [ode(0.5)], "ensemble": wrong}
    outcome = state_evolution(models, title="spring", seed=0)
    assert [check.passed for check in outcome.checks] == [False, False, False]
    assert not outcome.passed


@pytest.mark.slow
def test_several_seeds_are_averaged_and_several_outcomes_joined() -> None:
    models = {"sde": [spring(damping=d) for d in (0.5, 0.6)], "ode": [ode(0.5)]}
    one = state_evolution(models, title="spring; unknown", seed=0)
    joined = together(one, state_evolution(models, title="spring; declared", seed=0))
    assert joined.title == "spring"
    assert len(joined.checks) == 2 * len(one.checks)
    assert [c.claim.split(":")[0] for c in joined.checks] == ["unknown"] * 2 + ["declared"] * 2


@pytest.mark.slow
def test_pairs_of_seeds_say_whether_sde_and_ode_differ_by_more_than_seeds_do() -> None:
    sde = [spring(damping=d, sigma=1e-5) for d in (0.50, 0.51)]
    alike, worse = (
        state_evolution({"sde": sde, "ode": [ode(d) for d in dampings]}, title="spring", seed=0)
        for dampings in ((0.51, 0.50), (0.9, 0.91))
    )
    assert "less than twice what seeds account for" in alike.notes[0]
    assert "more than twice what seeds account for" in worse.notes[0]
    assert "±" in alike.checks[1].measured


def test_one_model_of_each_kind_is_said_to_decide_nothing_between_alike_ones() -> None:
    one = state_evolution({"sde": [spring(damping=0.5)], "ode": [ode(0.5)]}, title="spring", seed=0)
    assert "cannot tell" in one.notes[0]


def test_a_rollout_is_kept_up_to_where_it_leaves_the_finite_numbers() -> None:
    model = lost()
    x0, u = torch.tensor([[0.1, 0.0]]), torch.zeros(1, round(SECONDS / 0.01), 1)
    paths = rollout(model, x0, u, seed=0, measurement=False)
    assert paths.shape == (PARTICLES, 1, 801, 2)
    assert bool(torch.isfinite(paths[:, :, :31]).all())
    assert bool(torch.isnan(paths[:, :, 31:]).all())
