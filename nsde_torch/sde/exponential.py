"""Steps of machines of which something settles in hardly more than a step: a current, a pressure.

    z' = f(z),  J = df/dz at z,   y = z + h phi_1(h J) f(z),   z_next = y + 2 h phi_3(h J) (f(y) - f(z) - J (y - z))

is exprb32 (Hochbruck, Ostermann, Schweitzer, SIAM Journal on Numerical Analysis 47 (2009)): of third order, and exact
for what is linear, however fast it settles. Runge and Kutta's rule is a percent off where an eigenvalue times the step
is 0.9, and diverges at 2.8. Noise goes through phi_1(h J) g dW, as an average over the step.
"""

import warnings
from collections.abc import Callable
from typing import final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.sde.step import SDE, Step, Time, within

# of the largest eigenvalue, times a step. Of a motor whose current settles in 1 ms and that is logged every 10 ms, the
# voltage was to turn the other way, and was a torque of its own (tests/inference/test_stiff.py)
_STIFF = 0.7
MOSTLY = 0.5  # share of the rows
# differences of states whose size is between a thousandth and a thousand; of others they are in proportion to it
_SMALL = 1e-6
_DOUBLED = 8  # times a model doubles, as what is traced has no numbers: enough for norms of 128
_BALANCED = 4  # times that each row and column is made as large as the other
_TERMS = 10  # of the series, as `matrix_functions.TERMS`


def largest(a: Tensor) -> Tensor:
    """About the largest eigenvalue (N,) of slopes of rates, times a step (N, n, n); inf of what are no numbers."""
    power = torch.linalg.matrix_power(a * _balance(a).to(a), 8)
    return (power.abs().sum(-1).amax(-1) ** 0.125).nan_to_num(torch.inf)


def stiff_rows(a: Tensor) -> Tensor:
    """Whether slopes of rates, times a step (N, n, n), are too large for a rule that takes them for small (N,)."""
    return largest(a) > _STIFF


def is_stiff(a: Tensor) -> bool:
    """Whether most of some slopes (N, n, n) are; a dry friction holds what stands in a few rows."""
    return float(stiff_rows(a).double().mean()) > MOSTLY


def exponentials(a: Tensor, doubled: int | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """The functions phi_1, phi_2 and phi_3 of matrices (N, n, n): phi_1(a) = a^-1 (exp(a) - 1).

    By the series at a part of them of 2^-doubled, doubled (Higham, Functions of Matrices (2008), chapter 10); None: as
    small a part as each asks for, in double precision, and no numbers of those that ask for less than 2^-14.
    """
    if doubled is None:
        from nsde_torch.sde.matrix_functions import phi

        whole = a.detach().double()
        turn = _balance(whole)
        whole = (whole * turn).contiguous()
        one, two, three = (torch.empty_like(whole) for _ in range(3))
        phi(*(values.numpy() for values in (whole, one, two, three)))
        return one / turn, two / turn, three / turn
    eye = torch.eye(a.shape[-1], dtype=a.dtype, device=a.device)
    part, three = a / 2.0**doubled, torch.zeros_like(a)
    for k in reversed(range(_TERMS)):
        three = eye + part @ three / (k + 4.0)
    three = three / 6.0
    two = 0.5 * eye + part @ three
    one = eye + part @ two
    for _ in range(doubled):
        whole = eye + part @ one
        three = 0.125 * (one @ two + two + 2.0 * three)
        two = 0.25 * (one @ one + 2.0 * two)
        one, part = 0.5 * (one + whole @ one), 2.0 * part
    return one, two, three


def _balance(a: Tensor) -> Tensor:
    """Factors (n, n) of the elements of matrices (N, n, n), d_j / d_i, that make them as large in rows as in columns.

    Of a stiff spring the slopes of a rate in a position are the square of a frequency: without it they are doubled six
    times more often (Osborne, Journal of the ACM 7 (1960)).
    """
    n = a.shape[-1]
    size = a.abs().nan_to_num(0.0, 0.0, 0.0).mean(0).fill_diagonal_(0.0).numpy()
    d = np.ones(n)
    for _ in range(_BALANCED):
        for i in range(n):
            rows, columns = (size[i] * d / d[i]).sum(), (size[:, i] * d[i] / d).sum()
            if rows > 0.0 and columns > 0.0:
                d[i] *= np.sqrt(rows / columns)
    return torch.from_numpy(d / d[:, None])


def jacobians(rate: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Slopes (N, n, n) of the rates of states (N, n) in these, by differences in double precision."""
    base, small = rate(x), differences(x)
    return torch.stack([(rate(x + push) - base) / push.sum() for push in torch.diag(small)], 2)


def differences(x: Tensor) -> Tensor:
    """By how much states like some (N, n) are moved for slopes (n,): of 10 um there is none over 1 um."""
    size = x.abs().amax(0) if len(x) else x.new_zeros(x.shape[1])
    size = torch.where(size > 0.0, size, 1.0)
    return _SMALL * torch.minimum(torch.maximum(torch.ones_like(size), 1e-3 * size), 1e3 * size)


def exact_jacobians(rate: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """The same in any precision, differentiable, at ten times the cost."""
    eye = torch.eye(x.shape[1], dtype=x.dtype, device=x.device)
    with warnings.catch_warnings():  # of torch about its own, where it is first asked for one
        warnings.simplefilter("ignore", DeprecationWarning)
        return torch.stack([torch.func.jvp(rate, (x,), (push.expand_as(x),))[1] for push in eye], 2)


def stiff_change(
    rate: Callable[[Tensor], Tensor],
    x: Tensor,
    h: Time,
    slopes: Tensor | None = None,
    turns: Tensor | None = None,
) -> Tensor:
    """By how much states (N, n) change over a step of h [s], from their rates, and slopes of these (N, n, n).

    Where inputs move within the step, and the rates by `turns` (N, n) evenly about their mean, these do
    h (phi_2 - phi_1 / 2) turns.
    """
    a = h * (jacobians(rate, x) if slopes is None else slopes)
    one, two, three = exponentials(a, None if slopes is None else _DOUBLED)
    before = h * rate(x)
    moved = _times(one, before)
    remainder = h * rate(x + moved) - before - _times(a, moved)
    change = moved + 2.0 * _times(three, remainder)
    return change if turns is None else change + h * _times(two - 0.5 * one, turns)


def _times(a: Tensor, x: Tensor) -> Tensor:
    return torch.bmm(a, x[..., None])[..., 0]


class _Exponential(Step):
    compilable = False

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        def rate(y: Tensor) -> Tensor:
            return sde.drift(t + 0.5 * dt, within(sde, z, y), u)

        slopes = exact_jacobians(rate, z)
        out = z + stiff_change(rate, z, dt, slopes)
        if dw is None:
            return out
        return out + _times(exponentials(dt * slopes, _DOUBLED)[0], sde.diffusion(t, z, u) * dw)


@final
class Exponential(_Exponential):
    """Exponential Rosenbrock step without noise: n slopes and two drifts."""

    name = "exponential"
    calculus = "none"
    strong_order = 3.0
    deterministic = True


@final
class ExponentialMaruyama(_Exponential):
    """The same with additive noise: one diffusion more; order 1 if g does not depend on z."""

    name = "exponential_maruyama"
    calculus = "ito"
    strong_order = 0.5
