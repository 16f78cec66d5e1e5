"""What every kind of model is: a specification, a system, and `sample`."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import KW_ONLY, asdict, dataclass, field
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, TypeGuard

import torch
from torch import Tensor, nn

from nsde_torch.errors import ConfigError, NonFiniteError, ShapeError
from nsde_torch.models.networks import InputFilter
from nsde_torch.options import check
from nsde_torch.shown import data_frame, preformatted
from nsde_torch.systems import System, make_system
from nsde_torch.systems.base import MEMORY_S
from nsde_torch.systems.values import Values

if TYPE_CHECKING:
    from nsde_torch.data import Run, Windows
    from nsde_torch.models.ensemble import GaussianEnsemble
    from nsde_torch.models.identified import IdentifiedModel
    from nsde_torch.models.neural_sde import NeuralSDE
    from nsde_torch.models.prediction import RunPrediction


@dataclass(frozen=True)
class ModelSpec:
    """Everything that is needed to build the same model again; saved beside the weights."""

    kinds: ClassVar[tuple[str, ...]] = ()
    """Names of the kinds that have such a specification, the default first; empty for those of the user's own."""
    options: ClassVar[type | None] = None  # what a user chooses of it, whose ranges hold here too
    filter_reach: ClassVar[int] = 0
    """Taps on each side of the filter that restores smoothed inputs, a field of those that have one; 0 for none."""

    system: str  # name of the system
    _: KW_ONLY
    kind: str = ""  # of the model; empty for the default
    dt: float  # step that it was trained with [s]
    horizon: int  # training window [steps]
    effects: tuple[str, ...] = ()  # effects beyond the declared ones
    declared: tuple[str, ...] | None = None  # declared effects, None for the system's own
    system_options: Mapping[str, Any] = field(default_factory=dict)  # further arguments of the system's class

    def __post_init__(self) -> None:
        if not self.kind and self.kinds:
            object.__setattr__(self, "kind", self.kinds[0])
        if ":" not in self.kind and self.kind not in self.kinds:
            raise ConfigError(
                f"{type(self).__name__} is of kind {' or '.join(self.kinds) or 'module:Class'}; got {self.kind!r}."
            )
        if self.options is not None:
            check(self.options, {k: v for k, v in vars(self).items() if k != "kind"}, "model.")

    def as_dict(self) -> dict[str, Any]:
        """Plain containers, for YAML."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items() if k != "_"}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Inverse of `as_dict`; an unknown key is refused."""
        unknown = set(values) - set(cls.__dataclass_fields__)
        if unknown:
            raise ConfigError(
                f"model specification has unknown keys {sorted(map(str, unknown))}; another version wrote it."
            )
        dt, horizon = values.get("dt"), values.get("horizon")
        if not (isinstance(dt, int | float) and dt > 0 and isinstance(horizon, int) and horizon > 0):
            raise ConfigError(
                "model specification must hold `dt` [s] and `horizon` [steps] above 0; "
                f"got {dt!r} and {horizon!r}."
            )
        plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**plain)

    def make_system(self, values: Values | None = None) -> System:
        """The system, with initial values of declared parameters."""
        return make_system(
            self.system, effects=self.effects, declared=self.declared, values=values, **self.system_options
        )


@dataclass(frozen=True, kw_only=True)
class Capabilities:
    """What a model can do beside predicting trajectories."""

    has_physics: bool = False
    """Declared physics with fitted parameters is its drift, or part of it: residuals of one step are reported, and it
    can be planned with. It has a `step`."""
    is_equation: bool = False
    """It is an equation dz = f dt + sigma dW with a learned part, and has all that `NeuralSDE` has."""
    is_stochastic: bool = False
    """That equation has a diffusion: it is calibrated, and its distance from the data is drawn."""
    learns_sensors: bool = False  # it has learned the noise of the sensors, and has a `measurement_std`
    knows_feedback: bool = False
    """It has learned the controller of its training runs; its `sample` takes `replayed`."""
    propagation: str | None = None
    """How particles take to the members of an ensemble; None for a model without members."""


class Model(nn.Module, ABC):
    """A learned model of a system.

    What it can do beside `sample` it says in `capabilities`; the rest of the package asks these, never for a class.
    """

    spec: ModelSpec  # what it was built from
    system: System  # the machine; `system.error` and `system.error_groups` say what an error is
    clock_scale: Tensor  # physical seconds per logged second of the training data, 0-d
    filter: InputFilter | None  # restores inputs that the log smoothed; None where it did not
    metrics: Mapping[str, Any] = {}
    """What `metrics.json` of its run directory holds; empty if it was not trained."""
    folder: Path | None = None  # its run directory; None without one

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("clock_scale", torch.ones(()))

    @abstractmethod
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
        """Sample predicted trajectories.

        Args:
            x0: Measured first states (B, nx).
            u: Inputs (B, T, nu); u[:, k] holds from k dt to (k + 1) dt.
            dt: Step [s] on the clock of the training data.
            particles: Paths per row.
            generator: Source of all randomness.
            measurement: Whether to predict measurements: add the learned sensor noise to the start and to
                every later state. False starts exactly at x0 and predicts the state itself.
            measurement_std: Standard deviation of other sensors than those of the training data (nx,).
            applied: True if `u` is what acted on the machine; False if it is as logged in the training data,
                in which case a smoothed log is restored first.
            compile: Compile the step; pays for many or repeated rows.
            t0: Time of the first state [s], one number or (B,).
            u_before: Inputs held during the K steps of `dt` just before the start (B, K, nu), oldest first, logged or
                applied as `u` is. Lags and delays then begin where the log had them: their memory is stationary under
                the first of these inputs, and the state is held at x0 while it moves, which is assumed. None: memory
                is stationary under u[:, 0].

        Returns:
            States (particles, B, T + 1, nx); the first is x0, projected (a quaternion is normalised). A ShapeError
            refuses wrong axes or columns; a NonFiniteError x0 or u, or a path, that is not finite.
        """

    def predict(
        self,
        run: "Run",
        *,
        horizon: float,
        level: float = 0.9,
        particles: int = 199,
        seed: int = 0,
        inputs: Literal["logged", "replayed", "set"] = "logged",
    ) -> "RunPrediction":
        """Predict a run piece by piece, each from a measured state and under the logged inputs.

        Args:
            run: A run of the model's system, such as `nsde_torch.read(...)[0]`.
            horizon: Length of a piece [s], rounded to whole steps of the model.
            level: Share of the measurements that the intervals should hold, in (0, 1).
            particles: Paths per piece.
            seed: Seed of the paths.
            inputs: Where the inputs of the run come from. `replayed`: from a controller like that of the training runs,
                so that they tell what disturbed the machine; a model that has learned this controller reads them.
                `set`: from outside, whatever the state was. `logged`: replayed, or set where the run has a column
                `intervention`.

        Returns:
            Medians and intervals beside what was measured, with `coverage`, `plot()` and `to_frame()`. A ConfigError,
            DataError or ShapeError refuses an argument out of range, a run that is too short or of another system; a
            NonFiniteError a path that leaves the finite numbers.
        """
        from nsde_torch.models.prediction import predict

        return predict(self, run, horizon=horizon, level=level, particles=particles, seed=seed, inputs=inputs)

    def to_frame(self) -> Any:
        """A `pandas.DataFrame` of fitted parameters: `name`, `value`, `half_width_90` (None: no interval), `unit`."""
        return data_frame(self._parameter_rows(), ("name", "value", "half_width_90", "unit"))

    def __repr__(self) -> str:
        spec, size = self.spec, sum(parameter.numel() for parameter in self.parameters())
        return f"<Model {spec.kind} of {spec.system}: {size} parameters, steps of {spec.dt:.4g} s>"

    def _repr_html_(self) -> str:
        shown = [
            f"{name} = {value:.4g}{'' if half is None else f' +- {half:.2g}'} {unit}"
            for name, value, half, unit in self._parameter_rows()
        ]
        return preformatted("\n".join([repr(self), *shown]))

    def _parameter_rows(self) -> list[tuple[str, float, float | None, str]]:
        return [
            (name, value, half, p["unit"])
            for name, p in self.metrics.get("parameters", {}).items()
            for value, half in zip(p["value"], p["half_width_90"], strict=True)
        ]

    @property
    def capabilities(self) -> Capabilities:
        """What this model can do beside `sample`."""
        return Capabilities()

    def applied_inputs(self, u: Tensor, dt: float) -> Tensor:
        """Inputs that acted on the machine (B, T, nu), from those logged."""
        if self.filter is None:
            return u
        n = self.system.nu
        restored = self.filter(u[..., :n], dt)
        return torch.cat((restored, u[..., n:]), -1) if u.shape[-1] > n else restored

    def applied_pair(self, u: Tensor, dt: float, u_before: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Inputs (B, T, nu) and those of the steps before (B, K, nu) as they acted; the filter sees both."""
        if self.filter is None or u_before is None:
            return self.applied_inputs(u, dt), u_before
        restored = self.applied_inputs(torch.cat((u_before, u), 1), dt)
        return restored[:, u_before.shape[1] :], restored[:, : u_before.shape[1]]

    def project(self, z: Tensor) -> Tensor:
        """The nearest valid state."""
        return self.system.project(z)

    def checked(
        self, x0: Tensor, u: Tensor, particles: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """The arguments of `sample`, refused if they do not fit; x0 projected, both on the model's device and type."""
        s = self.system
        for name, given in (("x0", x0), ("u", u)):
            _check_real(name, given, "torch.Tensor")
        if x0.ndim != 2 or x0.shape[1] != s.nx:
            raise ShapeError(f"`x0` must be (batch, nx={s.nx}); got {tuple(x0.shape)}.")
        self._check_inputs("u", u, x0, "horizon", "a horizon axis", "a horizon of 0")
        for name, given in (("x0", x0), ("u", u)):
            _check_finite(name, given)
        if s.quaternion is not None:
            norm = x0[:, s.quaternion].norm(dim=1)
            far = (norm - 1).abs() > 0.05
            if bool(far.any()):
                rows = far.nonzero()[:5, 0].tolist()
                raise ShapeError(
                    f"`x0` must hold unit quaternions (w, x, y, z) in columns {s.quaternion.start} to "
                    f"{s.quaternion.stop - 1}; rows {rows} have norm {float(norm[far][0]):.3g}. Normalise them."
                )
        if not isinstance(generator, torch.Generator):
            raise ConfigError(f"`generator` must be a torch.Generator; got {generator!r}.")
        if isinstance(particles, bool) or not isinstance(particles, int) or particles < 1:
            raise ConfigError(f"`particles` must be a whole number of at least 1; got {particles!r}.")
        return self.project(x0.to(self.clock_scale)), u.to(self.clock_scale)

    def checked_before(self, u_before: Tensor | None, x0: Tensor) -> Tensor | None:
        """`u_before` of `sample`, refused if it does not fit `x0` (B, nx); on the model's device and type."""
        if u_before is None:
            return None
        _check_real("u_before", u_before, "torch.Tensor or None")
        self._check_inputs(
            "u_before", u_before, x0, "steps", "an axis of steps", "none. Leave it out if nothing is known"
        )
        _check_finite("u_before", u_before)
        return u_before.to(self.clock_scale)

    def _check_inputs(self, name: str, u: Tensor, x0: Tensor, axis: str, hint: str, none: str) -> None:
        width = self.system.nu + len(self.system.exogenous)
        if u.ndim != 3 or u.shape[2] != width:
            add = f" Add {hint}." if u.ndim == 2 else ""
            raise ShapeError(f"`{name}` must be (batch, {axis}, nu={width}); got {tuple(u.shape)}.{add}")
        if u.shape[0] != x0.shape[0]:
            raise ShapeError(f"`x0` has {x0.shape[0]} rows and `{name}` has {u.shape[0]}; they must agree.")
        if u.shape[1] == 0:
            raise ShapeError(f"`{name}` must hold at least one step; got {none}.")


def _check_real(name: str, given: object, wanted: str) -> None:
    if not isinstance(given, Tensor) or given.is_complex():
        raise ShapeError(
            f"`{name}` must be a real {wanted}; got {type(given).__name__}. Use torch.as_tensor."
        )


def _check_finite(name: str, given: Tensor) -> None:
    bad = ~torch.isfinite(given).flatten(1).all(1)
    if bool(bad.any()):
        rows = bad.nonzero()[:5, 0].tolist()
        raise NonFiniteError(f"`{name}` is not finite in rows {rows}. Drop or repair these rows.")


def normal(shape: tuple[int, ...], generator: torch.Generator, like: Tensor) -> Tensor:
    """Standard normal numbers from a generator, of another tensor's type and device."""
    return torch.randn(*shape, generator=generator, device=generator.device, dtype=like.dtype).to(like.device)


# Paths of a model in windows of data, with as many inputs before them as the memory of effects can still hold.


def inputs_before(system: System, windows: "Windows", indices: Tensor) -> Tensor | None:
    """Inputs of the last `MEMORY_S` seconds before windows (B, K, nu), for `u_before` of `Model.sample`.

    Seconds are those of the usual pace, windows of the model's step. None where the system carries no memory: nothing
    would change.
    """
    if system.nz == system.nx:
        return None
    return windows.before(indices, max(1, ceil(MEMORY_S * windows.pace / windows.dt_model - 1e-9)))


def sampled(
    model: Model,
    windows: "Windows",
    indices: Tensor,
    *,
    particles: int,
    generator: torch.Generator,
    **further: Any,
) -> tuple[Tensor, Tensor, Tensor]:
    """Measured states of windows (B, T + 1, nx), sampled ones (P, B, T + 1, nx), and times of the first [s] (B,).

    Windows are of the model's step; `further` is what `Model.sample` takes beside. Inputs are those of a
    controller unless windows begin at interventions; a model that has learned it reads them.
    """
    x, u, t0 = windows.batch(indices)
    replayed = further.pop("replayed", not windows.interventional)
    if model.capabilities.knows_feedback:
        further["replayed"] = replayed
    further = {"dt": model.spec.dt, "t0": t0.to(x.dtype), **further}
    before = inputs_before(model.system, windows, indices)
    paths = model.sample(x[:, 0], u, particles=particles, generator=generator, u_before=before, **further)
    return x, paths, t0


# Questions to a model about what it can do, typed so that the type checker knows what the answer means.


def has_physics(model: Model) -> "TypeGuard[IdentifiedModel | NeuralSDE]":
    """Whether declared physics is the drift of the model, or part of it."""
    return model.capabilities.has_physics


def is_equation(model: Model) -> "TypeGuard[NeuralSDE]":
    """Whether the model is a stochastic equation with a learned part."""
    return model.capabilities.is_equation


def is_stochastic(model: Model) -> "TypeGuard[NeuralSDE]":
    """Whether the model is such an equation with a diffusion, and a distance from the data that scales it."""
    return model.capabilities.is_equation and model.capabilities.is_stochastic


def learns_sensors(model: Model) -> "TypeGuard[NeuralSDE]":
    """Whether the model has a sensor noise of its own."""
    return model.capabilities.learns_sensors


def has_members(model: Model) -> "TypeGuard[GaussianEnsemble]":
    """Whether the model is an ensemble, of whose members a particle follows one."""
    return model.capabilities.propagation is not None
