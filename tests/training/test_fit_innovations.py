"""Models fitted by innovations: what is declared, learned and disturbed comes out as it was put in."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from nsde_torch.data import Run
from nsde_torch.data.raw import RawRun
from nsde_torch.effects import Port
from nsde_torch.models.neural_sde import NeuralSDE, SDESpec
from nsde_torch.recording import assemble
from nsde_torch.systems import make_system
from nsde_torch.training import TrainerOptions
from nsde_torch.training.fit_innovations import fit_innovations
from nsde_torch.training.task import Fitted
from tests.helpers.loop_contract import task_of
from tests.inference.springs import TRUTH, B, rubbing, small_runs

H = 0.02
SPEC = SDESpec("mass_spring_damper", dt=H, horizon=20, step="milstein_heun", measurement=True, learn_lag=True)


def closed_loop(seed: int, *, lag: float, drag: float = 0.0) -> list[RawRun]:
    """A mass on a spring, pushed by a controller that follows steps, answers sensors, and acts late; Heun at 1 ms."""
    runs = []
    for k in range(2):
        rng = np.random.default_rng([seed, k])
        n, fine = 1500, 20
        dt = H / fine
        q = v = m = gust = want = 0.0
        rows: list[tuple[float, float, float]] = []
        for i in range(n):
            if i % 100 == 0:
                want = float(rng.uniform(-1, 1))
            seen_q, seen_v = q + 0.002 * rng.standard_normal(), v + 0.01 * rng.standard_normal()
            u = 6.0 * (want - seen_q) - 2.0 * seen_v + 0.2 * rng.standard_normal()
            rows.append((seen_q, seen_v, u))
            gust += -gust * H / 0.5 + 0.3 * (2 * H / 0.5) ** 0.5 * rng.standard_normal()
            for _ in range(fine):
                m += (u - m) * dt / lag if lag else u - m

                def pull(q: float, v: float, m: float = m, g: float = gust) -> float:
                    return m - 1.0 * q - 0.5 * v - drag * v * abs(v) + g

                a = pull(q, v)
                q, v, b = q + dt * v + 0.5 * dt * dt * a, v + dt * a, pull(q + dt * v, v + dt * a)
                v += 0.5 * dt * (b - a)
        table: NDArray[np.float64] = np.array(rows)
        runs.append(RawRun(f"run_{k}", H * np.arange(n), table[:, :2], table[:, 2:]))
    return runs


def fitted(
    raw: list[RawRun] | list[Run],
    folder: Path,
    spec: SDESpec = SPEC,
    *,
    seed: int = 0,
    near: Fitted | None = None,
    **options: int,
) -> Fitted:
    runs = [run for run in raw if isinstance(run, Run)]
    if not runs:
        runs = list(assemble(raw, make_system("mass_spring_damper"), kind="csv").runs)  # type: ignore[arg-type]
    own = TrainerOptions(**{"steps": 60, **options})
    return fit_innovations(task_of(spec, runs, folder / "train", own, seed=seed, near=near))


def test_a_controller_in_the_loop_bends_neither_gains_nor_the_lag(tmp_path: Path) -> None:
    found = fitted(closed_loop(0, lag=0.08), tmp_path)
    p = found.parameters()
    assert found.facts["innovations"]["learned_lag"] == "actuator_lag"
    declared = {"force_gain": 1.0, "linear_spring.stiffness": 1.0, "viscous_friction.damping": 0.5}
    for name, truth in {**declared, "actuator_lag.time_constant": 0.08}.items():
        (value,), (half,) = p[name]["value"], p[name]["half_width_90"]  # type: ignore[misc]
        assert abs(value - truth) < max(2.0 * half, 0.02 * truth), (name, value, half)
    assert not any(n["kept"] for n in found.facts["innovations"]["networks"].values())


@pytest.mark.slow
def test_a_lag_is_learned_only_where_there_is_one_and_it_may_be(tmp_path: Path) -> None:
    prompt = fitted(closed_loop(1, lag=0.0), tmp_path / "a")
    assert prompt.facts["innovations"]["learned_lag"] is None
    kept_out = fitted(closed_loop(1, lag=0.08), tmp_path / "b", replace(SPEC, learn_lag=False))
    assert kept_out.facts["innovations"]["learned_lag"] is None
    assert kept_out.model.spec.effects == ()


@pytest.mark.slow
def test_noise_of_sensors_and_gusts_is_that_of_the_machine(tmp_path: Path) -> None:
    noise = fitted(closed_loop(2, lag=0.0), tmp_path).facts["innovations"]["noise"]
    assert noise["q"]["sensor_std"] == pytest.approx(0.002, rel=0.15)
    assert noise["q_dot"]["sensor_std"] == pytest.approx(0.01, rel=0.15)
    assert 0.05 < noise["q_dot"]["diffusion"] < 0.5  # the gust, which this system has no state for


@pytest.mark.slow
def test_a_port_without_declared_physics_is_all_network(tmp_path: Path) -> None:
    found = fitted(closed_loop(4, lag=0.0), tmp_path, replace(SPEC, declared=()), steps=400)
    x = torch.tensor([[0.3, 0.0], [-0.3, 0.0], [0.0, 0.4]])
    (push,) = found.model.residual(x).values()
    assert torch.allclose(push[:, 0].detach(), torch.tensor([-0.3, 0.3, -0.2]), atol=0.08)


def test_sigma_over_the_data_is_that_of_the_law_and_grows_to_what_is_declared(tmp_path: Path) -> None:
    found = fitted(closed_loop(5, lag=0.0), tmp_path)
    model, noise = found.model, found.facts["innovations"]["noise"]
    data = assemble(closed_loop(5, lag=0.0), make_system("mass_spring_damper"), kind="csv")
    x = torch.from_numpy(np.concatenate([run.x for run in data.runs])).float()
    sigma = model.diffusion(0.0, x, torch.zeros(len(x), 1)).detach()
    assert float(sigma[:, 1].square().mean().sqrt()) == pytest.approx(noise["q_dot"]["diffusion"], rel=0.1)
    far = model.h(torch.ones(1))[0].detach()
    assert bool((far >= 0.94 * torch.tensor(model.system.defaults.sigma_max)).all())


# ---- networks from functions that the likelihood chose --------------------------------------------------------


def network_of(runs: list[Run], folder: Path) -> tuple[NeuralSDE, dict[str, Any]]:
    fit = fitted(runs, folder)
    return fit.model, fit.facts["innovations"]["networks"]["force"]


def test_the_network_sees_the_variable_of_the_law_and_fades_beyond_the_data(tmp_path: Path) -> None:
    machine = replace(rubbing(0.0), effects={"quadratic": {"size": 0.1}})
    runs = small_runs(machine, 4, 10.0, seed=3)
    model, told = network_of(runs, tmp_path)
    assert told["kept"]
    assert told["variables"] == ["q_dot"]
    fastest = max(float(np.abs(run.x[:, 1]).max()) for run in runs)

    @torch.no_grad()
    def force(q: float, v: float) -> float:
        return float(model.residual(torch.tensor([[q, v]]))[Port.FORCE])

    assert force(0.0, 0.5 * fastest) == force(1.0, 0.5 * fastest)
    damping = float(model.system.all_declared()[B][0])
    for v in (-0.7 * fastest, 0.3 * fastest, 0.7 * fastest):
        true = -TRUTH[B] * v - 0.1 * abs(v) * v
        assert force(0.0, v) - damping * v == pytest.approx(true, abs=0.08 * fastest)
    assert abs(force(0.0, 4.0 * fastest)) < abs(force(0.0, 0.9 * fastest))


def test_where_nothing_is_missing_the_network_is_silent(tmp_path: Path) -> None:
    model, told = network_of(small_runs(rubbing(0.0), 4, 8.0, seed=1), tmp_path)
    assert not told["kept"]
    with torch.no_grad():
        assert float(model.residual(torch.randn(20, 2))[Port.FORCE].abs().max()) == 0.0
