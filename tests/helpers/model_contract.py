"""What holds for every kind of model: its test class inherits `ModelContract` and trains one."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.errors import NsdeError
from nsde_torch.models import Model, make_spec
from nsde_torch.models.kind import model_kind


class ModelContract:
    """Inherit, and write the fixture `trained`: a model with its run directory in `model.folder`."""

    @pytest.fixture
    def trained(self) -> Model:
        raise NotImplementedError

    def rows(self, model: Model, n: int = 3, steps: int = 4) -> tuple[Tensor, Tensor]:
        """First states and inputs that a machine could have."""
        s, g = model.system, torch.Generator().manual_seed(0)
        x = 0.1 * torch.randn(n, s.nx, generator=g)
        if s.quaternion is not None:
            x[:, s.quaternion] /= x[:, s.quaternion].norm(dim=1, keepdim=True)
        return model.project(x.to(model.clock_scale)), 0.1 * torch.rand(n, steps, s.nu, generator=g)

    def sample(self, model: Model, x: Tensor, u: Tensor, *, particles: int = 5, seed: int = 0) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        return model.sample(x, u, dt=model.spec.dt, particles=particles, generator=generator)

    def test_its_specification_survives_plain_values(self, trained: Model) -> None:
        assert make_spec(trained.spec.as_dict()) == trained.spec
        kind = model_kind(trained.spec.kind)
        assert isinstance(trained, kind.model)
        assert isinstance(trained.spec, kind.spec)

    def test_what_is_loaded_predicts_what_was_trained(self, trained: Model) -> None:
        assert trained.folder is not None
        loaded = nsde_torch.load(Path(trained.folder))
        x, u = self.rows(trained)
        torch.testing.assert_close(self.sample(loaded, x, u), self.sample(trained, x, u))

    def test_paths_start_where_they_are_told_and_are_finite(self, trained: Model) -> None:
        x, u = self.rows(trained)
        path = self.sample(trained, x, u)
        assert path.shape == (5, 3, 5, trained.system.nx)
        torch.testing.assert_close(path[:, :, 0], x.expand(5, *x.shape))
        assert bool(torch.isfinite(path).all())

    def test_chance_is_the_generators_alone(self, trained: Model) -> None:
        x, u = self.rows(trained)
        torch.testing.assert_close(self.sample(trained, x, u), self.sample(trained, x, u))
        if bool((self.sample(trained, x, u)[0] != self.sample(trained, x, u)[1]).any()):
            assert bool((self.sample(trained, x, u) != self.sample(trained, x, u, seed=1)).any())

    def test_a_run_is_predicted_piece_by_piece(self, trained: Model) -> None:
        x, _ = self.rows(trained, n=1)
        dt, system = trained.spec.dt, trained.system
        u = np.full((13, system.nu + len(system.exogenous)), 0.1)
        run = Run("a", dt * np.arange(13), x.expand(13, -1).cpu().double().numpy(), u)
        found = trained.predict(run, horizon=4 * dt, particles=9)
        assert (found.ahead == 0).sum() == 3
        begun = found.ahead == 0
        np.testing.assert_allclose(found.median[begun], found.measured[begun], atol=1e-4)
        assert bool((found.low <= found.high).all())
        assert trained.spec.system in repr(trained)

    def test_rows_that_do_not_fit_are_refused(self, trained: Model) -> None:
        x, u = self.rows(trained)
        for wrong_x, wrong_u in ((x[:, 1:], u), (x, u[:, 0]), (x[:2], u), (x * torch.nan, u)):
            with pytest.raises(NsdeError):
                self.sample(trained, wrong_x, wrong_u)

    def test_it_says_what_it_can_do_and_has_what_it_says(self, trained: Model) -> None:
        can = trained.capabilities
        if can.is_equation:
            assert trained.step  # type: ignore[truthy-function]
            assert trained.nz >= trained.system.nx  # type: ignore[operator]
        if can.has_physics:
            assert trained.system.all_declared()
        if can.learns_sensors:
            assert trained.measurement_std.shape == (trained.system.nx,)  # type: ignore[union-attr, operator]
        assert not can.is_stochastic or can.is_equation
