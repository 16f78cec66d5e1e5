"""A machine that turns about one axis under a rate controller, flown by NumPy alone: nothing here is the package's.

    angle' = rate,    rate' = gain a + gust,    lag a' = u - a (a = u without),    gust an Ornstein-Uhlenbeck process
    u = k_p (k_a (stick - angle') - rate')                        angle', rate': what the controller measures

It is integrated at 1 kHz and logged at 100 Hz with sensor noise. The controller acts on the logged states ("logged"),
at the same times on sensors of its own ("other"), or at 1 kHz on sensors of its own ("fast"); "open" plays inputs that
know nothing of the state.
"""

from collections.abc import Mapping
from math import exp, sqrt

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.data import Run
from nsde_torch.effects import Parameter, Port
from nsde_torch.systems import Defaults, ResidualPort, System

Array = NDArray[np.float64]

CONTROLLERS = ("logged", "other", "fast", "open")
GAIN, LAG_S = 100.0, 0.04
_FINE_S, _LOG_EVERY = 0.001, 10
_GYRO, _ANGLE = 0.02, 0.003  # standard deviations of sensor noise [rad/s], [rad]
_GUST, _GUST_S = 8.0, 0.3  # [rad/s2], [s]
_ATTITUDE, _RATE = 4.0, 0.2  # k_a [1/s], k_p [s/rad]


class RateLoop(System):
    """rate' = gain u."""

    name = "rate_loop"
    state_names = ("angle", "rate")
    state_units = ("rad", "rad/s")
    input_names = ("u",)
    input_units = ("1",)
    ports = {Port.FORCE: 1}
    residual_ports = {Port.FORCE: ResidualPort(1, 1.0, "rad/s2")}
    defaults = Defaults(0.01, 20, (0.01, 0.5), 0.05, 1.0, "euler_maruyama")
    sensor_noise = True
    position_derivatives = (("angle", "rate", "world"),)
    PARAMETERS = {"gain": Parameter(60.0, "rad/s2", low=0.0)}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        return torch.cat((x[:, 1:], self.value("gain") * u + forces.get(Port.FORCE, 0.0)), 1)


def _wander(rng: np.random.Generator, n: int, width: float, dt: float) -> Array:
    """Smooth noise of unit size: white noise through two lags of `width` [s]."""
    keep = exp(-dt / width)
    out = rng.standard_normal(n)
    for _ in range(2):
        last = 0.0
        for k in range(n):
            last = keep * last + (1 - keep) * out[k]
            out[k] = last
    return out / out.std()


def fly(
    controller: str,
    *,
    seeds: range,
    seconds: float = 60.0,
    stick: float = 0.3,
    lag: bool = False,
    pilot: bool = False,
) -> list[list[Run]]:
    """One run for each seed, with the stick [rad] in the column `stick` and a signal that moves nothing in `idle`.

    With a pilot the stick moves against the rate 50 ms later, and is then not exogenous.
    """
    m, n = len(seeds), round(seconds / (_FINE_S * _LOG_EVERY))
    rngs = [np.random.default_rng([seed, 11]) for seed in seeds]
    dt, late = _FINE_S * _LOG_EVERY, 5
    sticks = stick * np.stack([_wander(r, n, 0.15, dt) for r in rngs], 1)
    idle = np.stack([_wander(r, n, 0.15, dt) for r in rngs], 1)
    steps = n * _LOG_EVERY
    gusts = np.stack([r.standard_normal(steps) for r in rngs], 1)
    sizes = np.array([_ANGLE, _GYRO])[:, None, None]
    own = np.stack([r.standard_normal((2, steps)) for r in rngs], 2) * sizes
    seen = np.stack([r.standard_normal((2, n)) for r in rngs], 2) * sizes
    played = 0.4 * np.stack([_wander(r, n, 0.05, dt) for r in rngs], 1)
    angle, rate, acts = np.zeros(m), np.zeros(m), np.zeros(m)
    gust, keep = _GUST * np.stack([r.standard_normal() for r in rngs]), exp(-_FINE_S / _GUST_S)
    log_x, log_u, log_s = np.empty((n, m, 2)), np.empty((n, m)), np.empty((n, m))
    u = np.zeros(m)
    for i in range(steps):
        k = i // _LOG_EVERY
        tick = i % _LOG_EVERY == 0
        if tick:
            log_x[k, :, 0], log_x[k, :, 1] = angle + seen[0, k], rate + seen[1, k]
            wanted = sticks[k] - (0.1 * log_x[max(k - late, 0), :, 1] if pilot else 0.0)
            log_s[k], slope = wanted, (sticks[min(k + 1, n - 1)] - sticks[k]) / _LOG_EVERY
        if controller == "open":
            # a weak pull to the middle would be feedback; the angle may go where it likes
            u = played[k] if tick else u
        elif tick or controller == "fast":
            if controller == "fast":  # a stick moves between rows of the log too
                wanted = log_s[k] + (i % _LOG_EVERY) * slope
            about = log_x[k].T if controller == "logged" else np.stack((angle, rate)) + own[:, i]
            u = _RATE * (_ATTITUDE * (wanted - about[0]) - about[1])
        if tick:
            log_u[k] = u
        before = acts
        acts = acts + (_FINE_S / LAG_S) * (u - acts) if lag else u
        turn = GAIN * (0.5 * (before + acts) if lag else acts) + gust
        angle = angle + _FINE_S * (rate + 0.5 * _FINE_S * turn)
        rate = rate + _FINE_S * turn
        gust = keep * gust + _GUST * sqrt(1 - keep**2) * gusts[i]
    t = dt * np.arange(n)
    extra = [{"stick": log_s[:, j], "idle": idle[:, j]} for j in range(m)]
    runs = [Run(f"run_{k}", t, log_x[:, j], log_u[:, j, None], extra=extra[j]) for j, k in enumerate(seeds)]
    return [[run] for run in runs]
