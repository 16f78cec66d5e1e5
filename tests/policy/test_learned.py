"""A learned model as a machine: stepped one sample at a time, it does what it samples in one go."""

from typing import Any

import pytest
import torch

from nsde_torch.errors import ConfigError
from nsde_torch.models import EnsembleSpec, GaussianEnsemble, Model, NeuralSDE, SDESpec
from nsde_torch.policy import make_learned, make_task
from tests.helpers.draws import generator
from tests.helpers.toy_systems import fix_sigma

TASK = make_task("cartpole")


def model(system: str = "cartpole", **spec: Any) -> NeuralSDE:
    options: dict[str, Any] = {"dt": 0.02, "horizon": 10, "step": "euler_maruyama", **spec}
    return NeuralSDE(SDESpec(system, **options), generator=generator()).eval().requires_grad_(False)


def ensemble(propagation: str = "fixed", dt: float = 0.02) -> GaussianEnsemble:
    """Members with fresh weights and little noise, so that what tells paths apart is their member."""
    spec = EnsembleSpec("cartpole", dt=dt, horizon=10, propagation=propagation)
    own = GaussianEnsemble(spec, generator=generator()).eval().requires_grad_(False)
    own.gap.fill_(-20.0)
    own.low.fill_(-20.0)
    return own


def learned(model: Model, sensor_noise: float = 1.0, **more: Any) -> Any:
    """Machines of a model that follow a policy's commands of 0.02 s."""
    return make_learned(model, dt=0.02, sensor_noise=sensor_noise, generator=generator(), **more)


def start(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    x0 = TASK.training.draw(n, generator(1)).float()
    return x0, 50 * torch.rand(n, 20, 1, generator=generator(2)) - 25


@pytest.mark.parametrize("kind", ["node", "nsde"])
def test_neural_ode_stepped_alone_is_the_path_that_it_samples(kind: str) -> None:
    own = model(kind=kind, step="rk4")
    x0, u = start(3)
    path = own.sample(x0, u, dt=0.02, particles=1, generator=generator(), measurement=False)[0]
    machines = learned(own)
    machines.reset(x0)
    for k in range(20):
        machines.step(u[:, k])
        torch.testing.assert_close(machines.state, path[:, k + 1], rtol=1e-5, atol=1e-5)


def test_memory_of_an_effect_is_carried_from_sample_to_sample() -> None:
    own = model("hexacopter", kind="node", step="rk4", effects=("motor_lag",))
    x0 = torch.zeros(2, 13)
    x0[:, 6] = 1.0
    u = 0.3 + 0.2 * torch.rand(2, 15, 6, generator=generator())
    # at rest under no command, as an environment starts, and not under the first one
    z0 = own.augment(x0, torch.zeros(2, 6))
    machines = learned(own, 0.0)
    machines.reset(x0)
    z = z0
    for k in range(15):
        z = own.project(own.step.advance(own, 0.0, z, u[:, k], 0.02, None))
        machines.step(u[:, k])
    assert z.shape[1] > 13
    torch.testing.assert_close(machines.state, z[:, :13], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("kind", "within"), [("nsde", 0.06), ("ensemble", 0.08)])
def test_paths_of_machines_spread_as_those_that_a_model_samples(kind: str, within: float) -> None:
    own: Model = GaussianEnsemble(EnsembleSpec("cartpole", dt=0.02, horizon=10), generator=generator()).eval()
    if kind == "nsde":
        own = model()
        fix_sigma(own, 0.3)
    x0, u = (part[:1].expand(4000, *part.shape[1:]) for part in start(1))
    machines = learned(own, 0.0)
    machines.reset(x0)
    for k in range(10):
        machines.step(u[:, k])
    settings = {"dt": 0.02, "particles": 4000, "generator": generator(7), "measurement": False}
    with torch.no_grad():
        drawn = own.sample(x0[:1], u[:1, :10], **settings)[:, 0, -1]
    torch.testing.assert_close(machines.state.std(0), drawn.std(0), rtol=within, atol=0)


def test_machine_of_an_ensemble_keeps_its_member_until_its_episode_ends() -> None:
    own = ensemble()
    x0, u = start(40)
    machines = learned(own)
    machines.reset(x0)
    members = machines.members.clone()
    assert set(members.tolist()) == set(range(5))
    x = x0
    for k in range(10):
        machines.step(u[:, k])
        x = own.advance(x, u[:, k], members, torch.zeros(40, 4))
    torch.testing.assert_close(machines.state, x, rtol=0.02, atol=0.02)
    assert torch.equal(machines.members, members)
    rows = torch.arange(20)
    machines.restart(rows, x0[:20])
    machines.step(u[:, 0])
    assert torch.equal(machines.members[20:], members[20:])
    assert not torch.equal(machines.members[:20], members[:20])


def test_what_a_model_cannot_do_is_refused() -> None:
    with pytest.raises(ConfigError, match="sensor_noise"):
        learned(model(), -1.0)
    with pytest.raises(ConfigError, match=r"system.dt=0\.02"):
        learned(ensemble(dt=0.05))
    with pytest.raises(ConfigError, match="propagation"):
        learned(model(), propagation="fixed")
    with pytest.raises(ConfigError, match="fixed or redrawn"):
        learned(ensemble(), propagation="both")
