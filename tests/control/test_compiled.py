"""Machine code of iterations: the eager numbers, one package for all weights, and life without a compiler."""

from __future__ import annotations

from pathlib import Path

import pytest
import sympy
import torch

from nsde_torch.control import compiled
from nsde_torch.control.autopilots import Estimator, EstimatorOptions
from nsde_torch.control.compiled import NoCompiler, Stage, compile_ahead, quick_indices
from nsde_torch.control.gauss_newton import GaussNewton
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.reference import Reference
from nsde_torch.control.solve import Solver, SolverOptions
from nsde_torch.errors import ConfigError
from nsde_torch.models import NeuralSDE
from nsde_torch.sde import CompilationWarning
from nsde_torch.systems import System
from tests.helpers.control_problems import horizon_of, problem_of


def _estimator(model: NeuralSDE) -> tuple[Estimator, list[torch.Tensor]]:
    predictor = Predictor(model, dt=0.02)
    made = Estimator(predictor, EstimatorOptions(latency=0.0, force_time=0.3), period=0.02)
    g = torch.Generator().manual_seed(0)
    x = torch.randn(1, 13, generator=g)
    x[:, 6:10] = torch.nn.functional.normalize(x[:, 6:10], dim=1)
    return made, [x, x.clone(), torch.zeros(1, 6), torch.rand(1, 1, 6, generator=g)]


@pytest.mark.slow
def test_one_package_serves_models_of_one_architecture_with_the_eager_numbers(
    model: NeuralSDE, tmp_path: Path, compiler: None
) -> None:
    said: list[str] = []
    for k in range(2):
        if k:
            model.system.set_value("thrust_gain", torch.tensor([5.5]))
        try:
            estimator, arguments = _estimator(model)
        finally:
            model.system.set_value("thrust_gain", torch.tensor([4.6]))
        run = compile_ahead(
            estimator, arguments, name="e", structure=estimator.structure, folder=tmp_path, say=said.append
        )
        for fast, plain in zip(run(arguments), estimator(*arguments), strict=True):
            assert torch.allclose(fast, plain, atol=1e-5)
    assert len(list(tmp_path.glob("*.pt2"))) == 1
    assert len(said) == 2  # before and after the one compilation


@pytest.mark.slow
def test_a_compiled_stage_gives_the_numbers_of_the_eager_one(
    declared: System, path: Reference, tmp_path: Path, compiler: None
) -> None:
    h = horizon_of(declared, steps=4, horizon=0.2)
    p = problem_of(h, path, rows=1, off=3.0)
    u = p.last[:, None].repeat(1, 4, 1)
    method = GaussNewton(h)
    quadratic, state = method._split(method.prepare(p.z0, u, h.rollout(p.z0, u, p.d), p.ref, p.last, p.d))
    arguments = [a.contiguous() for a in (*quadratic, *state)]
    run = compile_ahead(
        Stage(method, "active_set"), arguments, name="s", structure=method.structure, folder=tmp_path
    )
    for fast, plain in zip(run(arguments), method.active_set(*arguments), strict=True):
        assert torch.allclose(fast, plain, atol=1e-8)


def test_without_a_compiler_the_solver_says_so_and_runs(
    declared: System, path: Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiled, "has_compiler", lambda: False)
    h = horizon_of(declared, steps=2, horizon=0.1)
    with pytest.warns(CompilationWarning, match="no C\\+\\+ compiler"):
        solver = Solver(h, SolverOptions(cache=str(tmp_path)))
    p = problem_of(h, path, rows=1)
    u = p.last[:, None].repeat(1, 2, 1)
    assert bool(torch.isfinite(solver.solve(p, u, h.rollout(p.z0, u, p.d)).cost).all())
    with pytest.raises(ConfigError, match="compile=off"):
        Solver(h, SolverOptions(compile="on", cache=str(tmp_path)))


def test_a_damaged_package_is_removed_and_said(
    model: NeuralSDE, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimator, arguments = _estimator(model)
    monkeypatch.setattr(compiled, "_key", lambda *_: "key")
    (tmp_path / "e-key.pt2").write_bytes(b"no package")
    with pytest.raises(NoCompiler, match="cannot be loaded"):
        compile_ahead(estimator, arguments, name="e", structure="", folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_key_follows_the_structure_and_not_the_weights(model: NeuralSDE) -> None:
    estimator, arguments = _estimator(model)
    key = compiled._key(estimator, arguments, "a")
    estimator.predictor.system.get_buffer("frozen_thrust_gain").fill_(7.0)
    assert compiled._key(estimator, arguments, "a") == key
    assert compiled._key(estimator, arguments, "b") != key
    wide = [a.repeat(2, *(1,) * (a.ndim - 1)) for a in arguments]
    assert compiled._key(estimator, wide, "a") != key


def test_indices_are_expanded_quickly_and_sympy_is_itself_again_afterwards() -> None:
    before, i = sympy.simplify, sympy.Symbol("i", integer=True)
    with quick_indices():
        assert sympy.simplify(3 * (i + 1) + 2 - 3 * i) == 5
        assert sympy.simplify(sympy.sin(i) ** 2 + sympy.cos(i) ** 2) == 1  # not a polynomial: as ever
    assert sympy.simplify is before
