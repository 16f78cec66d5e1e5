"""A neural SDE fitted by what is new at each step of the log: physics, then networks, then what disturbs.

1. Declared parameters, with their covariance, by the prediction-error identification of `sysid`, and a lag
   of the inputs where the data show one that is not declared (`innovations.actuators`).
2. Residual networks on the whitened residuals of that physics (`innovations.networks`).
3. The distance eta by its own losses.
4. Diffusion, lasting disturbances and sensors from the spectrum of what is left (`innovations.disturbances`), and into
   the diffusion what is not known of the drift: the covariance of the parameters, and the jackknife of the networks
   over blocks of time. Their mean over the data is as found; far from the data sigma is at least the declared one.

Every stage sees one step of the log at a time, given what came before it, so inputs that answer disturbances do not
bend it. What it gives up: predictions of the pilot's own flights under the pilot's own inputs, which know what
disturbed, are not the target; `loss=replay` is better at those. Assumed: the controller saw no more than the log holds.

Where a port has no declared physics the network is all that is known of it. What is foreseen without it would be
wrong; features are then those of smoothed states, and the noise is that of the sensors until the network is known.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from math import isfinite
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from tqdm.auto import tqdm

from nsde_torch.data import Run, Windows
from nsde_torch.effects import Port
from nsde_torch.errors import CheckpointError, DataError
from nsde_torch.inference.steps import steps_of
from nsde_torch.innovations.actuators import Identified, identified
from nsde_torch.innovations.disturbances import Disturbance
from nsde_torch.innovations.inputs import as_applied, fit_filter
from nsde_torch.innovations.laws import channel_laws, set_laws, with_doubt
from nsde_torch.innovations.networks import Learned, NetworkSettings, fit_networks
from nsde_torch.innovations.residuals import (
    Residuals,
    input_history,
    noise_models,
    pushed,
    residuals,
    with_networks,
)
from nsde_torch.models.networks import MLP
from nsde_torch.models.neural_sde import NeuralSDE, SDESpec
from nsde_torch.progress import no_bar
from nsde_torch.sysid.identify import identification
from nsde_torch.sysid.in_loop import identify_in_loop
from nsde_torch.sysid.noise import Noise, white_noise
from nsde_torch.sysid.physics import Physics
from nsde_torch.sysid.regression import ITERATIONS, Regression, carry_limits
from nsde_torch.sysid.result import Identification
from nsde_torch.systems.parameters import ParameterVector
from nsde_torch.training.checkpoint import read_checkpoint, write_checkpoint
from nsde_torch.training.fit_distance import fit_distance
from nsde_torch.training.fit_functions import fit_functions
from nsde_torch.training.innovations_summary import summary
from nsde_torch.training.prepare import blind_to_places
from nsde_torch.training.progress import Progress
from nsde_torch.training.task import Fitted, Parameters, Task

Array = NDArray[np.float64]

_BLOCK_S = 4.0  # of time, left out in turn
_FOLDS = (2, 5)
_RATE = 0.3  # of trainer.lr: all data are one batch
_BARE_RATE = 3.0  # faster where a network is all that is known
_EVERY, _PATIENCE = 20, 5  # steps between looks at what is left out, looks without a better one
_DISTANCE_STEPS = 600
_ROWS = 20_000  # whose features the distance sees


def fit_innovations(task: Task) -> Fitted:
    """Fit a model with declared physics by innovations.

    Raises:
        ConfigError: the system declares no parameter.
        DataError: a run is too short.
        NonFiniteError: the physics leaves the finite numbers.
    """
    spec = task.spec
    assert isinstance(spec, SDESpec)
    Windows(
        task.runs, spec.dt, spec.horizon
    )  # refuses steps that do not divide, and runs shorter than a window
    nu = spec.make_system().nu
    runs = as_applied(task.runs, nu) if spec.filter_reach else list(task.runs)
    found = None
    if not _bare_ports(spec):
        method = "weak" if spec.filter_reach == 0 else "differences"
        found = identified(spec, runs, clock=task.clock, values=task.values, method=method)
    generator = torch.Generator().manual_seed(task.seed)
    model = NeuralSDE(found.spec if found else spec, generator=generator, values=task.values)
    about = _from_checkpoint(model, task)
    if about is None:
        about = _Fit(model, task, runs, found).run()
        state = model.state_dict()
        write_checkpoint(
            task.checkpoint,
            {f"{part}.{k}": v for part in ("model", "kept") for k, v in state.items()},
            {"identity": task.identity, **about},
        )
    if model.filter is not None:
        fit_filter(model.filter, task.runs, runs, nu)
    progress = Progress(**about["progress"])
    for row in progress.history:
        task.log(int(row["step"]), row)
    parameters: Parameters = about["parameters"]
    return Fitted(
        model.to(device=task.device, dtype=task.dtype),
        progress,
        lambda: parameters,
        about["facts"],
        said=about["said"],
    )


def _bare_ports(spec: SDESpec) -> set[Port]:
    """Ports with a residual network and no declared physics."""
    system = spec.make_system()
    return set(system.residual_ports) - system.physics_ports


def _from_checkpoint(model: NeuralSDE, task: Task) -> dict[str, Any] | None:
    """What a finished fit left, its weights put into the model; None if there is none."""
    found = read_checkpoint(task.checkpoint, model.state_dict(), parts=())
    if found is None:
        return None
    tensors, about = found
    if about.pop("identity", "") != task.identity:
        raise CheckpointError(
            f"checkpoint {task.checkpoint.with_suffix('.safetensors')} is of another training: runs, seed, loss, "
            "trainer or model differ. Resume with the configuration of the run, or start a new one in another run_dir."
        )
    model.load_state_dict({k[6:]: v for k, v in tensors.items() if k.startswith("model.")})
    return about


class _Fit:
    """One fit, in double precision where physics is evaluated and single precision where networks are.

    Args:
        model: Changed in place.
        task: NetworkSettings.
        runs: Runs with inputs as they acted.
        found: Declared physics; None where it is not all that acts on some port.
    """

    def __init__(self, model: NeuralSDE, task: Task, runs: Sequence[Run], found: Identified | None) -> None:
        self.model, self.task, self.runs, self.found = model, task, runs, found
        self.identification: Identification | None = None
        self.variables: Mapping[Port, tuple[str, ...]] = {}  # what networks were found to depend on
        self.size = 0.0  # mean log standard deviation of the innovations
        model.clock_scale.fill_(task.clock)
        if found is not None:
            self.physics = found.regression.physics
            self.theta = self._in_loop(found)
        else:
            vector = ParameterVector(model.system)
            steps = steps_of(vector.system, runs, clock=task.clock, smooth=False, denoise=True)
            self.physics = Physics(vector, steps, foresee=False)
            self.theta = vector.inside(vector.start)

    def run(self) -> dict[str, Any]:
        """Fit everything; returns what the checkpoint tells."""
        model, options = self.model, self.task.options
        left = residuals(self.physics, self.theta, model.residual_ports)
        self._standardise(left)
        learned = self._functions(left)
        if learned is None:
            learned = self._networks(left, first=self.found is None)
        if self.found is None:
            left = self._again(left)
            learned = self._networks(left)
            change = self._left(left)
        else:
            left = residuals(with_networks(self.physics, model), self.theta, model.residual_ports)
            change = left.change
        features = model.system.features(left.states.float())
        features = features[torch.linspace(0, len(features) - 1, min(_ROWS, len(features))).round().long()]
        steps = min(_DISTANCE_STEPS, options.steps)
        fit_distance(model, features, loss=self.task.loss, steps=steps, rate=options.lr, seed=self.task.seed)
        self.size = float(np.mean(np.log([noise.std for noise in self._noises(left, change)])))
        laws = channel_laws(self.physics, left, change, model)
        window = model.spec.horizon * model.spec.dt * self.task.clock
        for column, rate in zip(left.rows.tolist(), self._doubt(left, learned), strict=True):
            name = model.system.state_names[column]
            laws[name] = with_doubt(laws[name], rate, window)
        if not model.step.deterministic:
            set_laws(model, laws, left, features)
        return self._about(left, learned, laws)

    # ---- stages ---------------------------------------------------------------------------------------

    def _in_loop(self, found: Identified) -> Array:
        """Declared parameters, with what the loop and instruments say of them."""
        self.identification = known = identify_in_loop(
            found.spec.make_system(self.task.values),
            self.runs,
            clock=self.task.clock,
            method=found.method,
            instruments=self.task.instruments,
        )
        known.vector.write(self.model.system, known.values)
        return known.values

    def _standardise(self, left: Residuals) -> None:
        system, states = self.model.system, left.states.float()
        self.model.residual_inputs.fit(system.network_features(states))
        blind_to_places(self.model)
        self.model.eta.standardise.fit(system.features(states))

    def _functions(self, left: Residuals) -> Learned | None:
        """Networks from functions that the likelihood chose; None where there is no likelihood to rely on."""
        known = self.identification
        if known is None or known.optimum is None or not left.ports:
            return None
        made = fit_functions(self.model, known.optimum, left)
        if not made.functions.groups and not known.likelihood_used:
            self._standardise(left)
            return None
        self.variables = made.variables
        self.theta = made.functions.theta
        self.identification = replace(known, values=self.theta)
        return made.learned

    def _again(self, left: Residuals) -> Residuals:
        """Declared parameters beside networks that are all that acts on a port, and what is left without them."""
        known = np.zeros_like(left.change)
        with torch.no_grad():
            model = self.model
            known[:, left.rows] = pushed(model, model.residuals, left).T.double().numpy()
        self.physics.measured = self.physics.measured - known
        try:
            regression = Regression(self.physics)
            regression.run(ITERATIONS)
            self.identification = identification(regression, "weak")
            self.theta = regression.theta
            regression.vector.write(self.model.system, self.theta)
        except DataError:
            pass  # no input: nothing that is declared moves anything
        self.physics.measured = self.physics.measured + known
        return residuals(self.physics, self.theta, self.model.residual_ports)

    def _networks(self, left: Residuals, *, first: bool = False) -> Learned | None:
        model, task = self.model, self.task
        if not left.ports:
            return None
        bare = self.found is None
        if first or not bare:
            for network in model.residuals.values():
                _silence(network)
        change = left.change if first or not bare else self._left(left)
        noises = self._noises(left, change, first=first)
        y = model.residual_inputs(model.system.network_features(left.states.float()))
        settings = NetworkSettings(
            steps=task.options.steps,
            rate=_RATE * task.options.lr * (_BARE_RATE if bare else 1.0),
            every=_EVERY,
            patience=_PATIENCE,
            folds=int(np.clip(round(1.0 / task.validation), *_FOLDS)),
            block=max(1, round(_BLOCK_S / left.dt)),
            penalty=lambda networks: self._decay(networks),
        )
        inputs = self.physics.steps.u[:, : model.system.nu].numpy()
        with tqdm(
            total=settings.steps, desc=task.name, unit="step", disable=no_bar(task.quiet), leave=False
        ) as bar:
            learned = fit_networks(
                model.residuals,
                lambda networks: pushed(model, networks, left, y),
                torch.from_numpy(left.change[:, left.rows].T).float().contiguous(),
                noises,
                left.series,
                _moved(left),
                settings,
                nuisance=torch.zeros(len(change), 0) if bare else input_history(inputs, left.series),
                keep=[port not in model.system.physics_ports for port, _ in left.ports],
                generator=torch.Generator().manual_seed(task.seed),
                on_step=lambda _: _advance(bar),
            )
        for group, (port, _) in enumerate(left.ports):
            if not learned.kept[group]:
                _silence(model.residuals[port.value])
        return learned

    def _noises(self, left: Residuals, change: Array, *, first: bool = False) -> list[Noise]:
        """Noise models of what is left (N, nx); of smoothed states no more than its size is known."""
        if self.found is not None and self.found.method != "weak":
            return [white_noise(change[:, c], left.series) for c in left.rows]
        return noise_models(left, change, carry_limits(self.physics, self.theta, 1), first=first)

    def _decay(self, networks: nn.Module) -> Tensor:
        """A network beside declared physics is kept small; one that is all there is on its port is not."""
        beside = self.model.system.physics_ports & set(self.model.residual_ports)
        norms = [_network(networks, port).weight_norm() for port in sorted(beside)]
        return self.task.loss.decay * torch.stack(norms).sum() if norms else torch.zeros(())

    @torch.no_grad()
    def _left(self, left: Residuals) -> Array:
        """What is left of every channel with the networks (N, nx)."""
        out, model = left.change.copy(), self.model
        if left.ports:
            out[:, left.rows] -= pushed(model, model.residuals, left).T.double().numpy()
        return out

    def _doubt(self, left: Residuals, learned: Learned | None) -> Array:
        """Standard error of the drift of each channel (channels,), root mean square over the data [per second]."""
        variance = np.zeros(len(left.rows))
        if learned is not None:
            variance += np.square(np.array(learned.spread) / left.dt)
        if self.identification is not None:
            slopes = self.physics.slopes(self.theta)[:, left.rows] / left.dt
            known = np.nan_to_num(self.identification.covariance)
            variance += np.einsum("nck,kl,ncl->nc", slopes, known, slopes, optimize=True).mean(0).clip(0.0)
        return np.sqrt(variance)

    # ---- what is told ---------------------------------------------------------------------------------

    def _about(
        self, left: Residuals, learned: Learned | None, laws: dict[str, Disturbance]
    ) -> dict[str, Any]:
        model, found = self.model, self.found
        history = [
            {"step": float(step), "validation": score} for step, score in (learned.history if learned else ())
        ]
        progress = Progress(
            step=learned.tried if learned else 0,
            best_step=learned.steps if learned else 0,
            best_score=self.size + 0.5 * (learned.after if learned else 1.0),
            history=history or [{"step": 0.0, "validation": 1.0}],
            stopped=True,
        )
        if self.identification is not None:
            parameters = self.identification.parameters()
        else:
            declared = model.system.all_declared().items()
            parameters = {
                n: {"value": v.tolist(), "half_width_90": [None] * v.numel(), "unit": u}
                for n, (v, u) in declared
            }
        networks = {
            port.value: {
                "nats": learned.gain[k],
                "standard_error": learned.error[k] if isfinite(learned.error[k]) else None,
                "kept": learned.kept[k],
                **({"variables": list(self.variables[port])} if port in self.variables else {}),
            }
            for k, (port, _) in enumerate(left.ports)
            if learned is not None
        }
        return {
            "progress": asdict(progress),
            "parameters": parameters,
            "facts": {
                "validation": {
                    "score": progress.best_score,
                    "unit": "nats a step and channel, on blocks of time left out",
                },
                **self._facts(networks, laws),
            },
            "said": summary(found, self.identification, networks, learned),
        }

    def _facts(self, networks: dict[str, Any], laws: dict[str, Disturbance]) -> dict[str, Any]:
        """What `metrics.json` holds of the fit."""
        found, known = self.found, self.identification
        loop = {} if known is None or known.loop is None else {"feedback": known.loop.as_dict()}
        return {
            **loop,
            "innovations": {
                "networks": networks,
                "learned_lag": found.learned if found and found.learned else None,
                "learned_lag_nats": found.evidence if found else 0.0,
                "noise": {
                    name: {
                        "diffusion": law.diffusion,
                        "force_std": law.std,
                        "force_tau_s": law.tau,
                        "sensor_std": law.sensor,
                    }
                    for name, law in laws.items()
                },
                "not_shown": known.findings if known else [],
            },
        }


def _network(networks: nn.Module, port: Port) -> MLP:
    """The network of a port."""
    assert isinstance(networks, nn.ModuleDict)
    network = networks[port.value]
    assert isinstance(network, MLP)
    return network


@torch.no_grad()
def _silence(network: nn.Module) -> None:
    """Let a network say nothing."""
    assert isinstance(network, MLP)
    last = network.layers[-1]
    for parameter in last.parameters():
        parameter.zero_()


def _advance(bar: tqdm) -> None:
    bar.update()


def _moved(left: Residuals) -> list[list[int]]:
    """Columns of `Residuals.rows` that each port moves."""
    groups, at = [], 0
    largest = float(left.response.abs().max())
    for _, width in left.ports:
        size = left.response[:, :, at : at + width].abs().amax((0, 2))
        groups.append(torch.nonzero(size > 1e-6 * largest)[:, 0].tolist())
        at += width
    return groups
