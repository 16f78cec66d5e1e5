"""Episodes of the cart and pole: random pushes, or a controller that swings the pole up and balances it.

Swing-up by energy (Astrom and Furuta, Automatica 36, 2000): with the pole's energy about upright

    E = 2/3 l theta'^2 + g (cos theta - 1)         (over m l),   dE/dt = -x'' theta' cos theta,

the cart's acceleration x'' = k E theta' cos theta brings E to 0, with a spring and a damper that keep the
cart near the middle; the force that gives x'' follows from the equations of motion. Near upright a
linear-quadratic regulator on the linearised equations takes over. First states are uniform in [-1, -1, pi -
0.8, -0.8] .. [1, 1, pi + 0.8, 0.8].
"""

from collections.abc import Sequence
from math import pi

import numpy as np
import torch
from scipy.linalg import solve_discrete_are
from torch import Tensor

from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.simulation.make import Making, record
from nsde_torch.systems import Cartpole
from nsde_torch.systems.machines import make_plant_system
from nsde_torch.systems.one_dof import GRAVITY

DURATIONS = (4.0,) * 20
POLICIES = ("mixed", "random", "on_policy")
FORCE = 25.0  # force of a unit of action [N]
LOW, HIGH = (-1.0, -1.0, pi - 0.8, -0.8), (1.0, 1.0, pi + 0.8, 0.8)
NEAR = (0.45, 2.5)  # angle [rad] and rate [rad/s] within which the regulator takes over


class SwingUp:
    """Swings the pole of a cart up and balances it at a sample [s]; batched, knows the declared physics."""

    def __init__(self, system: Cartpole, *, dt: float) -> None:
        values = {k: float(v) for k, (v, _) in system.declared_parameters().items()}
        self._mass, self._share = 1.0 / values["force_gain"], values["pole_share"]
        self._length = values["half_length"]
        self._gain = torch.as_tensor(self._regulator(dt))

    def _regulator(self, dt: float) -> np.ndarray:
        """Gain of the discrete regulator about upright, (1, 4)."""
        share, length = self._share, self._length
        inertia = length * (4.0 / 3.0 - share)
        a = np.zeros((4, 4))
        a[0, 1] = a[2, 3] = 1.0
        a[3, 2], a[1, 2] = GRAVITY / inertia, -share * length * GRAVITY / inertia
        b = np.array([[0.0], [1.0 + share * length / inertia], [0.0], [-1.0 / inertia]]) / self._mass
        square = a @ a
        ad = np.eye(4) + dt * a + dt**2 / 2 * square + dt**3 / 6 * square @ a
        bd = (dt * np.eye(4) + dt**2 / 2 * a + dt**3 / 6 * square) @ b
        p = solve_discrete_are(ad, bd, np.diag([1.0, 0.3, 10.0, 1.0]), np.array([[0.02]]))
        return np.asarray(np.linalg.solve(0.02 + bd.T @ p @ bd, bd.T @ p @ ad))

    @torch.no_grad()
    def __call__(self, x: Tensor) -> Tensor:
        """Force (B, 1) [N] within 25 N for measured states (B, 4)."""
        theta = torch.remainder(x[:, 2] + pi, 2 * pi) - pi
        rate, sin, cos = x[:, 3], torch.sin(theta), torch.cos(theta)
        energy = 2.0 / 3.0 * self._length * rate**2 + GRAVITY * (cos - 1.0)
        push = 1.2 * energy * rate * cos
        # hanging still there is nothing to pump: the first push comes from here
        push = torch.where((rate.abs() < 0.2) & (cos < -0.9), torch.full_like(push, 4.0), push)
        wanted = (push - 1.0 * x[:, 0] - 0.8 * x[:, 1]).clamp(-12.0, 12.0)
        turn = (GRAVITY * sin - wanted * cos) * 0.75  # l theta''
        swing = self._mass * (wanted + self._share * (turn * cos - self._length * rate**2 * sin))
        held = torch.stack((x[:, 0], x[:, 1], theta, rate), 1)
        balance = -(held @ self._gain.T.to(held))[:, 0]
        near = (theta.abs() < NEAR[0]) & (rate.abs() < NEAR[1])
        return torch.where(near, balance, swing).clamp(-FORCE, FORCE)[:, None]


def cartpole_episodes(
    name: str = "cartpole",
    *,
    durations: Sequence[float] | None = None,
    seed: int,
    policy: str = "mixed",
    exploration: float = 0.1,
    making: Making = Making(),
) -> list[RawRun]:
    """Episodes of the cart and pole, at 50 Hz (or on the step of `making`): measured states and the force [N].

    By default they are twenty of 4 s. The `policy` is `random` (a new action, uniform in [-1, 1], at every sample),
    `on_policy` (swing up and balance), or `mixed` (the episodes in turn); `exploration` is the standard deviation of
    the noise added to the actions of the controller. The sensor noise [0.0071 m, 0.01 m/s, 0.03 rad, 0.0412 rad/s] is a
    tenth of that of the published data: `sensor_noise=10` gives data as noisy as the authors'. A ConfigError where a
    policy or effect is unknown, or a number out of range.
    """
    if policy not in POLICIES:
        raise ConfigError(f"`policy` must be one of {', '.join(POLICIES)}; got {policy!r}.")
    if not exploration >= 0:
        raise ConfigError(f"`exploration` must be 0 or more; got {exploration!r}.")
    lengths = DURATIONS if durations is None else durations
    rng = np.random.default_rng([seed, 1])
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    plant = making.plant(name, generator=generator)
    system = make_plant_system(name, declared_only=True)
    assert isinstance(system, Cartpole)
    controller = SwingUp(system, dt=plant.dt)
    batch = len(lengths)
    start = rng.uniform(LOW, HIGH, (batch, 4))
    random = {"random": np.ones(batch), "on_policy": np.zeros(batch), "mixed": np.arange(batch) % 2}[policy]
    pushes = torch.as_tensor(random == 1)[:, None]

    def control(t: float, x: Tensor) -> Tensor:
        action = torch.as_tensor(rng.uniform(-1.0, 1.0, (batch, 1)))
        noise = torch.as_tensor(exploration * rng.standard_normal((batch, 1)))
        own = (controller(x) + FORCE * noise).clamp(-FORCE, FORCE)
        return torch.where(pushes, FORCE * action, own)

    return record(plant, start, control, durations=lengths, prefix="episode")
