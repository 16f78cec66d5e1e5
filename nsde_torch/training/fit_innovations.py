"""A neural SDE fitted by what is new at each step of the log: physics, then networks, then what disturbs.

1. Declared parameters, with their covariance, by the identification of `sysid`, and a lag of the inputs where the data
   show one that is not declared (`identified`).
2. Residual networks, fitted to the functions that the likelihood chooses beside that physics (`fit_functions`).
3. Where something surely differs between runs (`between_runs`), both again with numbers for each run.
4. The distance eta by its own losses.
5. Diffusion, lasting disturbances and sensors from the spectrum of the residual (`evaluation.spectra`), and into the
   diffusion the uncertainty of the drift: the covariance of the parameters and of the functions. Their mean over the
   data is as found; far from the data sigma is at least the declared one.

Every stage sees one step of the log at a time, given what came before it, so inputs that answer disturbances do not
bias it; `loss=replay` is better at predictions of the pilot's own flights (docs/content/theory/losses.md). Assumed: the
controller saw no more than the log holds.

The fits that calibration makes of some of the runs (`Task.near`) begin where that of all runs ended. A port without
declared physics is all network: its disturbance follows what acts there until the functions are known, and declared
parameters are then fitted again beside the network.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields, replace
from math import hypot, sqrt
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.data import Run, Windows
from nsde_torch.effects import Effect, Port
from nsde_torch.effects.law import split_name
from nsde_torch.errors import DataError, NonFiniteError, NsdeError
from nsde_torch.evaluation.metrics import thinned
from nsde_torch.evaluation.one_step import (
    Disturbance,
    Residuals,
    disturbed_channels,
    fit,
    residuals,
    spectrum,
    with_networks,
)
from nsde_torch.evaluation.report import number
from nsde_torch.inference import LogLikelihood, Optimum
from nsde_torch.inference.estimate import nearly_maximised
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.steps import steps_of
from nsde_torch.models.neural_sde import NeuralSDE, SDESpec
from nsde_torch.recall import recall
from nsde_torch.recording.smoothing import as_applied
from nsde_torch.rotation import rotation_between
from nsde_torch.sysid.feedback_test import feedback_summary
from nsde_torch.sysid.identify import (
    Settled,
    by_likelihood,
    identification,
    identify_in_loop,
    regression_of,
    settled,
)
from nsde_torch.sysid.physics import Physics
from nsde_torch.sysid.regression import ITERATIONS, Regression
from nsde_torch.sysid.result import Identification
from nsde_torch.systems.parameters import ParameterVector
from nsde_torch.training import between_runs
from nsde_torch.training.distil import Distilled, fit_functions, functions_of, silence
from nsde_torch.training.loop import Loop, read_checkpoint, write_checkpoint
from nsde_torch.training.losses import fit_distance
from nsde_torch.training.prepare import blind_to_places, fit_filter
from nsde_torch.training.task import Fitted, Parameters, Progress, Task

_DISTANCE_STEPS = 600
_LEAST = 1e-7  # a diffusion or a sensor that is nothing, in the units of the state
_ROWS = 20_000  # whose features the distance sees
_NOISE = ("diffusion", "force_std", "force_tau_s", "sensor_std")  # what is said of a `Disturbance`


def fit_innovations(task: Task) -> Fitted:
    """Fit a model with declared physics by innovations.

    A ConfigError refuses a system that declares no parameter, a DataError runs that are too short, a NonFiniteError
    physics that leaves the finite numbers.
    """
    near, values = task.near, task.values
    spec = task.spec if near is None else near.model.spec
    assert isinstance(spec, SDESpec)
    if near is not None:  # a law of the inputs that was learned is declared
        spec = replace(spec, learn_lag=False)
        values = {name: value.tolist() for name, (value, _) in near.model.system.all_declared().items()}
    # refuses steps that do not divide, and runs shorter than a window
    Windows(task.runs, spec.dt, spec.horizon)
    machine = spec.make_system()
    runs = as_applied(task.runs, machine.nu) if spec.filter_reach else list(task.runs)
    found = None
    if set(machine.residual_ports) <= machine.physics_ports:  # no port is all network
        found = recall(
            ("identified", task.before_seed), lambda: identified(spec, runs, clock=task.clock, values=values)
        )
    generator = torch.Generator().manual_seed(task.seed)
    model = NeuralSDE(found.spec if found else spec, generator=generator, values=values)
    about = _from_checkpoint(model, task)
    if about is None:
        about = _Fit(model, task, runs, found).run()
        state = {f"{part}.{k}": v for part in ("model", "kept") for k, v in model.state_dict().items()}
        write_checkpoint(task.checkpoint, state, {"identity": task.identity, **about})
    if model.filter is not None:
        fit_filter(model.filter, task.runs, runs, machine.nu)
    progress = Progress(**about["progress"])
    for row in progress.history:
        task.log(int(row["step"]), row)
    parameters: Parameters = about["parameters"]
    said, begin = about["said"], about.get("begin", {})
    model = model.to(device=task.device, dtype=task.dtype)
    return Fitted(model, progress, lambda: parameters, about["facts"], said=said, begin=begin)


def _from_checkpoint(model: NeuralSDE, task: Task) -> dict[str, Any] | None:
    """What a finished fit left, its weights put into the model; None if there is none."""
    found = read_checkpoint(task, model.state_dict(), parts=(), differ=Loop.differ)
    if found is None:
        return None
    tensors, about = found
    model.load_state_dict({k[6:]: v for k, v in tensors.items() if k.startswith("model.")})
    differ = about["facts"].get("between_runs", {})
    model.spec = replace(model.spec, between_runs={name: one["std"] for name, one in differ.items()})
    return about


class _Fit:
    """One fit, in double precision where physics is evaluated and single precision where networks are.

    Runs have inputs as they acted; `found` is None where declared physics is not all that acts on some port.
    """

    def __init__(self, model: NeuralSDE, task: Task, runs: Sequence[Run], found: Identified | None) -> None:
        self.model, self.task, self.runs, self.found = model, task, runs, found
        self.known: Identification | None = None
        self.near: Mapping[str, Any] = task.near.begin if task.near is not None else {}
        self.begin: dict[str, Any] = {}
        self.differs: list[between_runs.RunSpread] = []
        model.clock_scale.fill_(task.clock)
        if found is not None:
            self.physics = found.settled.regression.physics
            identify = self._identified if task.near is None else self._near
            self.known = recall(("known", task.before_seed), lambda: identify(found))
            self.theta = self.known.values
        else:
            vector = ParameterVector(model.system)
            self.physics = Physics(vector, steps_of(vector.system, runs, clock=task.clock))
            self.theta = vector.inside(vector.start)
        self.declared = self.physics
        self.relied = self.known is not None and self.known.likelihood_used
        self._use(self.theta)

    def run(self) -> dict[str, Any]:
        """Fit everything; returns what the checkpoint holds."""
        model, options = self.model, self.task.options
        left = residuals(self.physics, self.theta, model.residual_ports)
        model.residual_inputs.fit(model.system.network_features(left.states.float()))
        model.eta.standardise.fit(model.system.features(left.states.float()))
        at = recall(("optimum", self.task.before_seed), self._optimum) if left.ports else None
        learned = self._networks(at, left)
        numbers = self._by_run(at, learned)
        if numbers is not None:
            left = residuals(self.physics, self.theta, model.residual_ports)
            learned = self._networks(numbers, left)
            self.differs = between_runs.spreads(self.physics.vector.at(self.theta))
            model.spec = replace(model.spec, between_runs={d.target: d.std for d in self.differs})
        self.physics = with_networks(self.physics, model)
        if self.found is None:
            self._beside_networks()
        left = residuals(self.physics, self.theta, model.residual_ports)
        features = thinned(model.system.features(left.states.float()), _ROWS)
        steps = min(_DISTANCE_STEPS, options.steps)
        fit_distance(model, features, loss=self.task.loss, steps=steps, rate=options.lr, seed=self.task.seed)
        laws = _channel_laws(self.physics, left, model)
        window = model.spec.horizon * model.spec.dt * self.task.clock
        for column, rate in zip(left.rows.tolist(), self._doubt(left, learned), strict=True):
            name = model.system.state_names[column]
            # a rate that is off by r moves the state by r T in a time T, and a diffusion of r sqrt(T) as far
            laws[name] = replace(laws[name], diffusion=hypot(laws[name].diffusion, rate * sqrt(window)))
        if not model.step.deterministic:
            _set_laws(model, laws, left, features)
        return self._about(left, learned, laws)

    # ---- stages ---------------------------------------------------------------------------------------

    def _identified(self, found: Identified) -> Identification:
        """Declared parameters, with what the loop and instruments say of them."""
        return identify_in_loop(
            found.spec.make_system(self.task.values),
            self.runs,
            clock=self.task.clock,
            method=found.method,
            instruments=self.task.instruments,
            begun=found.settled,
        )

    def _near(self, found: Identified) -> Identification:
        """Declared parameters, under noise levels that are known if the likelihood was relied on."""
        at = found.settled
        known = identification(at.regression, found.method, standstill=at.left_out)
        if not self.near.get("relied"):
            return known
        levels = Levels(**{k: torch.tensor(v, dtype=torch.float64) for k, v in self.near["levels"].items()})
        system = copy.deepcopy(at.regression.vector.system)
        return by_likelihood(known, system, self.runs, self.task.clock, held=levels)

    def _use(self, theta: Array, *, write: bool = True) -> None:
        """Take values of the parameters, and write the means over the runs, where they differ, to the model."""
        self.theta = theta
        if write:
            values = theta
            if self.physics is not self.declared:
                values = between_runs.means(self.declared.vector, self.physics.vector.at(theta))
            self.declared.vector.write(self.model.system, values)
            if self.known is not None:
                self.known = replace(self.known, values=values)

    def _by_run(self, at: Optimum | None, learned: Distilled | None) -> Optimum | None:
        """Physics with numbers for each run from here on, and the optimum of it; None where nothing differs."""
        # of the published flights, whose inputs know the future, five minutes of differences came to nothing; fits of
        # some of the runs are made where nothing differs
        if at is None or self.found is None or self.task.near is not None or self.model.spec.filter_reach > 0:
            return None
        try:
            beside = learned.functions if learned else None
            targets = recall(("differing", self.task.before_seed), lambda: between_runs.differing(at, beside))
            if not targets:
                return None
            runs = between_runs.numbered(self.runs, self.model.system)
            machine = between_runs.with_numbers(self.declared.vector.at(self.theta), targets, len(runs))
            best, numbers = nearly_maximised(LogLikelihood(machine, runs, self.task.clock))
        except (DataError, NonFiniteError, np.linalg.LinAlgError):
            return None
        self.physics = regression_of(machine, runs, clock=self.task.clock).physics
        known = self.known
        assert known is not None
        odd = known.guard is not None and all(
            o.kind in ("odd_run", "unexplained_run") for o in known.guard.objections
        )
        # a run that differs from others, and what this leaves in the innovations, speak against the likelihood no more
        self.relied |= not best.objections and (known.likelihood is not None or odd)
        self._use(best.theta, write=self.relied)
        if self.relied:
            system = self.physics.vector.at(best.theta)
            loop = known.loop and feedback_summary(system, runs, self.task.clock)
            self.known = replace(
                known,
                values=between_runs.means(self.declared.vector, system),
                covariance=between_runs.covariance_of_means(self.declared.vector, best),
                converged=True,
                guard=None if odd else known.guard,
                loop=loop,
                doubt=known.doubt if loop is not None and loop.closed_loop else None,
            )
        return numbers

    def _networks(self, at: Optimum | None, left: Residuals) -> Distilled | None:
        """Networks of the functions that the likelihood finds; zero where there is no likelihood."""
        model = self.model
        if at is None:
            for network in model.residuals.values():
                silence(network)
            blind_to_places(model)
            return None
        key = ("functions", self.task.before_seed, self.physics is self.declared)
        found = recall(key, lambda: functions_of(model, at, among=self.near.get("functions")))
        made = fit_functions(model, found, at, left)
        levels = {f.name: getattr(at.levels, f.name).tolist() for f in fields(at.levels)}
        self.begin = {"relied": self.relied, "levels": levels, "functions": made.chosen}
        if made.functions.groups or self.relied or self.found is None:
            self._use(made.functions.theta)
            if self.known is not None:  # what functions can do too is known the less of a parameter
                alone = np.sqrt(np.diag(self.known.covariance).clip(1e-300))  # 0 and nan stay
                wider = np.fmax(made.functions.errors / alone, 1.0)
                self.known = replace(self.known, covariance=self.known.covariance * wider[:, None] * wider)
        return made

    def _optimum(self) -> Optimum | None:
        """Where the likelihood of declared physics is largest, also where its values are not those to print."""
        if self.known is not None and self.known.optimum is not None:
            return self.known.optimum
        machine = copy.deepcopy(self.physics.vector.system)
        self.physics.vector.write(machine, self.theta)
        try:
            return nearly_maximised(LogLikelihood(machine, self.runs, self.task.clock))[1]
        except (DataError, NonFiniteError, np.linalg.LinAlgError):
            return None

    def _beside_networks(self) -> None:
        """Declared parameters beside networks that are all that acts on a port."""
        try:
            regression = Regression(self.physics, start=self.theta)
            regression.run(ITERATIONS)
            self.known = identification(regression, "weak")
        except DataError:
            return  # no input: nothing that is declared moves anything
        self.theta = self.known.values
        self.physics.vector.write(self.model.system, self.theta)

    def _doubt(self, left: Residuals, learned: Distilled | None) -> Array:
        """Standard error of the drift of each channel (channels,), root mean square over the data [per second]."""
        variance = np.zeros(len(left.rows))
        if learned is not None:
            variance += np.square(learned.spread / left.dt)
        if self.known is not None:
            slopes = self.declared.slopes(self.known.values)[:, left.rows] / left.dt
            known = np.nan_to_num(self.known.covariance)
            variance += np.einsum("nck,kl,ncl->nc", slopes, known, slopes, optimize=True).mean(0).clip(0.0)
        return np.sqrt(variance)

    # ---- what is reported -----------------------------------------------------------------------------

    def _about(
        self, left: Residuals, learned: Distilled | None, laws: dict[str, Disturbance]
    ) -> dict[str, Any]:
        found, known = self.found, self.known
        size = np.sqrt(np.square(left.change[:, left.rows]).mean(0)).clip(1e-300)
        score = learned.score if learned else float(np.log(size).mean())
        steps = learned.steps if learned else 0
        if known is not None:
            parameters = known.parameters()
        else:
            parameters = {
                n: {"value": v.tolist(), "half_width_90": [None] * v.numel(), "unit": u}
                for n, (v, u) in self.model.system.all_declared().items()
            }
        networks = learned.networks if learned else {}
        loop = {} if known is None or known.loop is None else {"feedback": known.loop.as_dict()}
        facts = {
            "validation": {"score": score, "unit": "nats a step and channel, on blocks of time left out"},
            **loop,
            "innovations": {
                "networks": networks,
                "learned_lag": found.learned if found and found.learned else None,
                "learned_lag_nats": found.evidence if found else 0.0,
                "noise": {name: dict(zip(_NOISE, astuple(law), strict=True)) for name, law in laws.items()},
                "not_shown": known.findings if known else [],
            },
            "between_runs": {
                one.target: {
                    "unit": one.unit,
                    "std": list(one.std),
                    "of_runs": {run.name: list(n) for run, n in zip(self.runs, one.of_runs, strict=True)},
                }
                for one in self.differs
            },
        }
        said = self._said(networks)
        progress = Progress(steps, steps, score, [{"step": float(steps), "validation": score}], stopped=True)
        out = {"progress": asdict(progress), "parameters": parameters, "facts": facts}
        return {**out, "said": said, "begin": self.begin}

    def _said(self, networks: Mapping[str, Mapping[str, Any]]) -> str:
        """What a person reads of the fit."""
        found, known, lines = self.found, self.known, list[str]()
        if found is not None:
            r = found.settled.regression
            lines.append(
                f"fitted: declared physics by prediction errors ({r.iterations} iterations, "
                f"{'settled' if r.converged else 'not settled'})"
            )
            if found.learned:
                lines.append(
                    f"learned: inputs act late, as by {found.learned} ({number(found.evidence)} nats); it is not "
                    "declared, model.learn_lag=false leaves it out"
                )
        for port, n in networks.items():
            of = f"of {', '.join(n['variables'])}" if n["kept"] else "none"
            nats = f"{n['nats']:+.1f} +- {n['standard_error']:.1f} nats on blocks left out"
            lines.append(f"network on {port}: {nats}: {of}")
        for one in self.differs:
            std = f"{', '.join(number(v) for v in one.std)} {one.unit}"
            lines.append(f"between runs: {one.target} differs ({std}, standard deviation)")
        lines += [f"warning: {sentence}" for sentence in (known.warnings if known else ())]
        lines += [f"feedback: {sentence}" for sentence in (known.of_the_loop if known else ())]
        return "\n".join(lines)


def _channel_laws(physics: Physics, found: Residuals, model: NeuralSDE) -> dict[str, Disturbance]:
    """Noise laws of the residual of every channel beside physics and networks, by the name of the state."""
    system, q, left = model.system, model.system.quaternion, found.change
    lasting = {int(found.rows[c]) for c in disturbed_channels(model, found)}
    forced = set(found.rows.tolist())
    shortest = 2.0 * model.spec.dt * float(model.clock_scale)
    out: dict[str, Disturbance] = {}
    for i, name in enumerate(system.state_names):
        if q is not None and q.start <= i < q.stop:
            continue
        seen = spectrum(left[:, [i]], found.series, found.dt)
        law = fit(seen, lasting=i in forced, shortest=shortest)
        # a force that lasts, of a model that has no state for it, is as much diffusion over a window
        out[name] = law if i in lasting else law.without_memory(model.spec.horizon * shortest / 2.0)
    if q is not None:
        attitude = physics.attitude
        turn = rotation_between(attitude, attitude + torch.as_tensor(left[:, q])).numpy()
        law = fit(spectrum(turn, found.series, found.dt), lasting=False, shortest=shortest)
        # a rotation is twice its quaternion
        half = Disturbance(0.5 * law.diffusion, 0.0, law.tau, 0.5 * law.sensor)
        out.update(dict.fromkeys(system.state_names[q], half))
    if physics.turned is not None:  # measured in the world, given in the body
        names = system.state_names[physics.turned]
        sensor, diffusion = (
            sqrt(np.mean([getattr(out[n], part) ** 2 for n in names])) for part in ("sensor", "diffusion")
        )
        out.update({n: Disturbance(diffusion, out[n].std, out[n].tau, sensor) for n in names})
    return out


@torch.no_grad()
def _set_laws(model: NeuralSDE, laws: dict[str, Disturbance], found: Residuals, features: Tensor) -> None:
    """Give a model diffusion, disturbances and sensors, so that their mean over the data is that of the laws.

    Its distance is fitted; `features` are of the data (N, nf).
    """
    system, clock = model.system, float(model.clock_scale)
    names = system.state_names
    sigma = [laws[n].diffusion * sqrt(clock) for n in names]
    channels = [laws[names[int(found.rows[c])]] for c in disturbed_channels(model, found)]
    sigma += [law.std * sqrt(2.0 * clock / law.tau) for law in channels]
    own = torch.tensor(sigma, dtype=torch.float64).clamp_min(_LEAST)
    if model.h.log_sigma_max.requires_grad:
        declared = torch.tensor(system.defaults.sigma_max, dtype=torch.float64) * sqrt(clock)
        least = torch.cat((declared, torch.zeros(len(channels), dtype=torch.float64)))
        model.h.through(model.eta(features), own, least)
    if channels:
        tau = torch.tensor([law.tau for law in channels]) - 2.0 * model.spec.dt
        model.log_tau.copy_(tau.clamp_min(1e-4).log())
    if model.spec.measurement:
        sensors = torch.tensor([laws[n].sensor for n in names]).clamp_min(_LEAST)
        model.log_measurement_std.copy_(sensors.log())


# ---- inputs that act late ------------------------------------------------------------------------------
#
# A network of the state cannot hold what an actuator remembers: in a closed loop it would learn the controller
# instead. So where the declared effects carry no memory of the inputs, each law of the catalogue that does is fitted
# beside the declared parameters, and the likeliest is taken if the log likelihood of the innovations rises by more
# than `EVIDENCE` and its time is not nothing by two half-widths of its interval. It is reported as learned; to have it
# as declared physics, name it in system.effects.

LAWS = ("motor_lag", "actuator_lag", "input_delay")
"""Effects of the catalogue with which inputs, or one of several, act late, one time each."""
EVIDENCE = 10.0
"""Log likelihood that a law must win [nats]; 10 nats for one parameter happen by chance once in 100,000 data sets."""


@dataclass(frozen=True)
class Identified:
    """Declared physics as it was identified."""

    spec: SDESpec  # specification with the law that was learned, if any
    method: str  # of the identification: finite differences where inputs were smoothed
    settled: Settled  # the regression at its optimum, and its runs
    learned: str = ""  # name of the law; empty for none
    evidence: float = 0.0  # log likelihood that it won [nats]


def identified(spec: SDESpec, runs: Sequence[Run], *, clock: float, values: Mapping[str, Any]) -> Identified:
    """Identify declared physics, with a lag or a delay of the inputs where the data show one.

    Of runs with inputs as they acted, from initial `values`. A law is looked for with the method "weak" alone, whose
    innovations are white. ConfigError, DataError or NonFiniteError where there is no parameter, nothing moves, or the
    physics diverges.
    """
    system, method = spec.make_system(values), "differences" if spec.filter_reach else "weak"
    base = settled(system, runs, clock=clock, method=method, width=None, iterations=ITERATIONS)
    remembers = any(isinstance(e, Effect) and e.port is Port.INPUT and e.n_memory for e in system.effects)
    found = Identified(spec, method, base)
    if not spec.learn_lag or remembers or method != "weak":
        return found
    rows = len(base.regression.series)  # a memory takes some rows for itself
    before = sum(noise.likelihood(rows) for noise in base.regression.noises)
    # of one input alone, too: with a lag of both, the surge of a boat whose rudder lags had twice the error at 2 s
    for name in [name for name in system.able_effects() if split_name(name)[0] in LAWS]:
        wider = replace(spec, effects=(*spec.effects, name))
        try:
            machine = wider.make_system(values)
            base.regression.vector.write(machine, base.regression.theta)
            regression = regression_of(machine, base.runs, clock=clock)
            regression.run(ITERATIONS)
            won = sum(noise.likelihood(rows) for noise in regression.noises) - before
            if won > max(EVIDENCE, found.evidence) and _shown(regression, name):
                found = Identified(wider, method, replace(base, regression=regression), name, won)
        except NsdeError:
            continue  # a law that does not fit the system, or cannot be followed at this step
    return found


def _shown(regression: Regression, law: str) -> bool:
    """Whether the times of a law are surely more than nothing."""
    return all(
        half is not None and value > 2.0 * half
        for key, p in identification(regression, "weak").parameters().items()
        if key.startswith(f"{law}.")
        for value, half in zip(p["value"], p["half_width_90"], strict=True)  # type: ignore[call-overload]
    )
