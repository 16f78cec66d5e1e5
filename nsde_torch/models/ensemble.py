"""An ensemble of Gaussian one-step models, the baseline without physics (supplement A).

Member m maps the standardised state and input y to the mean and the log-variance of the standardised change over
one step of the model, each channel by itself:

    x_{k+1} = x_k + c,    c ~ Normal(mean_m(y_k), exp(log_variance_m(y_k)))

The log-variance is held between learned bounds by two softplus functions, with a small weight on their distance in the
loss (Chua et al., Deep reinforcement learning in a handful of trials, NeurIPS 2018, appendix A.1):

    v <- high - softplus(high - v),    v <- low + softplus(v - low),    high = low + softplus(gap)

so that low < v < low + softplus(high - low). The third equation is ours: where the noise is the same everywhere, free
bounds pass each other under that weight, and the network loses its hold on the variance for good.

`sample` propagates particles as in section 5 there: under "fixed" a particle keeps the member that it drew at the
start (TS-infinity: which member is right is not known, but it stays the same one), under "redrawn" it draws one at
every step (TS-1). Particles are independent draws. What is learned and predicted is the measured state: the noise of
the sensors is part of the variance of every step.
"""

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from nsde_torch.errors import ConfigError
from nsde_torch.models.model import Capabilities, Model, ModelSpec, normal
from nsde_torch.models.networks import Standardise, at_zero
from nsde_torch.models.options import EnsembleOptions
from nsde_torch.rotation import matrix, rotation_between, turned
from nsde_torch.sde.checks import check_finite
from nsde_torch.systems import System
from nsde_torch.systems.values import Values

# A state as a network should see it, and the difference of two states as a network should predict it.
#
# An angle is one number too few, because 0 and a full turn are one place: a network sees its sine and cosine.
# A unit quaternion is one number too many, and q and -q are one attitude: a network sees the rotation matrix,
# and a change of attitude is the rotation vector in body axes,
#
#     change = 2 log(conj(q) q'),    q' = q exp(change / 2).
#
# All other columns are seen and differ as they are.

_TURN = 2.0 * torch.pi


class Chart:
    """Inputs (`width` columns) and differences (`n_change` columns) of the states of one system.

    A column whose error does not see a full turn is taken to be an angle (`angles`).
    """

    def __init__(self, system: System) -> None:
        self.nx, self.quaternion = system.nx, system.quaternion
        attitude = range(self.nx)[self.quaternion] if self.quaternion is not None else ()
        at = at_zero(system)
        once = {i: at.index_fill(1, torch.tensor(i), _TURN) for i in range(self.nx) if i not in attitude}
        self.angles = [i for i, x in once.items() if bool((system.error(x, at).abs() < 1e-4).all())]
        self._plain = [i for i in once if i not in self.angles]
        self.width = len(self._plain) + 2 * len(self.angles) + (9 if attitude else 0)
        self.n_change = self.nx - (1 if attitude else 0)

    def inputs(self, x: Tensor) -> Tensor:
        """What a network sees of states (N, nx): (N, width)."""
        angle = x[:, self.angles]
        parts = [x[:, self._plain], torch.sin(angle), torch.cos(angle)]
        if self.quaternion is not None:
            parts.append(matrix(x[:, self.quaternion]).flatten(1))
        return torch.cat(parts, 1)

    def change(self, x: Tensor, after: Tensor) -> Tensor:
        """From states (N, nx) to states (N, nx), angles the short way round: (N, n_change)."""
        difference = after - x
        if self.angles:
            turn = difference[:, self.angles]
            difference[:, self.angles] = turn - _TURN * torch.round(turn / _TURN)
        if self.quaternion is None:
            return difference
        a, b = self.quaternion.start, self.quaternion.stop
        turn = rotation_between(x[:, self.quaternion], after[:, self.quaternion])
        return torch.cat((difference[:, :a], turn, difference[:, b:]), 1)

    def moved(self, x: Tensor, change: Tensor) -> Tensor:
        """States (N, nx) after changes (N, n_change)."""
        if self.quaternion is None:
            return x + change
        a, b = self.quaternion.start, self.quaternion.stop
        attitude = turned(x[:, self.quaternion], change[:, a : a + 3])
        return torch.cat((x[:, :a] + change[:, :a], attitude, x[:, b:] + change[:, a + 3 :]), 1)


# Several networks of one shape, computed together: layer by layer one batched matrix product.
#
# y_m = W_m silu(... silu(W_m x_m + b_m) ...) + b_m,    m = 1 ... members


class StackedMLP(nn.Module):
    """Fully connected silu networks side by side; none sees another's rows or weights.

    Initial weights are uniform, 1 / sqrt(fan in), biases zero.
    """

    def __init__(
        self, members: int, n_in: int, hidden: Sequence[int], n_out: int, *, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for a, b in pairwise((n_in, *hidden, n_out)):
            weight = torch.empty(members, a, b).uniform_(-(a**-0.5), a**-0.5, generator=generator)
            self.weights.append(nn.Parameter(weight))
            self.biases.append(nn.Parameter(torch.zeros(members, 1, b)))

    def forward(self, x: Tensor) -> Tensor:
        """Outputs (members, N, n_out) for rows (members, N, n_in)."""
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias, nn.functional.silu(x) if k else x, weight)
        return x


PROPAGATIONS = ("fixed", "redrawn")
_LOW, _HIGH = -10.0, 0.5  # first bounds of the log-variance of the standardised change


@dataclass(frozen=True)
class EnsembleSpec(ModelSpec):
    """A Gaussian ensemble."""

    kinds = ("ensemble",)
    options = EnsembleOptions

    _: KW_ONLY
    members: int = 5  # number of members
    hidden: tuple[int, ...] = (64, 64)  # widths of the networks (silu)
    propagation: str = "fixed"  # a particle keeps its member; or "redrawn": it draws one at every step
    batch: int = 32  # pairs of states per member and gradient step
    steps: int | None = None  # largest number of gradient steps; None takes ten times those of the trainer


class GaussianEnsemble(Model):
    """Gaussian ensemble of a system; initial `values` of declared parameters play no part here.

    Example:
        >>> spec = EnsembleSpec("cartpole", dt=0.02, horizon=30)
        >>> model = GaussianEnsemble(spec, generator=torch.Generator().manual_seed(0))
    """

    def __init__(
        self, spec: EnsembleSpec, *, generator: torch.Generator, values: Values | None = None
    ) -> None:
        super().__init__()
        self.filter = None
        if spec.effects:
            raise ConfigError(
                f"an ensemble has no physics and takes no effects; got {list(spec.effects)}. "
                "Leave system.effects out."
            )
        self.spec: EnsembleSpec = spec
        self.system = spec.make_system(values)
        self.system.requires_grad_(False)
        self.chart = Chart(self.system)
        n_in = self.chart.width + self.system.nu + len(self.system.exogenous)
        n_out = self.chart.n_change
        self.standardise = Standardise(n_in)
        self.change_scale = Standardise(n_out)
        self.networks = StackedMLP(spec.members, n_in, spec.hidden, 2 * n_out, generator=generator)
        self.low = nn.Parameter(torch.full((spec.members, 1, n_out), _LOW))
        gap = math.log(math.expm1(_HIGH - _LOW))
        self.gap = nn.Parameter(torch.full((spec.members, 1, n_out), gap))

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(propagation=self.spec.propagation)

    # ---- one step -------------------------------------------------------------------------------------

    def inputs(self, x: Tensor, u: Tensor) -> Tensor:
        """What the networks see of states (N, nx) and inputs (N, nu), standardised: (N, n_in)."""
        return self.standardise(torch.cat((self.chart.inputs(x), u), 1))

    def standard(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance of the standardised change, both (members, N, n_change).

        `y` are rows as `inputs` gives them, each member its own (members, N, n_in).
        """
        mean, v = self.networks(y).chunk(2, -1)
        high = self.low + self.width()
        v = high - nn.functional.softplus(high - v)
        return mean, self.low + nn.functional.softplus(v - self.low)

    def width(self) -> Tensor:
        """Distance of the bounds of the log-variance (members, 1, n_change)."""
        return nn.functional.softplus(self.gap)

    # ---- paths ----------------------------------------------------------------------------------------

    def draw_members(self, rows: int, generator: torch.Generator) -> Tensor:
        """Independent uniform members (rows,)."""
        made = torch.randint(self.spec.members, (rows,), generator=generator, device=generator.device)
        return made.to(self.clock_scale.device)

    def advance(self, x: Tensor, u: Tensor, members: Tensor, noise: Tensor) -> Tensor:
        """Valid states (N, nx) one step later, of inputs over the step (N, nu), by the member of each row (N,).

        `noise` are standard normal numbers (N, n_change).
        """
        count = self.spec.members
        # the rows of each member side by side, so that a row costs one member's work and not that of all
        held = torch.bincount(members, minlength=count)
        deep = int(held.max())
        order = members.argsort()
        first = held.cumsum(0) - held
        place = torch.empty_like(members)
        place[order] = torch.arange(len(members), device=members.device) - first.repeat_interleave(held)
        at = members * deep + place
        y = self.inputs(x, u)
        table = y.new_zeros(count * deep, y.shape[1]).index_copy(0, at, y)
        mean, v = (t.reshape(count * deep, -1)[at] for t in self.standard(table.view(count, deep, -1)))
        standard = mean + torch.exp(0.5 * v) * noise
        return self.project(self.chart.moved(x, self.change_scale.mean + self.change_scale.scale * standard))

    def sample(
        self,
        x0: Tensor,
        u: Tensor,
        *,
        dt: float,
        particles: int,
        generator: torch.Generator,
        measurement: bool = True,
        measurement_std: Tensor | None = None,
        applied: bool = False,
        compile: bool = False,
        t0: float | Tensor = 0.0,
        u_before: Tensor | None = None,
    ) -> Tensor:
        """See `Model.sample`.

        `measurement`, `applied` and `compile` change nothing: an ensemble predicts measurements from inputs as logged,
        and its time goes into matrix products that a compiler leaves as they are. `u_before` is checked and changes
        nothing either: an ensemble has no memory. A ConfigError refuses a `dt` that is not the step that it learned,
        and a `measurement_std`.
        """
        x0, u = self.checked(x0, u, particles, generator)
        self.checked_before(u_before, x0)
        if not abs(dt / self.spec.dt - 1) < 1e-6:
            raise ConfigError(
                f"`dt` must be {self.spec.dt:g} s, the step that this ensemble learned; got {dt!r}. It predicts the "
                f"next state and knows no other step: train another with system.dt={dt!r}."
            )
        if measurement_std is not None:
            raise ConfigError(
                "`measurement_std` was given, but an ensemble cannot tell the noise of the sensors from that of the "
                "process. Leave the argument out."
            )
        batch, steps = u.shape[:2]
        rows = particles * batch
        x, tiled = x0.repeat(particles, 1), u.repeat(particles, 1, 1)
        members = self.draw_members(rows, generator)
        path = [x]
        for k in range(steps):
            if k and self.spec.propagation == "redrawn":
                members = self.draw_members(rows, generator)
            x = self.advance(x, tiled[:, k], members, normal((rows, self.chart.n_change), generator, x))
            path.append(x)
        out = torch.stack(path, 1).view(particles, batch, steps + 1, -1)
        check_finite(out, dt=dt, t0=t0, remedy="Look for states and inputs far from the training data.")
        return out
