"""Fitting an ensemble: its likelihood, what it recovers, members that do not see each other, exact resume."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from nsde_torch.data import Run, Windows
from nsde_torch.errors import CheckpointError, NonFiniteError
from nsde_torch.models import EnsembleSpec, GaussianEnsemble
from nsde_torch.training import TrainerOptions
from nsde_torch.training.fit_ensemble import (
    EnsembleLoop,
    Pairs,
    cut_pairs,
    fit_ensemble,
    nll,
    standardised_pairs,
)
from nsde_torch.training.loop import Loop
from nsde_torch.training.task import Task
from tests.helpers.loop_contract import LoopContract, averages_of, task_of
from tests.helpers.toy_systems import DT
from tests.models.test_ensemble import change

DECAY = "tests.helpers.toy_systems:Decay"
OPTIONS = TrainerOptions(steps=12, validate_every=3, checkpoint_every=2, patience=100)


def std_of(x: Any) -> Any:
    """Noise of a step: five times as large on the right as on the left."""
    return 0.05 + 0.2 / (1.0 + np.e ** (-2.0 * x))


def noisy_runs(count: int = 4, rows: int = 400, seed: int = 0) -> list[Run]:
    """x' = 0.9 x + 0.1 u + std_of(x) e, u uniform in [-8, 8]."""
    rng = np.random.default_rng(seed)
    runs = []
    for k in range(count):
        x, u = np.zeros((rows, 1)), rng.uniform(-8, 8, (rows, 1))
        for i in range(rows - 1):
            x[i + 1] = 0.9 * x[i] + 0.1 * u[i] + std_of(x[i]) * rng.standard_normal()
        runs.append(Run(f"run_{k}", DT * np.arange(rows), x, u))
    return runs


def make_loop(folder: Path, *, seed: int = 0, steps: int = 12, **options: Any) -> EnsembleLoop:
    spec = EnsembleSpec(DECAY, dt=DT, horizon=5, members=3, hidden=(8, 8), batch=8)
    model = GaussianEnsemble(spec, generator=torch.Generator().manual_seed(seed))
    windows = Windows(noisy_runs(2, 200), DT, 5)
    train, held = windows.held_out(0.2, 2.0, torch.Generator().manual_seed(seed))
    pairs = standardised_pairs(model, train, clock_scale=1.0)
    task = task_of(spec, [], folder / "c", replace(OPTIONS, **options), seed=seed)
    return EnsembleLoop(model, pairs, cut_pairs(model, held, most=50), steps=steps, task=task)


def make_task(tmp_path: Path, **spec: Any) -> Task:
    spec = EnsembleSpec(DECAY, dt=DT, horizon=5, **spec)
    options = replace(OPTIONS, patience=1000)
    return task_of(spec, noisy_runs(), tmp_path / "c", options, name="t", validation=0.15, clock=1.25)


# ---- likelihood and pairs -------------------------------------------------------------------------------


def test_the_likelihood_is_that_of_torchs_normal(tmp_path: Path) -> None:
    loop = make_loop(tmp_path)
    y, c = loop.train.inputs[:20].expand(3, -1, -1), loop.train.changes[:20].expand(3, -1, -1)
    mean, v = loop.model.standard(y)
    expected = -Normal(mean, torch.exp(0.5 * v)).log_prob(c).mean((1, 2))
    torch.testing.assert_close(nll(loop.model, y, c), expected)


def test_pairs_are_consecutive_states_with_the_mean_input_of_the_step() -> None:
    """A model step of two data steps: pairs start at every sample."""
    runs = noisy_runs(1, 60)
    model = GaussianEnsemble(EnsembleSpec(DECAY, dt=2 * DT, horizon=4), generator=torch.Generator())
    pairs = standardised_pairs(model, Windows(runs, 2 * DT, 4), clock_scale=1.0)
    x, u = runs[0].x[:, 0], runs[0].u[:, 0]
    raw = pairs.inputs * model.standardise.scale + model.standardise.mean
    change = pairs.changes * model.change_scale.scale + model.change_scale.mean
    assert len(raw) == 58
    np.testing.assert_allclose(raw[:, 0], x[:-2], atol=1e-5)
    np.testing.assert_allclose(raw[:, 1], 0.5 * (u[:-1] + u[1:])[:-1], atol=1e-5)
    np.testing.assert_allclose(change[:, 0], x[2:] - x[:-2], atol=1e-5)


# ---- what is learned ------------------------------------------------------------------------------------


def test_mean_and_variance_of_a_known_heteroscedastic_system_are_recovered(tmp_path: Path) -> None:
    options = TrainerOptions(validate_every=100, checkpoint_every=1000)
    task = replace(make_task(tmp_path, steps=1500, members=3), runs=noisy_runs(8, 1000), options=options)
    fit = fit_ensemble(task)
    x = torch.linspace(-1.2, 1.2, 13).repeat_interleave(5)[:, None]
    u = torch.linspace(-7, 7, 5).repeat(13)[:, None]
    with torch.no_grad():
        mean, std = change(fit.model, x, u)
    expected = 0.9 * x + 0.1 * u - x
    assert float((mean.mean(0) - expected).abs().mean()) < 0.015  # the noise is 0.07 to 0.23
    assert float((mean.mean(0) - expected).abs().max()) < 0.05
    ratio = std.square().mean(0).sqrt() / std_of(x)
    assert float(ratio.log().abs().mean()) < 0.08
    assert float(ratio.min()) > 0.8
    assert float(ratio.max()) < 1.35
    truth = -Normal(0, torch.as_tensor(std_of(x))).entropy().mean()
    after = x + expected + std_of(x) * torch.randn(65, 1, generator=torch.Generator().manual_seed(3))
    density = torch.logsumexp(Normal(mean, std).log_prob(after - x).sum(-1), 0) - math.log(3)
    assert float(density.mean()) > float(truth) - 0.2


# ---- members do not see each other ------------------------------------------------------------------------


def test_a_member_ends_in_the_same_weights_whatever_the_others_do(tmp_path: Path) -> None:
    a, b = (make_loop(tmp_path / name, clip=0.5) for name in "ab")
    with torch.no_grad():
        for name, p in b.model.named_parameters():
            if name.startswith("networks."):
                p[1].mul_(5.0)
        b.average = [p.detach().clone() for p in b.parameters]
    for loop in (a, b):
        loop.run()
    for (name, p), q in zip(a.model.named_parameters(), b.model.parameters(), strict=True):
        if p.requires_grad:
            torch.testing.assert_close(p[0], q[0], rtol=1e-4, atol=1e-6, msg=name)
            torch.testing.assert_close(p[2], q[2], rtol=1e-4, atol=1e-6, msg=name)
    assert not torch.equal(a.model.networks.weights[0][1], b.model.networks.weights[0][1])


def test_every_member_keeps_its_own_best_weights_and_all_stop_together(tmp_path: Path) -> None:
    loop = make_loop(tmp_path, patience=2, steps=100)
    # stretched: patience 2 of 12 steps are 17 of 100
    assert loop.patience == 17 * 3
    loop.patience = 9
    best = torch.tensor([3.0, 6.0, 9.0])
    loop.validate = lambda: (loop.progress.step - best).abs()  # type: ignore[method-assign]
    averages = averages_of(loop)
    progress = loop.run()
    assert progress.stopped
    assert (progress.step, progress.best_step, progress.best_score) == (18, 9, 0.0)
    assert loop.best_step.tolist() == [3, 6, 9]
    for i, p in enumerate(loop.parameters):
        for m, step in enumerate((3, 6, 9)):
            assert torch.equal(p[m], averages[step][i][m])


# ---- resume -----------------------------------------------------------------------------------------------


class TestEnsembleLoop(LoopContract):
    def make(self, folder: Path, seed: int = 0) -> EnsembleLoop:
        return make_loop(folder, seed=seed)

    def same(self, a: Loop, b: Loop) -> None:
        super().same(a, b)
        assert torch.equal(a.best_score, b.best_score)
        assert torch.equal(a.best_step, b.best_step)


def test_a_checkpoint_of_another_training_is_refused(tmp_path: Path) -> None:
    fit_ensemble(make_task(tmp_path, steps=6, members=2, hidden=(8,)))
    with pytest.raises(CheckpointError, match="another training"):
        fit_ensemble(make_task(tmp_path, steps=7, members=2, hidden=(8,)))
    with pytest.raises(CheckpointError, match="another model"):
        fit_ensemble(make_task(tmp_path, steps=6, members=2, hidden=(9,)))


# ---- faults -----------------------------------------------------------------------------------------------
def test_a_validation_score_that_is_not_finite_stops_with_the_remedy(tmp_path: Path) -> None:
    loop = make_loop(tmp_path)
    loop.validation = Pairs(loop.validation.inputs, loop.validation.changes * float("nan"))
    with pytest.raises(NonFiniteError, match=r"validation score is not finite at step 0.*trainer\.lr"):
        loop.run()
