"""What a user chooses of a model; null leaves it to what the system and the data ask for (`models.kind`)."""

from dataclasses import dataclass
from typing import ClassVar

from nsde_torch.options import REQUIRED, Checked, documented, key

_LAG = "learn a lag or a delay of the inputs where the data show one that is not declared (loss=default)"
_FEEDBACK = (
    "learn how logged inputs answer the state, which predictions under such inputs read (loss=default)"
)
_FILTER = "taps on each side of the learned input filter; null: as the log's smoothing asks"


@dataclass(frozen=True)
class ModelOptions(Checked):
    """What every kind of model has."""

    home: ClassVar[str] = ""  # where the kind of the package lies whose options these are, `module:Class`

    kind: str = key(REQUIRED, "kind of the model, set by model=")


@documented
@dataclass(frozen=True)
class NodeOptions(ModelOptions):
    """Neural ODE: the same drift, no diffusion."""

    home = "nsde_torch.models.kind:NeuralODEKind"

    kind: str = key("node", "kind of the model, set by model=", choices=("node",))
    residual_hidden: tuple[int, ...] = key((8, 16), "widths of the residual networks (tanh)", low=1)
    filter_reach: int | None = key(None, _FILTER, low=0)
    learn_lag: bool = key(True, _LAG)


@dataclass(frozen=True)
class DiffusionOptions(ModelOptions):
    """What every neural SDE has."""

    distance_hidden: tuple[int, ...] = key((32, 32), "widths of the distance network eta (swish)", low=1)
    mu_hidden: tuple[int, ...] = key((8, 8), "widths of the strong-convexity network mu (tanh)", low=1)
    sigma: str | None = key(
        None,
        "sigma_max is learned or the system's; null: declared with loss=paper, else learned",
        choices=("learned", "declared"),
    )
    filter_reach: int | None = key(None, _FILTER, low=0)
    measurement: bool | None = key(
        None,
        "learn the sensor noise beside the diffusion; null: with loss=default yes, else as the system asks",
    )


@documented
@dataclass(frozen=True)
class NsdeOptions(DiffusionOptions):
    """Neural SDE: declared physics, residual networks, distance-aware diffusion."""

    home = "nsde_torch.models.kind:NeuralSDEKind"

    kind: str = key("nsde", "kind of the model, set by model=", choices=("nsde",))
    residual_hidden: tuple[int, ...] = key((8, 16), "widths of the residual networks (tanh)", low=1)
    disturbance: bool | None = key(
        None, "carry lasting disturbances (gusts) as states; null: as the system asks"
    )
    learn_lag: bool = key(True, _LAG)
    learn_feedback: bool = key(True, _FEEDBACK)


@documented
@dataclass(frozen=True)
class BlackboxOptions(DiffusionOptions):
    """Neural SDE without physics: a network of state and input is the whole drift."""

    home = "nsde_torch.models.kind:BlackboxKind"

    kind: str = key("blackbox_nsde", "kind of the model, set by model=", choices=("blackbox_nsde",))
    drift_hidden: tuple[int, ...] = key((64, 64), "widths of the drift network (tanh)", low=1)


@documented
@dataclass(frozen=True)
class EnsembleOptions(ModelOptions):
    """Gaussian ensemble: networks that predict mean and variance of the next state."""

    home = "nsde_torch.models.kind:EnsembleKind"

    kind: str = key(
        "ensemble",
        "kind of the model, set by model=; it has no physics, no path loss and no integrator: loss=, solver=, "
        "system.parameters, trainer.batch, trainer.polish, trainer.compile and trainer.calibrate do not apply",
        choices=("ensemble",),
    )
    members: int = key(5, "networks in the ensemble", low=1)
    hidden: tuple[int, ...] = key((64, 64), "widths of each network (silu)", low=1)
    batch: int = key(32, "pairs of states per network and gradient step", low=1)
    steps: int | None = key(
        None,
        "largest number of gradient steps; null: 10 trainer.steps, as batches are small. trainer.patience is "
        "stretched alike",
        unit="steps",
        low=1,
    )
    propagation: str = key(
        "fixed",
        "a sampled path keeps the network it drew at the start (fixed, TS-infinity) or draws one at every step "
        "(redrawn, TS-1)",
        choices=("fixed", "redrawn"),
    )


@documented
@dataclass(frozen=True)
class SysidOptions(ModelOptions):
    """Least-squares system identification: the declared physics and nothing else, in seconds."""

    home = "nsde_torch.models.kind:SysidKind"

    kind: str = key(
        "sysid",
        "kind of the model, set by model=; there are no gradient steps: loss=, trainer=, seed and data.validation "
        "do not apply",
        choices=("sysid",),
    )
    method: str | None = key(
        None,
        "equations in integral form, weighted by the noise found (weak), or finite differences of smoothed states in "
        "ordinary least squares (differences); null: weak, and differences where the log smoothed its inputs",
        choices=("weak", "differences"),
    )
    max_iterations: int = key(20, "largest number of least-squares steps", unit="steps", low=1)


MODELS: dict[str, type[ModelOptions]] = {
    "nsde": NsdeOptions,
    "node": NodeOptions,
    "blackbox_nsde": BlackboxOptions,
    "ensemble": EnsembleOptions,
    "sysid": SysidOptions,
}
"""Options of every kind of model of the package: a line here registers one."""
