"""What holds for every system: its test class inherits `SystemContract` and says how to make one."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nsde_torch.sde import STEPS, make_step, rollout
from nsde_torch.systems import System
from tests.helpers.sde_problems import Quiet


class Ode(Quiet):
    """A system without noise, as the solvers want it; memory rides along."""

    def __init__(self, system: System) -> None:
        self.system, self.project = system, system.project  # type: ignore[method-assign]

    def drift(self, t: Any, z: Tensor, u: Tensor) -> Tensor:
        return self.system.drift(t, z, u)


def solve(system: System, x0: Tensor, u: Tensor, dt: float) -> Tensor:
    """Noise-free states and memory (B, T + 1, nz) by the classical Runge-Kutta method."""
    with torch.no_grad():
        z0 = system.augment(x0, u[:, 0])
        return rollout(Ode(system), z0, u, dt=dt, step=make_step("rk4"), noise=None)[0]


class SystemContract:
    """Inherit, and write `make`; override the rest where the machine asks for it."""

    def make(self, **options: Any) -> System:
        """The system in float32 with its own initial parameters."""
        raise NotImplementedError

    def other_values(self) -> dict[str, float]:
        """Parameters of a machine to be identified, unlike the initial ones; empty where none are guessed."""
        return {}

    def states(self, n: int, *, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
        system = self.make()
        x = torch.randn(n, system.nx, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        if system.quaternion is not None:
            x[:, system.quaternion] /= x[:, system.quaternion].norm(dim=1, keepdim=True)
        return x.to(dtype)

    def inputs(self, n: int, *, seed: int = 1, dtype: torch.dtype = torch.float64) -> Tensor:
        u = torch.rand(n, self.make().nu, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        return u.to(dtype)

    def twin(self, x: Tensor) -> Tensor:
        """The same physical states written with other numbers (-q for q, an angle a turn on)."""
        return x

    # ---- names ----------------------------------------------------------------------------------------

    def test_every_column_has_a_name_and_a_unit(self) -> None:
        s = self.make()
        assert len(s.state_names) == len(s.state_units) == s.nx == len(set(s.state_names))
        assert len(s.input_names) == len(s.input_units) == s.nu == len(set(s.input_names))
        assert all((*s.state_units, *s.input_units, *s.feature_units))
        x = self.states(3)
        assert s.features(x).shape == (3, len(s.feature_names)) == (3, len(s.feature_units))
        assert s.error(x, x).shape == (3, len(s.error_names))
        used = [k for group in s.error_groups for k in group.channels]
        assert sorted(used) == list(range(len(s.error_names)))
        assert all(group.unit and group.factor > 0 for group in s.error_groups)
        assert len({group.name for group in s.error_groups}) == len(s.error_groups)

    def test_defaults_fit_the_system_and_declared_parameters_have_units_and_finite_values(self) -> None:
        d = self.make().defaults
        assert len(d.sigma_max) == self.make().nx
        assert min(*d.sigma_max, d.dt, d.horizon, d.ball_radius, d.lambda_mu) > 0
        assert d.step in STEPS
        for name, (value, unit) in self.make().all_declared().items():
            assert unit, name
            assert bool(torch.isfinite(value).all()), name

    # ---- drift ----------------------------------------------------------------------------------------

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_drift_has_the_shape_and_precision_of_the_state(self, dtype: torch.dtype) -> None:
        s = self.make().to(dtype)
        x, u = self.states(7, dtype=dtype), self.inputs(7, dtype=dtype)
        z = s.augment(x, u)
        rate = s.drift(0.0, z, u)
        assert z.shape == rate.shape == (7, s.nz)
        assert rate.dtype == s.features(x).dtype == s.project(z).dtype == s.error(x, x).dtype == dtype
        assert bool(torch.isfinite(rate).all())

    def test_single_and_double_precision_agree(self) -> None:
        s = self.make()
        x, u = self.states(20), self.inputs(20)
        low = s.drift(0.0, s.augment(x.float(), u.float()), u.float())
        s.double()
        torch.testing.assert_close(low.double(), s.drift(0.0, s.augment(x, u), u), rtol=1e-4, atol=1e-4)

    def test_rows_do_not_know_of_each_other(self) -> None:
        s = self.make().double()
        x, u = self.states(9), self.inputs(9)
        z = s.augment(x, u)
        together, features = s.drift(0.0, z, u), s.features(x)
        for k in (0, 4, 8):
            torch.testing.assert_close(s.drift(0.0, z[k : k + 1], u[k : k + 1])[0], together[k])
            torch.testing.assert_close(s.features(x[k : k + 1])[0], features[k])

    def test_gradients_are_finite_and_reach_every_parameter(self) -> None:
        s = self.make().double()
        x, u = self.states(16).requires_grad_(), self.inputs(16).requires_grad_()
        weights = self.states(16, seed=3)
        (s.drift(0.0, s.augment(x, u), u)[:, : s.nx] * weights).sum().backward()
        for name, tensor in (("x", x), ("u", u), *s.named_parameters()):
            assert tensor.grad is not None, name
            assert bool(torch.isfinite(tensor.grad).all()), name
            assert bool((tensor.grad != 0).any()), f"nothing depends on {name}"

    def test_a_velocity_is_the_rate_of_its_position(self) -> None:
        s = self.make().double()
        x, u = self.states(5), self.inputs(5)
        rate = s.drift(0.0, s.augment(x, u), u)
        for position, velocity, frame in s.position_derivatives:
            assert frame == "world"
            i, j = s.state_names.index(position), s.state_names.index(velocity)
            torch.testing.assert_close(rate[:, i], x[:, j])

    def test_a_residual_acts_through_its_port_and_leaves_kinematics_alone(self) -> None:
        s = self.make().double()
        x, u = self.states(5), self.inputs(5)
        z = s.augment(x, u)
        plain = s.drift(0.0, z, u)
        assert s.residual_features(x).shape[0] == 5
        for port, kind in s.residual_ports.items():
            assert s.ports[port] == kind.width
            assert kind.unit
            assert kind.scale > 0
            pushed = s.drift(0.0, z, u, {port: torch.ones(5, kind.width, dtype=torch.float64)})
            assert bool(((pushed - plain).abs().amax(1) > 1e-6).all()), port
            for position, _, _ in s.position_derivatives:
                i = s.state_names.index(position)
                torch.testing.assert_close(pushed[:, i], plain[:, i])

    # ---- states ---------------------------------------------------------------------------------------

    def test_projecting_twice_is_projecting_once(self) -> None:
        s = self.make().double()
        x = self.states(20) * 1.3
        z = s.augment(x, self.inputs(20))
        once = s.project(z)
        torch.testing.assert_close(s.project(once), once)
        torch.testing.assert_close(s.project(self.states(20)), self.states(20))

    def test_the_error_of_equal_states_is_zero_and_has_finite_gradients(self) -> None:
        s = self.make().double()
        x = self.states(10).requires_grad_()
        error = s.error(x, x.detach())
        torch.testing.assert_close(error.detach(), torch.zeros_like(error))
        error.square().sum().backward()
        assert x.grad is not None
        assert bool(torch.isfinite(x.grad).all())

    def test_the_error_takes_particles_against_one_measurement(self) -> None:
        s = self.make().double()
        a, b = self.states(24).reshape(2, 3, 4, -1), self.states(12, seed=8).reshape(3, 4, -1)
        error = s.error(a, b.expand_as(a))
        torch.testing.assert_close(error, -s.error(b.expand_as(a), a))
        assert error.shape == (2, 3, 4, len(s.error_names))
        torch.testing.assert_close(error[1, 2, 3], s.error(a[1, 2, 3], b[2, 3]))

    def test_one_state_written_twice_has_no_error_the_same_features_and_physics(self) -> None:
        s = self.make().double()
        x, u = self.states(20), self.inputs(20)
        other = self.twin(x)
        torch.testing.assert_close(s.error(other, x), torch.zeros_like(s.error(x, x)), atol=1e-9, rtol=0)
        torch.testing.assert_close(s.features(other), s.features(x))
        torch.testing.assert_close(s.residual_features(other), s.residual_features(x))
        a, b = (s.drift(0.0, s.augment(y, u), u) for y in (x, other))
        turns = range(s.nx)[s.quaternion or slice(0)]  # a quaternion's rate turns its sign with it
        keep = [k for k in range(s.nx) if k not in turns]
        torch.testing.assert_close(a[:, keep], b[:, keep])

    def test_the_start_of_a_rollout_holds_the_state_and_stationary_memory(self) -> None:
        s = self.make().double()
        x, u = self.states(6), self.inputs(6)
        z = s.augment(x, u)
        torch.testing.assert_close(z[:, : s.nx], x)
        memory_rate = s.drift(0.0, z, u)[:, s.nx :]
        torch.testing.assert_close(memory_rate, torch.zeros_like(memory_rate))

    # ---- first guess ----------------------------------------------------------------------------------

    def simulated(self, *, seconds: float = 3.0, dt: float = 0.01) -> tuple[Tensor, Tensor, float]:
        """States (n, nx) and inputs (n, nu) of a machine with `other_values`, from rest."""
        s = self.make(values=self.other_values()).double()
        n = round(seconds / dt)
        u = self.excitation(n, dt)
        x0 = torch.zeros(1, s.nx, dtype=torch.float64)
        if s.quaternion is not None:
            x0[:, s.quaternion.start] = 1.0
        path = solve(s, x0, u[None], dt)[0, :-1, : s.nx]
        return path, u, dt

    def excitation(self, n: int, dt: float) -> Tensor:
        """Inputs (n, nu) that move the machine."""
        t = dt * torch.arange(n, dtype=torch.float64)
        return torch.stack([torch.sin((3 + k) * t) for k in range(self.make().nu)], 1)

    def test_first_values_from_data_are_finite_and_bring_the_drift_nearer(self) -> None:
        x, u, dt = self.simulated()
        x_data, u_data = x.numpy().copy(), u.numpy().copy()
        x_data.flags.writeable = u_data.flags.writeable = False  # as the arrays of a run are
        values = self.make().start_values(x_data, u_data, dt)
        assert all(np.isfinite(value).all() for value in values.values())
        measured = np.gradient(x.numpy(), dt, axis=0)[1:-1]
        miss = []
        for s in (self.make().double(), self.make(values=values).double()):
            with torch.no_grad():
                rate = s.drift(0.0, s.augment(x, u), u)[1:-1, : s.nx].numpy()
            miss.append(np.sqrt(((rate - measured) ** 2).mean()))
        assert miss[1] <= miss[0] * (0.5 if self.other_values() else 1.0) + 1e-12

    def test_inputs_that_never_move_give_finite_first_values_and_too_little_data_none(self) -> None:
        s = self.make()
        assert s.start_values(np.zeros((2, s.nx)), np.zeros((2, s.nu)), 0.01) == {}
        x = self.states(1).numpy().repeat(50, axis=0)
        for level in (0.0, 0.3):
            values = s.start_values(x, np.full((50, s.nu), level), 0.01)
            assert all(np.isfinite(v).all() for v in values.values())
            self.make(values=values)
