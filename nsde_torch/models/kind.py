"""A kind of model: one object says what a user chooses of it, what it is made of, and how it is fitted.

What its models can do they say themselves (`Model.capabilities`). A kind is registered by a line in
`nsde_torch.models.options.MODELS`, or named `module:Class` wherever the name of a kind can stand. Those of the package
make of what the user chose, the machine and the data:

sigma_max      learned; the system's with loss=paper or where the user declares it
input filter   as many taps as undo the smoothing that the training runs show; none with loss=paper
sensor noise   learned by innovations, and where the system asks for it
disturbance    where the system has ports for one
integrator     of second order in the drift for innovations, without noise for models without diffusion

How each is fitted lies a layer above, and is named by where it lies: who flies a model need not load what trains it.
"""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, final

import numpy as np
import torch

from nsde_torch.columns import join_columns
from nsde_torch.data.run import Run
from nsde_torch.data.windows import TOLERANCE
from nsde_torch.errors import ConfigError
from nsde_torch.lookup import class_by_name, function_by_name
from nsde_torch.models.ensemble import EnsembleSpec, GaussianEnsemble
from nsde_torch.models.feedback_model import LAGS
from nsde_torch.models.identified import IdentifiedModel, SysidSpec
from nsde_torch.models.model import Model, ModelSpec
from nsde_torch.models.neural_sde import NeuralSDE, SDESpec
from nsde_torch.models.options import (
    MODELS,
    BlackboxOptions,
    EnsembleOptions,
    ModelOptions,
    NodeOptions,
    NsdeOptions,
    SysidOptions,
)
from nsde_torch.recording.smoothing import smoothing_width
from nsde_torch.sde.exponential import is_stiff, jacobians
from nsde_torch.sde.options import IntegratorOptions
from nsde_torch.sde.registry import make_step
from nsde_torch.sde.step import Step
from nsde_torch.systems.base import System
from nsde_torch.systems.options import SystemOptions

_ROWS = 200  # that say whether a machine is stiff


def whole_steps(dt: float, runs: Sequence[Run]) -> float:
    """The whole multiple of the data's step that is nearest to a model's own step [s].

    A machine's step of 50 ms fits data at 10 ms, and PX4's logs at 8 ms not: they get 48 ms.
    """
    if not runs:
        return dt
    ratio = dt / runs[0].dt
    nearest = max(round(ratio), 1)
    # what fits within the tolerance of `Windows` is left as it is
    return dt if abs(ratio / nearest - 1.0) <= TOLERANCE else nearest * runs[0].dt


@dataclass(frozen=True, kw_only=True)
class Choice:
    """What the specification of a model is made from: what the user chose, the machine, and the data."""

    options: ModelOptions  # what the user chose of the model
    system: SystemOptions  # the machine's name, physics and constants
    machine: System  # the system that these options make
    runs: Sequence[Run]  # training runs
    loss: str = "innovations"  # kind of loss
    integrator: IntegratorOptions = field(default_factory=IntegratorOptions)
    """Integrator; one without a name is the one that fits."""

    @property
    def common(self) -> dict[str, Any]:
        """Arguments that every specification has (`ModelSpec`)."""
        own, system = self.machine.defaults, self.system
        return {
            "system": system.name,
            "kind": self.options.kind,
            "effects": tuple(system.effects),
            "declared": None if system.declared is None else tuple(system.declared),
            "system_options": dict(system.options),
            "dt": whole_steps(own.dt, self.runs) if system.dt is None else system.dt,
            "horizon": own.horizon if system.horizon is None else system.horizon,
        }

    @property
    def stiff(self) -> bool:
        """Whether something settles in hardly more than a step of the model, by the first values of the machine.

        A machine that knows its attitude is never taken for stiff (`nsde_torch.inference.state_space`).
        """
        system = copy.deepcopy(self.machine).double()
        if not self.runs or system.quaternion is not None:
            return False
        run = self.runs[0]
        some = np.linspace(0, len(run) - 1, _ROWS).astype(np.int64)
        t, x, u = (torch.from_numpy(part[some]).double() for part in (run.t, run.x, run.u))
        memory = system.augment(x, u)[:, system.nx :]

        def rate(x: torch.Tensor) -> torch.Tensor:
            return system.drift(t, join_columns((x, memory)), u)[:, : system.nx]

        with torch.no_grad():
            return is_stiff(self.common["dt"] * jacobians(rate, x))

    @property
    def filter_reach(self) -> int:
        """Taps that an input filter needs on each side to undo the smoothing found in the runs; 0 for none."""
        return math.ceil(smoothing_width(self.runs, self.machine.nu) / self.common["dt"] - 1e-6)


class ModelKind(ABC):
    """A kind of model. Subclasses set the class attributes and write `make_spec` and `fit`; none is instantiated."""

    options: ClassVar[type[ModelOptions]]  # what a user chooses of it
    spec: ClassVar[type[ModelSpec]]  # what is saved of a model beside its weights
    model: ClassVar[type[Model]]  # the model itself, made from a specification
    noise: ClassVar[bool | None] = None
    """Whether its integrator must be one for equations with noise (True), without (False), or either (None)."""
    compiles: ClassVar[bool] = True  # whether compiling the integrator's step pays for it
    fitted_by: ClassVar[str] = ""  # `module:function` that fits its models, where `fit` is not written

    @classmethod
    @abstractmethod
    def make_spec(cls, choice: Choice) -> ModelSpec:
        """The specification of a model: what the user did not choose is as the machine and the data ask for.

        A ConfigError refuses choices that do not fit.
        """

    @classmethod
    def fit(cls, task: Any) -> Any:
        """Fit a model to runs: from a `Task` the model and how it went, a `Fitted` (`nsde_torch.training.task`)."""
        return function_by_name(cls.fitted_by)(task)

    @classmethod
    def step(cls, choice: Choice) -> Step:
        """The integrator that the user chose, or else the one that fits; a ConfigError where it does not."""
        kind = choice.options.kind
        made = make_step(cls.step_name(choice), **choice.integrator.settings)
        if cls.noise is False and not made.deterministic:
            raise ConfigError(
                f"`model={kind}` has no diffusion, and solver={made.name} is for equations with noise. "
                "Take solver=rk4, midpoint or torchdiffeq, or leave it out."
            )
        if cls.noise is True and made.deterministic:
            raise ConfigError(
                f"`model={kind}` has a diffusion, which solver={made.name} would leave out; choose a "
                "solver for equations with noise, or leave it out."
            )
        return made

    @classmethod
    def step_name(cls, choice: Choice) -> str:
        """Name of the integrator that the user chose, or else of the one that fits."""
        if choice.integrator.name is None and choice.stiff:
            return "exponential" if cls.noise is False else "exponential_maruyama"
        return choice.integrator.name or cls.own_step(choice)

    @classmethod
    def own_step(cls, choice: Choice) -> str:
        """Name of the integrator where the user chose none: the machine's, or rk4 without noise."""
        return "rk4" if cls.noise is False else choice.machine.defaults.step


class _Equation(ModelKind):
    """What the neural SDE, the neural ODE and the SDE without physics have in common."""

    spec = SDESpec
    model = NeuralSDE
    fitted_by = "nsde_torch.training.fit_sde:fit_sde"
    physics: ClassVar[bool] = True

    @classmethod
    def make_spec(cls, choice: Choice) -> SDESpec:
        solver = cls.step(choice)
        paper = choice.loss == "paper"
        innovations = cls.physics and choice.loss == "innovations"
        plain = paper or solver.deterministic
        machine, common = choice.machine, choice.common
        chosen = vars(choice.options)
        sigma_max = choice.system.sigma_max
        if sigma_max is None and (chosen.get("sigma") or ("declared" if paper else "learned")) == "declared":
            sigma_max = machine.defaults.sigma_max
        widths: dict[str, Any] = {k: tuple(v) for k, v in chosen.items() if k.endswith("_hidden")}
        reach = chosen["filter_reach"]
        if reach is None:
            reach = 0 if paper else choice.filter_reach
        measurement, disturbance = chosen.get("measurement"), chosen.get("disturbance")
        if measurement is None:
            measurement = not plain and (innovations or machine.sensor_noise)
        if disturbance is None:
            disturbance = not plain and bool(machine.disturbed_ports)
        return SDESpec(
            **common,
            **widths,
            step=cls.step_name(choice),
            solver=choice.integrator.settings,
            physics=cls.physics,
            sigma_max=None if sigma_max is None else tuple(sigma_max),
            filter_reach=reach,
            measurement=measurement,
            disturbance=cls.physics and disturbance,
            learn_lag=innovations and chosen["learn_lag"],
            loss=choice.loss,
            feedback=LAGS if innovations and not plain and chosen.get("learn_feedback") else 0,
        )


@final
class NeuralSDEKind(_Equation):
    """Declared physics, residual networks, distance-aware diffusion."""

    options = NsdeOptions

    @classmethod
    def own_step(cls, choice: Choice) -> str:
        """See `ModelKind.own_step`.

        A model of innovations has the parameters of the machine, not those that make up for a coarse step: its own is
        one of second order in the drift.
        """
        return "milstein_heun" if choice.loss == "innovations" else super().own_step(choice)


@final
class NeuralODEKind(_Equation):
    """The same drift, no diffusion."""

    options = NodeOptions
    noise = False


@final
class BlackboxKind(_Equation):
    """A network of state and input is the whole drift."""

    options = BlackboxOptions
    noise = True
    physics = False


@final
class EnsembleKind(ModelKind):
    """Networks that predict mean and variance of the next state."""

    options = EnsembleOptions
    spec = EnsembleSpec
    model = GaussianEnsemble
    fitted_by = "nsde_torch.training.fit_ensemble:fit_ensemble"

    @classmethod
    def make_spec(cls, choice: Choice) -> EnsembleSpec:
        chosen = choice.options
        assert isinstance(chosen, EnsembleOptions)
        own = {k: v for k, v in vars(chosen).items() if k not in ("kind", "hidden")}
        return EnsembleSpec(**choice.common, **own, hidden=tuple(chosen.hidden))


@final
class SysidKind(ModelKind):
    """The declared physics by least squares, and nothing else."""

    options = SysidOptions
    spec = SysidSpec
    model = IdentifiedModel
    fitted_by = "nsde_torch.training.fit_sysid:fit_sysid"
    noise = False
    compiles = False  # done before it compiles

    @classmethod
    def make_spec(cls, choice: Choice) -> SysidSpec:
        chosen = choice.options
        assert isinstance(chosen, SysidOptions)
        cls.step(choice)  # refuses one that does not fit
        reach = choice.filter_reach
        return SysidSpec(
            **choice.common,
            # restored inputs lack what is fast: weights by the noise would trust them most where they say least
            method=chosen.method or ("differences" if reach else "weak"),
            filter_reach=reach,
            max_iterations=chosen.max_iterations,
            step=cls.step_name(choice),
            solver=choice.integrator.settings,
        )


def model_kind(name: str) -> type[ModelKind]:
    """A kind of model: a key of `MODELS`, or `module:Class` of the user's own; a ConfigError lists the choices."""
    if name not in MODELS and ":" not in name:
        raise ConfigError(f"`model.kind` must be one of {', '.join(MODELS)}; got {name!r}.")
    home = MODELS[name].home if name in MODELS else name
    return class_by_name(home, {}, ModelKind, kind="kind of model", home="nsde_torch.models")


def model_options(model: str | type[ModelKind] | ModelOptions, **values: Any) -> ModelOptions:
    """What a user chooses of a model, by the name of its kind or the kind itself; options as they are.

    A kind is a key of `MODELS`, `package.module:Class`, or a class that a module defines; `values` are options that are
    not its own defaults. A ConfigError where there is no such kind, or it has no such option.
    """
    if isinstance(model, ModelOptions):
        return model
    if isinstance(model, type):
        model = f"{model.__module__}:{model.__qualname__}"
    if model not in MODELS and ":" not in model:
        raise ConfigError(f"`model` must be one of {', '.join(MODELS)}; got {model!r}.")
    options = model_kind(model).options
    names = {f.name for f in fields(options)}
    unknown = sorted(set(values) - names)
    if unknown:
        known = ", ".join(sorted(names - {"kind"})) or "none"
        raise ConfigError(f"`model={model}` has no option {', '.join(unknown)}; it has: {known}.")
    return options(kind=model, **values)
