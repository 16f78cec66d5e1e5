"""What the inputs of a log say of the state: a controller, or a pilot, made them while it watched the machine.

Predicting a run under its own inputs is another question than what an input does. Logged inputs answered the gusts that
the prediction cannot see, so that they tell what these were: where roll torque was commanded, a gust had rolled the
machine. The answer is learned from the training runs as a controller with a memory of `n` steps,

    u_k = sum_{i=0..n} C_i y_{k-i} + sum_{i=1..n} B_i u_{k-i} + c + e_k,    e_k ~ N(0, R)

of the features y that networks see. u_k is known before x_{k+1} is, and e_k is white, so that least squares are
consistent in a closed loop (direct identification; Ljung, System Identification, 1999, section 13.5). Setpoints that
nobody logged are in the memory.

A prediction is then a filter whose only sensors are the inputs. Each path is moved by what its own input would have
been,

    z <- z + K_k (u_k - u_k(path) - e_k),

with the gain K_k of the extended Kalman filter about the mean path, so that paths have the distribution of the state
given all inputs so far. Nothing of this is in `drift` or `diffusion`: who plans, or intervenes, sets the inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from nsde_torch.data import Run
from nsde_torch.models.model import normal

if TYPE_CHECKING:
    from nsde_torch.models.neural_sde import NeuralSDE

LAGS = 3
"""Steps of the past. Of 1, 2, 3 and 5 none is best on both: built-in flights 0.154, 0.153, 0.160, 0.162 m after 1 s,
published ones 0.50, 0.47, 0.47, 0.52 m."""
_FARTHEST = 3.0
"""Length of a path's innovation, in its standard deviations, beyond which it counts as that long. The gain is right
near the mean path alone: without it paths of the published flights diverge within 2 s."""
_RANK = 1e-6  # of the largest variance of e_k: inputs that a mixer ties to others carry nothing of their own


class FeedbackModel(nn.Module):
    """The controller of the training runs, by so many features, inputs, and steps of the past n."""

    weights: Tensor  # C_0 ... C_n, B_1 ... B_n and c, one below the other ((n + 1) width + n nu + 1, nu)
    covariance: Tensor  # R (nu, nu)

    def __init__(self, width: int, nu: int, lags: int) -> None:
        super().__init__()
        self.width, self.nu, self.lags = width, nu, lags
        self.register_buffer("weights", torch.zeros((lags + 1) * width + lags * nu + 1, nu))
        self.register_buffer("covariance", torch.eye(nu))


class Filter:
    """A filter of paths of a model, under applied inputs (B, T, nu) and sensors with an error at the start (nx,).

    `moved` is called at each step k. It carries the covariance (B, m, m) of the state and of the features of the last n
    steps, m = nz + n width.
    """

    def __init__(
        self, law: FeedbackModel, model: NeuralSDE, u: Tensor, dt: float, std: Tensor, rng: torch.Generator
    ) -> None:
        self.model, self.u, self.dt, self.std, self.rng = model, u, dt, std, rng
        self.system = model.system  # that of all runs, whatever each path draws for its own
        variance, along = torch.linalg.eigh(law.covariance.double())
        along = along[:, variance > _RANK * variance[-1]]
        weights = law.weights.double() @ along
        y, nu, n = law.width, law.nu, law.lags
        parts = weights.split([y] * (n + 1) + [nu] * n + [1])
        self.of_features, self.of_inputs, self.constant = parts[: n + 1], parts[n + 1 : -1], parts[-1]
        self.inputs = (u[..., :nu].double() @ along).to(u)  # along what the controller moves
        self.noise = along.T @ law.covariance.double() @ along
        self.deviation = torch.linalg.cholesky(self.noise).to(u)
        self.past: list[Tensor] = []  # features of all paths, the newest first
        self.p = u.new_zeros(0, dtype=torch.float64)

    def moved(self, k: int, z: Tensor) -> Tensor:
        """Paths (P B, nz) after the look at u_k, from what they are before it acts."""
        model, batch, n = self.model, len(self.u), len(self.of_inputs)
        if k == 0:
            self._begin(z)
        mean = self._mean(z)
        basis = torch.eye(model.nz, dtype=z.dtype, device=z.device)
        if k >= n:  # the controller's memory is of what was before the start until then
            z = self._informed(k, z, self._slopes(self._features, mean, basis))
            mean = self._mean(z)
        u = self.u[:, k]
        with model.of_system(self.system):
            rates = self._slopes(lambda x: model.drift(0.0, x, u.repeat(len(basis), 1)), mean, basis)
            sigma = model.diffusion(0.0, mean, u).double()
        own = rates.double() * self.dt
        step = basis.double() + own + 0.5 * own @ own
        slopes = self._slopes(self._features, mean, basis).double()
        nz, m, kept = model.nz, self.p.shape[1], self.p.shape[1] - slopes.shape[1]
        onward = torch.cat(
            (step, slopes), 1
        )  # the state moves on, its features become the newest of the past
        p = self.p.new_zeros(batch, m, m)
        width = onward.shape[1]
        p[:, :width, :width] = onward @ self.p[:, :nz, :nz] @ onward.mT
        if n > 1:
            p[:, :width, width:] = onward @ self.p[:, :nz, nz:kept]
            p[:, width:, :width] = p[:, :width, width:].mT
            p[:, width:, width:] = self.p[:, nz:kept, nz:kept]
        p[:, range(nz), range(nz)] += sigma.square() * self.dt
        self.p, self.past = p, [self._features(z), *self.past[:-1]]
        return z

    def _begin(self, z: Tensor) -> None:
        model, nx = self.model, self.system.nx
        features = self._features(z)
        self.past = [features] * len(self.of_inputs)
        variance = z.new_zeros(len(self.u), model.nz)
        variance[:, :nx] = self.std.square()
        if model.nd:
            variance[:, -model.nd :] = model.disturbance_std(self._mean(z)[:, :nx]).square()
        m = model.nz + len(self.past) * features.shape[1]
        self.p = z.new_zeros(len(self.u), m, m, dtype=torch.float64)
        self.p[:, range(model.nz), range(model.nz)] = variance.double()

    def _informed(self, k: int, z: Tensor, slopes: Tensor) -> Tensor:
        """Paths and covariance given u_k."""
        batch, past = len(self.u), [self._features(z), *self.past]
        of_state, *of_past = self.of_features
        c = torch.cat((of_state.T @ slopes.double(), *(w.T.expand(batch, -1, -1) for w in of_past)), 2)
        pc = self.p @ c.mT
        spread = c @ pc + self.noise
        root, failed = torch.linalg.cholesky_ex(spread)
        # a start whose mean path has left all bounds goes on without the inputs, and does not end the others
        root[failed > 0] = torch.eye(root.shape[-1]).to(root)
        gain = torch.cholesky_solve(pc.mT, root).mT
        gain[(failed > 0) | ~torch.isfinite(gain).all(2).all(1)] = 0.0
        self.p = self.p - gain @ pc.mT
        self.p = 0.5 * (self.p + self.p.mT)
        known = self.inputs[:, k] - self.constant.to(z)
        for i, w in enumerate(self.of_inputs, 1):
            known = known - self.u[:, k - i, : len(w)] @ w.to(z)
        told = sum((y @ w.to(z) for y, w in zip(past, self.of_features, strict=True)), torch.zeros(()))
        drawn = normal((len(z), len(self.deviation)), self.rng, z) @ self.deviation.T
        away = (known.repeat(len(z) // batch, 1) - told - drawn).view(-1, batch, known.shape[1])
        in_deviations = torch.linalg.solve_triangular(root.to(z), away.permute(1, 2, 0), upper=False)
        away = away * (_FARTHEST / in_deviations.norm(dim=1).T[..., None]).clamp(max=1.0)
        moves = torch.einsum("bij,pbj->pbi", gain.to(z), away).reshape(len(z), -1)
        ahead, *back = moves.split([self.model.nz] + [past[0].shape[1]] * len(self.past), 1)
        self.past = [y + move for y, move in zip(self.past, back, strict=True)]
        return self.system.project(z + ahead)

    def _features(self, z: Tensor) -> Tensor:
        return self.system.residual_features(z[:, : self.system.nx])

    def _mean(self, z: Tensor) -> Tensor:
        return self.system.project(z.reshape(-1, len(self.u), z.shape[1]).mean(0))

    @staticmethod
    def _slopes(function: Callable[[Tensor], Tensor], at: Tensor, basis: Tensor) -> Tensor:
        """Derivatives (B, n, nz) of rows of a function (N, nz) -> (N, n) at some states (B, nz)."""
        nz, batch = len(basis), len(at)
        tangents = basis[:, None].expand(nz, batch, nz).reshape(-1, nz)
        out: Tensor = torch.func.jvp(function, (at.repeat(nz, 1),), (tangents,))[1]
        return out.view(nz, batch, -1).permute(1, 2, 0)


@torch.no_grad()
def fit_feedback(model: NeuralSDE, runs: Sequence[Run], lags: int = LAGS) -> FeedbackModel | None:
    """The controller of some runs, by least squares; None where they are too short for it, or no input ever changes.

    Runs are as logged, at the step of the model or a part of it; its features and applied inputs count.
    """
    system, dt = model.system, model.spec.dt
    rows, answers = [], []
    for run in runs:
        each = max(1, round(dt / run.dt))
        for a, b in run.segments:
            for first in range(a, min(a + each, b)):  # every row begins a step
                count = (b - first) // each
                if count <= lags:
                    continue
                x = torch.tensor(run.x[first : first + count * each : each]).to(model.clock_scale)
                held = run.u[first : first + count * each].reshape(count, each, -1).mean(1)
                u = model.applied_inputs(torch.tensor(held).to(x)[None], dt)[0, :, : system.nu].double()
                y = system.residual_features(system.project(x)).double()
                past = [y[lags - i : count - i] for i in range(lags + 1)]
                past += [u[lags - i : count - i] for i in range(1, lags + 1)]
                rows.append(torch.cat((*past, torch.ones(count - lags, 1).to(u)), 1))
                answers.append(u[lags:])
    if not rows:
        return None
    seen, given = torch.cat(rows).cpu(), torch.cat(answers).cpu()  # no GPU solves it where inputs are tied
    freedom = len(seen) - seen.shape[1]
    if freedom < seen.shape[1] or not bool((given.std(0) > 0).any()):
        return None
    scale = seen.abs().amax(0).clamp_min(1e-12)
    # inputs that a mixer ties to one another leave directions that nothing tells: the least weights are as good there
    weights = torch.linalg.lstsq(seen / scale, given, rcond=1e-8, driver="gelsd").solution / scale[:, None]
    left = given - seen @ weights
    width = (seen.shape[1] - 1 - lags * system.nu) // (lags + 1)
    made = FeedbackModel(width, system.nu, lags).to(model.clock_scale)
    made.weights.copy_(weights)
    made.covariance.copy_(left.T @ left / freedom)
    return made
