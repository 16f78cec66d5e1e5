"""Methods of the solver: Gauss-Newton, and accelerated gradients.

Linearise all steps of all paths in one batch about inputs u and states z (which need not fit each other):

    dz_{k+1} = A_k dz_k + B_k du_k + (F(z_k, u_k) - z_{k+1}),     r_{k+1} = r(F(z_k, u_k)) + C_k dz_k + D_k du_k

with A = dF/dz, B = dF/du, C = (dr/dx) A, D = (dr/dx) B by forward differentiation. Eliminating dz leaves a quadratic in
du,

    q(du) = |W du + w|^2 + input terms = du^T H du + 2 g^T du + q(0),      low - u <= du <= high - u,

which primal-dual active sets minimise (Hintermueller, Ito, Kunisch, SIAM J. Optim. 13, 2003): inputs that would leave
the box are held at its bound, the others solve their linear equations, and the sign of the slope says which to let go.
Steps a du with a = 1, 1/2, ... and 0 are then rolled out through the model as one batch, and the cheapest is kept, so
that no iteration makes a plan worse.
The first states may be those of the plan before: the gaps F(z_k, u_k) - z_{k+1} are part of the problem (multiple
shooting; Bock and Plitt, IFAC 1984), and no rollout comes before the linearisation.
"""

from collections.abc import Sequence
from typing import NamedTuple, final

import torch
from torch import Tensor, nn

from nsde_torch.control.problem import Horizon, _repeat

SHARES = (1.0, 0.5, 0.2, 0.05)  # shares of a step that are tried, beside none of it
LEFT = 1e-3
"""Share of the quadratic's saving (and of a tenth of the cost) that an iteration may leave to the next."""
CHANGES = 8  # most changes of the active set in an iteration


Memory = tuple[Tensor, ...]
"""What a method keeps from one iteration to the next; nothing before the first."""


class Iterate(NamedTuple):
    """Plans after an iteration."""

    u: Tensor  # inputs (N, K, nu), within bounds
    z: Tensor  # states (N, P, K + 1, nz)
    cost: Tensor  # their cost (N,)
    before: Tensor  # cost of the inputs that the iteration began with (N,)
    gap: Tensor
    """Share of the cost that the quadratic could have saved and the model did not (N,); where its active set was not
    found, at least the share that was saved."""
    worst: Tensor  # largest gap, 0-d


@final
class GaussNewton(nn.Module):
    """An iteration in three stages, each from plain tensors to plain tensors; between them only numbers are compared.

    The arguments of stages and iterations are

        z0      states with memory now (N, nz)
        u       inputs to start from (N, K, nu), within bounds
        z       states to linearise about (N, P, K + 1, nz)
        ref     references at the ends of the steps (N, K, nx)
        last    inputs before the plan (N, nu)
        d       pushes (N, nd)
    """

    def __init__(self, horizon: Horizon) -> None:
        super().__init__()
        self.horizon = horizon
        n = horizon.steps * horizon.nu
        self.eye: Tensor
        self.steps: Tensor
        self.shares: Tensor
        self.change: Tensor
        dtype = horizon.predictor.dtype
        self.register_buffer("eye", torch.eye(n, dtype=dtype))
        self.register_buffer("steps", torch.eye(horizon.steps, dtype=dtype))
        self.register_buffer("shares", torch.tensor((*SHARES, 0.0), dtype=dtype))
        # changes of the inputs from step to step, of all inputs
        before = torch.diag(torch.ones(n - horizon.nu, dtype=dtype), -horizon.nu)
        self.register_buffer("change", self.eye - before)

    def iterate(self, arguments: Sequence[Tensor], memory: Memory) -> tuple[Iterate, Memory]:
        """Improve plans, with as many changes of the active set as are needed."""
        z0, u, _, ref, last, d = arguments
        *quadratic, best, least = self.prepare(*arguments)
        state = [torch.zeros_like(best), quadratic[1], best, least]
        for _ in range(CHANGES):
            *state, left = self.active_set(*quadratic, *state)
            if float(left) <= LEFT:
                break
        found = self.finish(z0, u, ref, last, d, *state[2:])
        if float(left) > LEFT:
            # a quadratic that is not solved keeps its promise too: of two joints from rest 701 seemed the end of 305
            gap = found.gap.maximum(saved(found.before, found.cost))
            found = found._replace(gap=gap, worst=gap.max())
        return found, ()

    def prepare(
        self, z0: Tensor, u: Tensor, z: Tensor, ref: Tensor, last: Tensor, d: Tensor
    ) -> tuple[Tensor, ...]:
        """The quadratic and its box (H, g, low - u, high - u, the cost at u (N,)), and a first step.

        That is a step (N, K nu) and the value of the quadratic there (N,).
        """
        h = self.horizon
        hessian, gradient, cost = self.quadratic(z0, u, z, ref, last, d)
        low, high = (h.low - u).flatten(1), (h.high - u).flatten(1)
        # along the scaled gradient, as far as the quadratic falls: poor, but never worse than no step
        scale = torch.diagonal(hessian, dim1=1, dim2=2)
        step = torch.minimum(torch.maximum(-gradient / scale, low), high)
        along, curve = (gradient * step).sum(1), (step * _times(hessian, step)).sum(1)
        share = (-along / curve.clamp_min(1e-12)).clamp(0.0, 1.0)
        first = share[:, None] * step
        return hessian, gradient, low, high, cost, first, share * (share * curve + 2.0 * along)

    def active_set(
        self,
        hessian: Tensor,
        gradient: Tensor,
        low: Tensor,
        high: Tensor,
        cost: Tensor,
        step: Tensor,
        slope: Tensor,
        best: Tensor,
        least: Tensor,
    ) -> tuple[Tensor, ...]:
        """One change of the active set, of a quadratic as `prepare` has it.

        Args:
            step, slope: The step before, perhaps outside the box, and H step + g there (N, K nu).
            best, least: The best step on the box so far (N, K nu), and the value of the quadratic there (N,).

        Returns:
            step, slope, best, least, and the largest share of the saving that a better step could add, 0-d.
        """
        scale = torch.diagonal(hessian, dim1=1, dim2=2)
        aim = step - slope / scale
        at_low, at_high = aim < low, aim > high
        free = (~(at_low | at_high)).to(gradient)
        held = torch.where(at_low, low, torch.where(at_high, high, torch.zeros_like(low)))
        masked = hessian * (free[:, :, None] * free[:, None, :]) + self.eye * (1.0 - free)[:, None, :]
        factor, _ = torch.linalg.cholesky_ex(masked)
        right = (-(gradient + _times(hessian, held)) * free)[..., None]
        step = held + torch.cholesky_solve(right, factor)[..., 0] * free
        slope = _times(hessian, step) + gradient
        inside = torch.minimum(torch.maximum(step, low), high)
        product = _times(hessian, inside)
        value = (inside * (product + 2.0 * gradient)).sum(1)
        # a convex quadratic lies above its tangents: no step on the box is better than `inside` by more than this
        tangent = product + gradient
        left = 2.0 * torch.maximum(tangent * (inside - low), tangent * (inside - high)).sum(1)
        better = value < least
        best = torch.where(better[:, None], inside, best)
        least = torch.where(better, value, least)
        return step, slope, best, least, ((value + left - least) / (0.1 * cost.abs() - least)).max()

    def finish(
        self, z0: Tensor, u: Tensor, ref: Tensor, last: Tensor, d: Tensor, step: Tensor, least: Tensor
    ) -> Iterate:
        """Roll out shares of a step on the box (N, K nu), and keep the best; `least` is the quadratic there (N,)."""
        h, s = self.horizon, len(self.shares)
        tried = self.tries(u, step)
        paths = h.rollout(_repeat(z0, s), tried, _repeat(d, s))
        return self.choose(paths, tried, ref, last, least)

    def tries(self, u: Tensor, step: Tensor) -> Tensor:
        """Inputs (N S, K, nu) after S shares of a step (N, K nu) from inputs (N, K, nu), the last of them those."""
        h, (n, k, nu) = self.horizon, u.shape
        tried = u.flatten(1)[:, None] + self.shares[:, None] * step[:, None]
        return tried.view(n * len(self.shares), k, nu).clamp(h.low, h.high)

    def choose(self, paths: Tensor, tried: Tensor, ref: Tensor, last: Tensor, least: Tensor) -> Iterate:
        """The best candidate, of states (N S, P, K + 1, nz) that inputs (N S, K, nu) lead to.

        The last of each S inputs are those before the step; `least` is the quadratic at the whole step (N,).
        """
        h, s = self.horizon, len(self.shares)
        n = len(tried) // s
        costs = h.cost(paths, tried, _repeat(ref, s), _repeat(last, s)).view(n, s)
        best = torch.nan_to_num(costs, nan=torch.inf).argmin(1)
        cost, before = _pick(costs[..., None], best)[:, 0], costs[:, -1]
        # near the optimum the quadratic keeps its promise, up to the second order
        gap = (-least - (before - cost)).abs() / cost.abs().clamp_min(1e-9)
        return Iterate(
            u=_pick(tried.view(n, s, -1), best).view(n, *tried.shape[1:]),
            z=_pick(paths.view(n, s, -1), best).view(n, *paths.shape[1:]),
            cost=cost,
            before=before.clone(),
            gap=gap,
            worst=gap.max(),
        )

    def quadratic(
        self, z0: Tensor, u: Tensor, z: Tensor, ref: Tensor, last: Tensor, d: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Hessian H (N, K nu, K nu) and half the gradient g (N, K nu) of q, and its value at 0 (N,)."""
        h = self.horizon
        n, k, nu, nz, p = len(u), h.steps, h.nu, h.nz, h.particles
        after, r, a, b, c, e = self.linearise(u, z, ref, d)
        gap = after - z[:, :, 1:].reshape(n * p, k, nz)
        # what is off, then sensitivities to all inputs: those to later ones are zeros, cheaper than more operations
        own = (b[..., None, :] * self.steps[:, None, :, None]).flatten(3)
        add = torch.cat((gap[..., None], own), 3)
        table = nn.functional.pad((_repeat(z0, p) - z[:, :, 0].reshape(n * p, nz))[..., None], (0, k * nu))
        tables = [table]
        for a_i, add_i in zip(a.unbind(1)[:-1], add.unbind(1)[:-1], strict=True):
            table = torch.baddbmm(add_i, a_i, table)
            tables.append(table)
        direct = (e[..., None, :] * self.steps[:, None, :, None]).flatten(3)
        w = c @ torch.stack(tables, 1) + torch.cat((r[..., None], direct), 3)
        w = w.reshape(n, -1, k * nu + 1)
        gram = w[..., 1:].transpose(1, 2) @ w / p
        cost = (w[..., 0] * w[..., 0]).sum(1) / p + h.input_cost(u, last)
        # the weights are tensors: machine code is made once for all their values
        weights = h.input_weight.repeat(k) * self.eye + h.rate_weight * (self.change.T @ self.change)
        hessian = gram[..., 1:] + weights
        return hessian, gram[..., 0] + self.input_gradient(u, last), cost

    def input_gradient(self, u: Tensor, last: Tensor) -> Tensor:
        """Half the gradient of the input terms (N, K nu)."""
        h = self.horizon
        change = torch.diff(u, dim=1, prepend=last[:, None])
        later = torch.cat((change[:, 1:], torch.zeros_like(change[:, :1])), 1)
        out = h.input_weight * (u - h.input_centre) + h.rate_weight * (change - later)
        return out.flatten(1)

    def linearise(self, u: Tensor, z: Tensor, ref: Tensor, d: Tensor) -> tuple[Tensor, ...]:
        """F (N P, K, nz), r (N P, K, nr), A (N P, K, nz, nz), B (.., nz, nu), C (.., nr, nz), D (.., nr, nu)."""
        h = self.horizon
        n, k, nu, nz, p = len(u), h.steps, h.nu, h.nz, h.particles
        rows = n * p * k
        at = z[:, :, :-1].reshape(rows, nz)
        inputs = _repeat(u, p).reshape(rows, nu)
        wanted = _repeat(ref, p).reshape(rows, h.nx)
        push = d[:, None, None].expand(n, p, k, h.nd).reshape(rows, h.nd)
        noise = h.noise.transpose(0, 1).repeat(n, 1, 1).reshape(rows, h.nx) if p > 1 else None

        def both(z_: Tensor, u_: Tensor) -> tuple[Tensor, Tensor]:
            moved = h.advance(z_, u_, push, noise)
            return moved, h.residual(moved[:, : h.nx], wanted)

        def along_state(t: Tensor) -> tuple[Tensor, Tensor]:
            return torch.func.jvp(lambda z_: both(z_, inputs), (at,), (t.expand(rows, nz),))[1]

        def along_input(t: Tensor) -> tuple[Tensor, Tensor]:
            return torch.func.jvp(lambda u_: both(at, u_), (inputs,), (t.expand(rows, nu),))[1]

        after, r = both(at, inputs)
        a, c = torch.func.vmap(along_state, out_dims=2)(torch.eye(nz, dtype=z.dtype, device=z.device))
        b, e = torch.func.vmap(along_input, out_dims=2)(torch.eye(nu, dtype=z.dtype, device=z.device))
        shape = (n * p, k)
        return tuple(m.reshape(*shape, *m.shape[1:]) for m in (after, r, a, b, c, e))


def saved(before: Tensor, after: Tensor) -> Tensor:
    """Share of the costs (N,) that an iteration saved."""
    return (before - after) / after.abs().clamp_min(1e-9)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None])[..., 0]


def _pick(table: Tensor, row: Tensor) -> Tensor:
    """Row `row[i]` of table[i] (N, S, M): (N, M)."""
    return table.gather(1, row[:, None, None].expand(-1, 1, table.shape[2]))[:, 0]


# Accelerated projected gradient, the supplement's solver: one iteration, for many problems at once.
#
#     y = u + beta (u - u_before)                               Nesterov's extrapolation
#     u' = best of P(y - a s grad J(y)),  a = 4, 2, 1, 1/2, ... and u itself            P: projection on the box
#
# (Nesterov 1983; Beck and Teboulle, SIAM J. Imaging Sci. 2, 2009, with the monotone choice and the restart of
# O'Donoghue and Candes, Found. Comput. Math. 15, 2015.) The line search is parallel: all candidate steps are
# rolled out as one batch, the best becomes the plan, and its step size is where the next search starts. The
# gradient comes from the forward derivatives of all steps in one batch: a backward pass through the rollout
# takes minutes more to compile.

FACTORS = (4.0, 2.0, 1.0, 0.5, 0.25, 0.06)  # steps that are tried, as multiples of the step before
FIRST_STEP = 1e-3  # the first step of a solve


@final
class AcceleratedGradient(nn.Module):
    """An iteration; its slopes are those that `newton` linearises with.

    The memory between iterations is the plan before (N, K, nu), the momentum's counter (N,) and the step (N,).
    """

    def __init__(self, horizon: Horizon) -> None:
        super().__init__()
        self.horizon = horizon
        self.newton = GaussNewton(horizon)
        self.factors: Tensor
        self.register_buffer("factors", torch.tensor(FACTORS, dtype=horizon.predictor.dtype))

    def iterate(self, arguments: Sequence[Tensor], memory: Memory) -> tuple[Iterate, Memory]:
        """Roll out steps of several sizes, and keep the best plan; see `GaussNewton.iterate`."""
        h = self.horizon
        z0, u, _, ref, last, d = arguments
        one = u.new_ones(len(u))
        before, counter, size = memory or (u, one, FIRST_STEP * one)
        n, s = len(u), len(FACTORS) + 1
        later = 0.5 * (1.0 + torch.sqrt(1.0 + 4.0 * counter * counter))
        y = (u + ((counter - 1.0) / later)[:, None, None] * (u - before)).clamp(h.low, h.high)
        gradient = self.gradient(z0, y, ref, last, d)
        steps = size[:, None] * self.factors
        tried = (y[:, None] - steps[..., None, None] * gradient[:, None]).clamp(h.low, h.high)
        candidates = torch.cat((tried, u[:, None]), 1).flatten(0, 1)
        paths = h.rollout(_repeat(z0, s), candidates, _repeat(d, s))
        costs = h.cost(paths, candidates, _repeat(ref, s), _repeat(last, s)).view(n, s)
        costs = torch.nan_to_num(costs, nan=torch.inf)
        best = costs.argmin(1)
        new = _pick(candidates.view(n, s, -1), best).view_as(u)
        path = _pick(paths.view(n, s, -1), best).view(n, *paths.shape[1:])
        cost = _pick(costs[..., None], best)[:, 0]
        stuck = best == s - 1  # nothing was better: without momentum, and with shorter steps, from here
        chosen = torch.cat((self.factors, self.factors[-1:]))[best] * size
        chosen = chosen.clamp(1e-7, 1.0)
        # the input terms alone curve J by 2 R, which bounds what is left by the projected gradient; a loose bound
        moved = (y - (y - gradient * chosen[:, None, None]).clamp(h.low, h.high)) / chosen[:, None, None]
        left = (moved * moved / (4.0 * h.input_weight).clamp_min(1e-6)).flatten(1).sum(1)
        gap = left / cost.abs().clamp_min(1e-9)
        counter = torch.where(stuck, torch.ones_like(later), later)
        kept = torch.where(stuck[:, None, None], new, u)
        return Iterate(new, path, cost, costs[:, -1], gap, gap.max()), (kept, counter, chosen)

    def gradient(self, z0: Tensor, u: Tensor, ref: Tensor, last: Tensor, d: Tensor) -> Tensor:
        """Gradient of the costs (N, K, nu): slopes of all steps in one batch, put together backwards in time."""
        h = self.horizon
        n, p = len(u), h.particles
        _, r, a, b, c, e = self.newton.linearise(u, h.rollout(z0, u, d), ref, d)
        back, parts = r.new_zeros(n * p, 1, h.nz), []
        for k in reversed(range(h.steps)):
            row = r[:, k, None]
            parts.append(row @ e[:, k] + back @ b[:, k])
            back = row @ c[:, k] + back @ a[:, k]
        along = torch.cat(parts[::-1], 1).view(n, p, h.steps, h.nu).mean(1)
        return 2.0 * (along + self.newton.input_gradient(u, last).view(n, h.steps, h.nu))
