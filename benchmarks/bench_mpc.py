"""Plans of both solvers against CasADi + IPOPT on the same discretised problem: optimality, cost against time, flight.

    python benchmarks/bench_mpc.py RUN [--states 200] [--seconds 40] [--only peers]

RUN is the run directory of a hexacopter (model=nsde without effects, solver=default). CasADi (pip install casadi) gets
the model's equations and weights written down a second time, in double precision, and IPOPT solves multiple shooting
from the same cold start (hovering); `peers` has CasADi's other solvers beside it, cost reached against time, on at
most 40 states. States are drawn along both references, off them by the errors that a flight has.
"""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import options

import nsde_torch
from nsde_torch.control.autopilots import EstimatorOptions, PredictivePilot
from nsde_torch.control.controller import Controller
from nsde_torch.control.feasible import hover_input
from nsde_torch.control.loop import fly, summarise
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import Horizon, ProblemOptions
from nsde_torch.control.reference import Reference
from nsde_torch.control.shapes import circle, lemniscate
from nsde_torch.control.solve import Problem, Solver, SolverOptions
from nsde_torch.rotation import turned
from nsde_torch.simulation import make_plant

ITERATIONS = {"gauss_newton": 12, "apg": 1500}


def problems(horizon: Horizon, count: int) -> Problem:
    """States along both references, off them, with the references that follow."""
    g = torch.Generator().manual_seed(0)
    x, ref = [], []
    for path in (Reference(circle()), Reference(lemniscate())):
        t = 1.0 + (path.duration - 3.0) * torch.rand(count // 2, generator=g, dtype=torch.float64)
        ref += [path.window(float(s), dt=horizon.options.dt, steps=horizon.steps) for s in t]
        x.append(path.at(t))
    at = torch.cat(x)
    off = torch.randn(len(at), 12, generator=g, dtype=torch.float64)
    off *= torch.tensor([*(0.06,) * 3, *(0.15,) * 3, *(0.05,) * 3, *(0.3,) * 3])
    at = torch.cat((at[:, :6] + off[:, :6], turned(at[:, 6:10], off[:, 6:9]), at[:, 10:] + off[:, 9:]), 1)
    dtype = horizon.predictor.dtype
    last = hover_input(horizon.predictor).expand(len(at), -1).contiguous()
    nothing = at.new_zeros(len(at), horizon.nd).to(dtype)
    return Problem(at.to(dtype), torch.stack(ref).to(dtype), last, nothing)


PEERS: dict[str, tuple[str, dict[str, Any]]] = {
    "ipopt": ("ipopt", {"ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-8, "max_iter": 500}}),
    "fatrop": ("fatrop", {"structure_detection": "auto", "fatrop": {"print_level": 0, "max_iter": 500}}),
    "sqp, osqp": ("sqpmethod", {"qpsol": "osqp", "qpsol_options": {"osqp": {"verbose": False}}}),
    "sqp, hpipm": ("sqpmethod", {"qpsol": "hpipm"}),
}
"""CasADi's solvers from its wheel. Their functions are interpreted, not compiled."""
REPEATS = 3  # of each solve, of which the shortest counts
HESSIAN = ["x", "p", "lam_f", "lam_g"]
SQP = {"print_header": False, "print_iteration": False, "print_status": False}


class Peer:
    """The problem in CasADi, by one of `PEERS`: multiple shooting, stage after stage, as fatrop and HPIPM have it.

    Of SQP at most some `iterations`, or until it converges.
    """

    def __init__(self, horizon: Horizon, name: str = "ipopt", iterations: int | None = None) -> None:
        import casadi as ca

        self.steps, p = horizon.steps, horizon.predictor
        z, u, ref = ca.SX.sym("z", 13), ca.SX.sym("u", 6), ca.SX.sym("ref", 13)
        step = ca.Function("step", [z, u], [self._step(ca, p, z, u)])
        e = self._error(ca, z, ref)
        weights = np.sqrt(np.array(horizon.options.state_weights))
        rest = ca.vertcat(weights * e, np.sqrt(horizon.options.input_weight) * u)
        stage = ca.Function("stage", [z, u, ref], [rest])
        given = ca.SX.sym("p", 13 + 13 * self.steps)
        state, rests = ca.SX.sym("z0", 13), []
        variables, equal = [state], [state - given[:13]]
        for k in range(self.steps):
            u, after = ca.SX.sym(f"u{k}", 6), ca.SX.sym(f"z{k + 1}", 13)
            equal.insert(-1 if k == 0 else len(equal), after - step(state, u))
            rests.append(stage(after, u, given[13 * (k + 1) : 13 * (k + 2)]))
            variables += [u, after]
            state = after
        x, g, rest = ca.vertcat(*variables), ca.vertcat(*equal), ca.vertcat(*rests)
        nlp = {"x": x, "p": given, "f": ca.sumsqr(rest), "g": g}
        method, own = PEERS[name]
        options: dict[str, Any] = {"print_time": False, "error_on_fail": False, **own}
        if method == "sqpmethod":
            # of Gauss and Newton, as ours: the exact Hessian is indefinite here, and made definite it takes 50 steps
            slope, f, lam = ca.jacobian(rest, x), ca.SX.sym("f"), ca.SX.sym("lam", g.shape[0])
            curved = [2 * f * slope.T @ slope]
            hessian = ca.Function("curvature", [x, given, f, lam], curved, HESSIAN, ["hess_gamma_x_x"])
            options |= SQP | {"max_iter": iterations or 50, "hess_lag": hessian}
            options["qpsol_options"] = {**own.get("qpsol_options", {}), "error_on_fail": False}
        if method == "fatrop":
            options["equality"] = [True] * int(nlp["g"].shape[0])
        self.solver = ca.nlpsol("peer", method, nlp, options)
        self.step = step

    @staticmethod
    def _error(ca: Any, z: Any, ref: Any) -> Any:
        w, x, y, q = (z[i] for i in range(6, 10))
        a, b, c, d = (ref[i] for i in range(6, 10))
        part = ca.vertcat(
            -w * b + x * a - y * d + q * c, -w * c + x * d + y * a - q * b, -w * d - x * c + y * b + q * a
        )
        sign = ca.if_else(w * a + x * b + y * c + q * d < 0, -1, 1)
        return ca.vertcat(z[:6] - ref[:6], sign * part, z[10:] - ref[10:])

    @staticmethod
    def _step(ca: Any, p: Predictor, z: Any, u: Any) -> Any:
        values = {k: float(v) for k, (v, _) in p.system.declared_parameters().items()}
        mix = np.array(type(p.system).mixing)  # type: ignore[attr-defined]
        if p.system.nz != 13 or not p._turns:
            raise SystemExit("the peer knows models of multirotors without memory")
        v, (w, x, y, q), omega = z[3:6], (z[i] for i in range(6, 10)), z[10:13]
        r = ca.vertcat(x, y, q)

        def rotate(vector: Any, sign: float, w: Any = w, r: Any = r) -> Any:
            s = 2 * ca.cross(r, vector)
            return vector + sign * w * s + ca.cross(r, s)

        collective, moments = ca.sum1(u), ca.DM(mix[1:]) @ u
        force = ca.vertcat(0, 0, values["thrust_gain"] * collective + values["thrust_offset"])
        jx, jy = values["inertia_x"], values["inertia_y"]
        gains = ca.vertcat(values["roll_gain"], values["pitch_gain"], values["yaw_gain"])
        coupling = ca.vertcat((jy - 1) / jx, (1 - jx) / jy, jx - jy)
        product = ca.vertcat(omega[1] * omega[2], omega[2] * omega[0], omega[0] * omega[1])
        angular = gains * moments + coupling * product
        if p._learned is not None:
            up = ca.vertcat(2 * (x * q - w * y), 2 * (y * q + w * x))
            y_in = ca.vertcat(rotate(v, -1.0), omega, up, *(z[k] for k in p.system.places))
            standard = p._learned.residual_inputs
            y_in = (y_in - standard.mean.double().numpy()) / standard.scale.double().numpy()
            for port, network in p._learned.residuals.items():
                h = y_in
                for k, layer in enumerate(network.layers):
                    h = ca.DM(layer.weight.double().numpy()) @ h + layer.bias.double().numpy()
                    h = ca.tanh(h) if k < len(network.layers) - 1 else h
                h = h * p._learned._residual_scale[port]
                force = force + h if port == "body_force" else force
                angular = angular + h if port == "body_moment" else angular
        middle = omega + p.dt / 2 * angular
        turned = z[6:10] + p.dt / 2 * ca.vertcat(-r.T @ middle, w * middle + ca.cross(r, middle))
        turned = turned / ca.norm_2(turned)
        gravity = np.array([0, 0, -9.81])
        first = rotate(force, 1.0) + gravity
        later = rotate(force, 1.0, turned[0], turned[1:]) + gravity
        position = z[:3] + p.dt * v + p.dt**2 / 6 * (2 * first + later)
        return ca.vertcat(position, v + p.dt / 2 * (first + later), turned, omega + p.dt * angular)

    def solve(self, problem: Problem, row: int, start: np.ndarray) -> tuple[float, float, bool, np.ndarray]:
        """Cost, seconds, success and inputs (K, 6) of one problem."""
        given = np.concatenate((problem.z0[row].double().numpy(), problem.ref[row].double().numpy().ravel()))
        bounds = [np.full(13, np.inf), *(np.concatenate((np.ones(6), np.full(13, np.inf))),) * self.steps]
        high = np.concatenate(bounds)
        low = np.where(np.isinf(high), -np.inf, 0.0)
        z, guess = given[:13], [given[:13]]
        for k in range(self.steps):
            z = np.asarray(self.step(z, start[k])).ravel()
            guess += [start[k], z]
        began = time.perf_counter()
        found = self.solver(x0=np.concatenate(guess), p=given, lbx=low, ubx=high, lbg=0, ubg=0)
        seconds = time.perf_counter() - began
        u = np.asarray(found["x"]).ravel()[13:].reshape(self.steps, 19)[:, :6]
        return float(found["f"]), seconds, bool(self.solver.stats()["success"]), u


def cold_starts(model: Any, count: int) -> tuple[Horizon, Problem, torch.Tensor, torch.Tensor]:
    """The horizon, some problems, and the inputs and paths from which solvers start: hovering."""
    horizon = Horizon(Predictor(model, dt=0.05, dtype=torch.float64), ProblemOptions())
    given = problems(horizon, count)
    start = given.last[:, None].repeat(1, horizon.steps, 1)
    return horizon, given, start, horizon.rollout(given.z0, start, given.d)


def peers(model: Any, count: int) -> dict[str, Any]:
    """Cost above the optimum against time: ours by iteration, and CasADi's solvers, from the same cold starts."""
    horizon, given, start, paths = cold_starts(model, count)

    def costs(plans: Sequence[np.ndarray]) -> Any:
        u = torch.tensor(np.stack(plans)).clamp(0.0, 1.0)
        return horizon.cost(horizon.rollout(given.z0, u, given.d), u, given.ref, given.last).numpy()

    tried: dict[str, tuple[Any, list[float], int]] = {}
    for name in PEERS:
        for iterations in (1, 2, 3, 5, 10, None) if name.startswith("sqp") else (None,):
            peer = Peer(horizon, name, iterations)
            rows = [[peer.solve(given, k, start[k].numpy()) for _ in range(REPEATS)] for k in range(count)]
            failed = sum(not r[0][2] for r in rows) if iterations is None else 0
            label = name if iterations is None else f"{name}, {iterations} iterations"
            tried[label] = costs([r[0][3] for r in rows]), [min(t[1] for t in r) for r in rows], failed
    for iterations in (1, 2, 3, 5, 10):
        options = SolverOptions(iterations=iterations, tolerance=0.0, compile="on")
        solver, plans, seconds = Solver(horizon, options), [], []
        for k in range(count):
            row = Problem(*(x[k : k + 1].contiguous() for x in given))
            cold = start[k : k + 1].contiguous(), paths[k : k + 1].contiguous()
            found = [solver.solve(row, *cold) for _ in range(REPEATS)]
            plans.append(found[0].u[0].numpy())
            seconds.append(min(f.seconds for f in found))
        tried[f"ours, {iterations} iterations"] = costs(plans), seconds, 0
    best = np.min([np.where(np.isfinite(c), c, np.inf) for c, _, _ in tried.values()], axis=0)
    out = {}
    for label, (cost, seconds, failed) in tried.items():
        ms, over = 1e3 * np.array(seconds), cost / best - 1.0
        found = {"ms_p50": np.median(ms), "ms_max": ms.max(), "over_best_median": np.median(over)}
        out[label] = {**found, "over_best_max": over.max(), "not_converged": failed}
    return out


def optimality(model: Any, count: int) -> dict[str, Any]:
    """Costs of both solvers over IPOPT's, by iteration."""
    horizon, given, start, paths = cold_starts(model, count)
    peer = Peer(horizon)
    rows = [peer.solve(given, k, start[k].numpy()) for k in range(len(start))]
    u = torch.tensor(np.stack([r[3] for r in rows])).clamp(0.0, 1.0)
    # judged by one function: IPOPT's inputs rolled out through our model
    best = horizon.cost(horizon.rollout(given.z0, u, given.d), u, given.ref, given.last)
    same = np.abs(np.array([r[0] for r in rows]) / best.numpy() - 1.0)
    failed, seconds = sum(not r[2] for r in rows), float(np.median([r[1] for r in rows]))
    ipopt = {"failed": failed, "cost_disagreement_max": float(same.max()), "seconds_p50": seconds}
    out: dict[str, Any] = {"states": count, "ipopt": ipopt}
    for name, iterations in ITERATIONS.items():
        options = SolverOptions(name=name, iterations=iterations, tolerance=0.0, compile="off")
        found = Solver(horizon, options, batch=count).solve(given, start, paths)
        costs = torch.stack(found.costs)
        over = (costs / best - 1.0).numpy()
        shown = sorted({*range(0, 13), 25, 50, 100, 200, 400, 800, iterations} & set(range(len(over))))
        out[name] = {
            "over_ipopt_median_and_max": {
                k: [float(np.median(over[k])), float(over[k].max())] for k in shown
            },
        }
    return out


def closed_loop(model: Any, seconds: float, solver: SolverOptions) -> dict[str, Any]:
    """The lemniscate at 3.4 m/s with one thread, plan after plan, warm-started."""
    reference = Reference(lemniscate())
    plant = make_plant("hexacopter", generator=torch.Generator().manual_seed(0), latency=0.02, check=False)
    controller = Controller(model, solver=solver, say=print)
    estimator = EstimatorOptions(latency=0.04, force_time=0.0)
    how: dict[str, Any] = {"period": 0.02, "sample": plant.dt, "estimator": estimator}
    pilot = PredictivePilot(controller, model, reference, **how)
    solve, over = controller.solver.solve, []
    to_the_end = SolverOptions(iterations=15, tolerance=0.0, compile="off")
    exact = Solver(controller.horizon, to_the_end, clock=time.perf_counter)
    count = 0

    def watched(problem: Problem, u: torch.Tensor, z: torch.Tensor) -> Any:
        nonlocal count
        found, count = solve(problem, u, z), count + 1
        if count % 20 == 0:
            best = exact.solve(problem, found.u, found.z)
            over.append(float(found.cost / best.cost) - 1.0)
        return found

    controller.solver.solve = watched  # type: ignore[method-assign]
    flight = fly(pilot, plant, reference, duration=seconds)
    found = summarise([flight], controller.predictor.system)
    keys = ("rmse_m", "altitude_error_max_m", "solve_ms", "command_ms", "iterations_mean", "status")
    middle, high, most = np.percentile(over, (50, 99, 100)).tolist()
    above = {"over_optimum_p50": middle, "over_optimum_p99": high, "over_optimum_max": most}
    return {**{k: found[k] for k in keys}, **above}


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--states", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--only", choices=("optimality", "peers", "loop"), default=None)
    given = parser.parse_args()
    model = nsde_torch.load(given.run)
    with torch.no_grad():
        if given.only in (None, "optimality"):
            print(json.dumps(optimality(model, given.states), indent=1), flush=True)
        if given.only in (None, "peers"):
            for label, row in peers(model, min(given.states, 40)).items():
                print(f"{label:24s}", "  ".join(f"{k} {v:.3g}" for k, v in row.items()), flush=True)
    for name, iterations in (("gauss_newton", 5), ("apg", 20)) if given.only in (None, "loop") else ():
        solver = SolverOptions(name=name, compile="on", iterations=iterations, tolerance=5e-3)
        print(name, json.dumps(closed_loop(model, given.seconds, solver), indent=1), flush=True)


if __name__ == "__main__":
    main()
