"""What differs between the runs of a training is drawn for a run that was not seen."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.models import make_model
from nsde_torch.models.neural_sde import NeuralSDE, SDESpec
from nsde_torch.models.run_directory import load, save
from nsde_torch.systems import make_system
from nsde_torch.training.between_runs import spreads, with_numbers
from nsde_torch.training.task import Fitted
from tests.training.test_fit_innovations import fitted as fitted_to

H = 0.02
SPEC = SDESpec("mass_spring_damper", dt=H, horizon=20, step="milstein_heun", measurement=True)
VALUES = {"force_gain": 1.0, "linear_spring.stiffness": 4.0, "viscous_friction.damping": 0.5}


def spring(
    seed: int, *, stiffness: float = 4.0, force: float = 0.0, dry: float = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rows of [q, q_dot] and inputs of a spring that is pushed by waves and by noise; Heun at 1 ms."""
    rng = np.random.default_rng(seed)
    n, fine = 600, 20
    dt, q, v = H / fine, float(rng.normal()), 0.0
    rate, turn = rng.uniform(0.5, 4.0, 4), rng.uniform(0.0, 6.3, 4)
    rows, inputs = np.empty((n, 2)), np.empty((n, 1))
    for i in range(n):
        u = float(np.sin(rate * H * i + turn).sum())
        rows[i], inputs[i] = (q, v), u
        for _ in range(fine):

            def pull(q: float, v: float, u: float = u) -> float:
                return u - stiffness * q - 0.5 * v + force - dry * float(np.tanh(v / 0.01))

            a = pull(q, v)
            q, v, b = q + dt * v + 0.5 * dt * dt * a, v + dt * a, pull(q + dt * v, v + dt * a)
            v += 0.5 * dt * (b - a) + 0.03 * dt**0.5 * float(rng.standard_normal())
    return rows + rng.normal(size=(n, 2)) * (0.001, 0.005), inputs


def fitted(machines: Sequence[Mapping[str, float]], folder: Path, seed: int) -> Fitted:
    made = [spring(100 * seed + k, **values) for k, values in enumerate(machines)]
    raw = [RawRun(f"run_{k}", H * np.arange(600), *rows) for k, rows in enumerate(made)]
    return fitted_to(raw, folder, SPEC, steps=30)


@pytest.mark.parametrize(
    ("key", "target", "each"),
    [
        ("force", "run_force", (0.25, -0.2, 0.1, -0.3)),
        ("stiffness", "linear_spring/stiffness", (3.6, 4.4, 4.8, 3.9)),
    ],
)
def test_what_differs_is_found_alone_and_neither_noise_nor_networks_learn_it(
    key: str, target: str, each: Sequence[float], tmp_path: Path
) -> None:
    made = fitted([{key: value} for value in each], tmp_path, 1)
    model, of_all = made.model, np.mean(each) if key == "stiffness" else 0.0
    assert list(model.spec.between_runs) == [target]
    found = made.facts["between_runs"][target]["of_runs"].values()
    assert [n for (n,) in found] == pytest.approx(np.array(each) - of_all, abs=0.05)
    assert made.facts["innovations"]["networks"]["force"]["kept"] is False
    # twice the diffusion that is there, 0.03, is the most that a residual without the difference has
    assert made.facts["innovations"]["noise"]["q_dot"]["diffusion"] < 0.06
    assert target in made.said
    value = float(model.system.all_declared()["linear_spring.stiffness"][0])
    assert value == pytest.approx(of_all or 4.0, abs=0.1)


@pytest.mark.parametrize("seed", [2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (3, 4))])
def test_runs_of_one_machine_differ_in_nothing(seed: int, tmp_path: Path) -> None:
    assert fitted([{}] * 4, tmp_path, seed).model.spec.between_runs == {}


def test_a_law_that_nobody_declared_is_learned_and_not_taken_for_a_difference(tmp_path: Path) -> None:
    made = fitted([{"dry": 0.3}] * 4, tmp_path, 5)
    assert made.facts["innovations"]["networks"]["force"]["kept"] is True
    assert made.facts["between_runs"] == {}


# ---- paths of the model --------------------------------------------------------------------------------


def model_of(system: str, spread: Mapping[str, Sequence[float]], **values: float) -> NeuralSDE:
    spec = SDESpec(system, dt=H, horizon=20, step="euler_maruyama", between_runs=spread)
    model = NeuralSDE(spec, generator=torch.Generator().manual_seed(0), values=values).double()
    with torch.no_grad():
        for network in model.residuals.values():
            for parameter in network.parameters():
                parameter.zero_()
    return model.requires_grad_(False)


def spring_of(spread: Mapping[str, Sequence[float]], **values: float) -> NeuralSDE:
    return model_of("mass_spring_damper", spread, **{**VALUES, **values})


def path(model: NeuralSDE, x0: torch.Tensor, u: torch.Tensor, draws: Sequence[float]) -> torch.Tensor:
    """Paths (P, B, T + 1, nx) without noise, each with its own number."""
    start = torch.tensor(draws, dtype=torch.float64)[:, None, None].expand(-1, len(x0), 1)
    noise = torch.zeros(len(draws), *u.shape[:2], model.nz, dtype=torch.float64)
    return model.paths(x0, u, dt=H, noise=noise, start=start)


def rows(width: int, nu: int = 1, count: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(3)
    x = torch.randn(count, width, generator=g, dtype=torch.float64)
    return 0.3 * x, torch.randn(count, 25, nu, generator=g, dtype=torch.float64)


def test_a_path_with_a_number_is_that_of_the_machine_with_this_parameter() -> None:
    x0, u = rows(2)
    drawn = path(spring_of({"linear_spring/stiffness": [0.5]}), x0, u, [-1.0, 0.0, 2.0])
    for own, stiffness in zip(drawn, (3.5, 4.0, 5.0), strict=True):
        plain = spring_of({}, **{"linear_spring.stiffness": stiffness})
        torch.testing.assert_close(own, plain.paths(x0, u, dt=H, noise=torch.zeros(1, 3, 25, 2).double())[0])


def test_a_path_with_another_zero_is_that_of_the_true_angles_read_wrong() -> None:
    x0, u = rows(4)
    wrong, plain = model_of("cartpole", {"run_zero[pole]": [0.05]}), model_of("cartpole", {})
    shift = torch.tensor([0.0, 0.0, 0.05, 0.0], dtype=torch.float64)
    (own,) = path(wrong, x0, u, [1.0])
    true = plain.paths(x0 - shift, u, dt=H, noise=torch.zeros(1, 3, 25, 4).double())[0]
    torch.testing.assert_close(own, true + shift)


def test_paths_of_a_run_that_was_seen_have_its_own_numbers() -> None:
    x0, u = rows(2)
    model = spring_of({"linear_spring/stiffness": [0.5]})
    model.h.log_sigma_max.fill_(-30.0)
    given: dict[str, Any] = {"dt": H, "particles": 3, "generator": torch.Generator().manual_seed(0)}
    own = model.sample(x0, u, numbers=torch.tensor([[1.0], [-2.0], [0.0]]).double(), **given)
    each = path(model, x0, u, [1.0, -2.0, 0.0])
    torch.testing.assert_close(own, torch.stack([each[k, k] for k in range(3)]).expand_as(own))


def test_the_mean_of_all_runs_is_what_is_planned_with_and_what_no_draw_asks_for() -> None:
    x0, u = rows(2)
    some, plain = spring_of({"linear_spring/stiffness": [0.5]}), spring_of({})
    torch.testing.assert_close(some.drift(0.0, x0, u[:, 0]), plain.drift(0.0, x0, u[:, 0]))
    torch.testing.assert_close(some.paths(x0, u, dt=H, noise=None), plain.paths(x0, u, dt=H, noise=None))


def test_a_run_directory_keeps_what_differs_and_refuses_what_the_machine_does_not_have(
    tmp_path: Path,
) -> None:
    model = spring_of({"run_force": [0.4]})
    save(model, tmp_path)
    x0, u = rows(2)
    given: dict[str, Any] = {"dt": H, "particles": 4}
    here, there = (
        m.sample(x0, u, generator=torch.Generator().manual_seed(1), **given) for m in (model, load(tmp_path))
    )
    torch.testing.assert_close(here, there)
    with pytest.raises(ConfigError, match="magnet"):
        make_model(replace(SPEC, between_runs={"magnet/size": [0.1]}), generator=torch.Generator())


@pytest.mark.parametrize("target", ["run_force", "linear_spring/stiffness"])
def test_ninety_per_cent_of_unseen_runs_lie_within_the_spread_of_five(target: str) -> None:
    rng, inside, mean = np.random.default_rng(3), [], 0.0
    system = with_numbers(make_system("mass_spring_damper"), [target], 5)
    effect = next(e for e in system.effects if str(e.name).startswith("run_"))
    ((key, _),) = effect.PARAMETERS.items()
    for _ in range(400):
        each = rng.normal(0.0, 0.3, 6)
        if target == "run_force":
            effect.set_value(key, each[:5].tolist())
        else:  # against the first run; what is drawn is about the mean of the five
            effect.set_value(key, (each[1:5] - each[0]).tolist())
            mean = each[:5].mean()
        (found,) = spreads(system)
        inside.append(abs(each[5] - mean) < 1.645 * found.std[0])
    assert np.mean(inside) == pytest.approx(0.9, abs=0.045)  # three standard errors
