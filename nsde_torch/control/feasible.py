"""Inputs that hold a machine still or fly a path, and whether it can fly it.

The states of a reference fix accelerations and angular accelerations; the least inputs that give them (see `hovering`)
must lie within the bounds, and some of their range must be left to control with.
"""

from dataclasses import dataclass
from math import isfinite

import torch
from torch import Tensor

from nsde_torch.control.options import ProblemOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.reference import Reference, at_rest
from nsde_torch.errors import ConfigError
from nsde_torch.systems import Multirotor

# Inputs that hold a machine still, and those that fly a path, by the model's own account.
#
# The rates of velocity and body rates that a path asks for are met in the least-squares sense by Newton steps
# on u with the pseudo-inverse of their slope: the inputs of a multirotor with more motors than axes are those
# of least norm.

_STEPS = 6
_RESERVE = 0.05  # share of the range of an input that must be left on both sides


@torch.no_grad()
def inputs_for(predictor: Predictor, x: Tensor, wanted: Tensor) -> Tensor:
    """Inputs (N, nu), not clipped, that give states (N, nx) the wanted rates of `predictor.rates` (N, k).

    Of a multirotor these are accelerations in the world and angular accelerations in the body [m/s2, rad/s2].
    """
    x, wanted = x.to(predictor.dtype), wanted.to(predictor.dtype)
    n, nu = len(x), predictor.nu
    push = x.new_zeros(n, predictor.nd)

    def rates(u: Tensor) -> Tensor:
        return predictor.drift(predictor.augment(x, u), u, push)[:, predictor.rates]

    u = x.new_full((n, nu), 0.4 if isinstance(predictor.system, Multirotor) else 0.0)
    for _ in range(_STEPS):
        # backwards: torch loads its compiler before it differentiates forward, which takes 2 s
        with torch.enable_grad():
            at = u.requires_grad_()
            found = rates(at)
            rows = [torch.autograd.grad(r.sum(), at, retain_graph=True)[0] for r in found.unbind(1)]
        slopes, u = torch.stack(rows, 1), u.detach()
        # directions that hardly turn or lift anything are not worth the inputs that they would take
        u = u + (torch.linalg.pinv(slopes, rtol=1e-3) @ (wanted - found.detach())[..., None])[..., 0]
    return u


def hover_input(predictor: Predictor) -> Tensor:
    """Inputs (nu,) that hold the machine at rest at its origin, as well as they can; they let a multirotor hover."""
    x = at_rest(predictor.system, predictor.dtype)[None]
    return inputs_for(predictor, x, torch.zeros(1, len(predictor.rates)))[0]


@dataclass(frozen=True)
class Envelope:
    """What a reference asks of a machine."""

    speed: float  # largest speed [m/s]
    tilt: float  # largest tilt [deg]
    lowest: float  # lowest height [m]
    input_low: float  # least input
    input_high: float  # largest input
    when: dict[str, float]  # time of each of them [s]


def envelope(reference: Reference, predictor: Predictor) -> Envelope:
    """What a reference asks of a machine, by the model's own account."""
    return _asked(reference, predictor)[0]


def _asked(reference: Reference, predictor: Predictor) -> tuple[Envelope, Tensor]:
    """The same, and the inputs (T, nu) that fly it."""
    x, a = reference.states, torch.from_numpy(reference.path.a)
    angular = torch.gradient(x[:, 10:13], spacing=reference.dt, dim=0)[0]
    u = inputs_for(predictor, x, torch.cat((a, angular), 1)).double()
    tilt = torch.rad2deg(torch.arccos((1 - 2 * (x[:, 7] ** 2 + x[:, 8] ** 2)).clamp(-1, 1)))
    values = {"speed": x[:, 3:6].norm(dim=1), "tilt": tilt, "lowest": x[:, 2]}
    values |= {"input_low": u.min(1).values, "input_high": u.max(1).values}
    worst = {name: int((-v if "low" in name else v).argmax()) for name, v in values.items()}
    most = {name: float(v[worst[name]]) for name, v in values.items()}
    return Envelope(**most, when={name: row * reference.dt for name, row in worst.items()}), u


def check(
    reference: Reference, predictor: Predictor, options: ProblemOptions, *, tilt: float = 60.0
) -> Envelope:
    """Refuse a reference that the machine cannot fly within bounds of the inputs and a largest tilt [deg].

    ConfigError: names what is too much, when, and the remedy.
    """
    inputs, name = predictor.system.input_names, reference.name
    low, high = (torch.tensor(options.of_inputs(k, inputs), dtype=torch.float64) for k in ("low", "high"))
    (found, u), margin = _asked(reference, predictor), _RESERVE * (high - low)
    remedy = "Fly slower, or give it more time; reference.check=false flies it all the same."
    if not all(isfinite(value) for key, value in vars(found).items() if key != "when"):
        raise ConfigError(f"reference {name!r} is not finite. {remedy}")
    if found.tilt > tilt:
        raise ConfigError(
            f"reference {name!r} tilts to {found.tilt:.0f} deg at {found.when['tilt']:.2f} s, beyond the limit of "
            f"{tilt:g} deg. {remedy}"
        )
    for word, end, beyond in (("largest", high, u - (high - margin)), ("least", low, low + margin - u)):
        row, i = divmod(int(beyond.argmax()), len(inputs))
        if beyond[row, i] > 0:
            raise ConfigError(
                f"reference {name!r} needs a command of {u[row, i]:.2f} ({inputs[i]}) at {row * reference.dt:.2f} s; "
                f"the {word} is {end[i]:g}, and {margin[i]:g} beside it are kept to control with. {remedy}"
            )
    if found.lowest < 0:
        raise ConfigError(
            f"reference {name!r} goes {-found.lowest:.2f} m below the ground (p_z = 0) at {found.when['lowest']:.2f} "
            "s. Raise it; reference.check=false flies it all the same."
        )
    return found
