"""Settings of losses and training."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

from nsde_torch.errors import ConfigError
from nsde_torch.options import check, documented, key
from nsde_torch.systems.options import SystemOptions

T = TypeVar("T")

_DECAY = {"innovations": 1e-4, "replay": 0.003, "paper": 0.0}


@documented
@dataclass(frozen=True)
class LossOptions:
    """Kind, weights and sizes of the losses (supplement: weights 1, 0.01, 0.01 and 1).

    The kinds: "innovations" (what is new at each step of the log, see `nsde_torch.training.fit_innovations`), "replay"
    (CRPS of paths under the log's own inputs), "paper" (squared error of one such path).
    """

    kind: str = key(
        "innovations", "kind of the loss, set by loss=", choices=("innovations", "replay", "paper")
    )
    data: float = key(1.0, "weight of the data loss", low=0)
    gradient: float = key(0.01, "weight of the zero-gradient loss (eta flat on the data)", low=0)
    convexity: float = key(0.01, "weight of the strong-convexity loss in a ball around the data", low=0)
    mu: float | None = key(
        None, "weight of the reward on large mu; null: system.lambda_mu with loss=paper, else 0.01", low=0
    )
    particles: int = key(2, "paths per window (loss=replay takes them in pairs, loss=paper)", low=1)
    points: int = key(256, "states of a batch that the distance losses look at", low=1)
    ball_samples: int = key(8, "points drawn in the ball around each", low=1)
    ball_radius: float | None = key(
        None, "radius of the ball; null: the system's own", unit="std of the features", above=0
    )
    far_radius: float = key(
        16.0,
        "largest radius that the distance losses draw up to; not with loss=paper",
        unit="std of the features",
        above=0,
    )
    residual_decay: float | None = key(
        None,
        "weight of the squared weights of residual networks beside declared physics; null: 1e-4, 0.003 with "
        "loss=replay, 0 with loss=paper",
        low=0,
    )
    early: float = key(1.0, "step k of a window weighs k^-early (loss=replay)", low=0)

    def __post_init__(self) -> None:
        check(type(self), vars(self), "loss.")
        if self.kind == "replay" and (self.particles < 2 or self.particles % 2):
            raise ConfigError(
                "`loss.particles` must be an even number of at least 2 with loss=replay (paths come in pairs of "
                f"mirrored noise); got {self.particles}."
            )

    @property
    def decay(self) -> float:
        """Weight of the squared weights of residual networks."""
        return _DECAY[self.kind] if self.residual_decay is None else self.residual_decay


@documented
@dataclass(frozen=True)
class TrainerOptions:
    """Optimisation with Adam (supplement: batch 512, rate 0.01 to 0.001 over 10,000 steps).

    With loss="innovations" steps and lr are those of the distance, the rest is least squares; the step is compiled with
    compile="on" alone, because too little is sampled to pay for it.
    """

    steps: int = key(1000, "largest number of gradient steps", unit="steps", low=1)
    batch: int = key(512, "windows per gradient step", low=1)
    lr: float = key(0.01, "learning rate at the start", above=0)
    lr_end: float = key(0.001, "learning rate after the decay", above=0)
    decay_steps: int | None = key(
        None, "steps over which the learning rate falls linearly; null: trainer.steps", unit="steps", low=1
    )
    patience: int = key(10, "validations without a better score before training stops", low=1)
    clip: float | None = key(10.0, "largest norm of the gradient; null: no clipping", above=0)
    validate_every: int = key(50, "steps between validations", unit="steps", low=1)
    checkpoint_every: int = key(100, "steps between checkpoints", unit="steps", low=1)
    compile: str = key(
        "auto", "compile the step (auto: where a C++ compiler is found)", choices=("auto", "on", "off")
    )
    polish: int = key(
        200, "last steps at lr_end on all windows, the validation ones included", unit="steps", low=0
    )
    calibrate: bool = key(True, "scale the diffusion by errors across training runs (not with loss=paper)")

    def __post_init__(self) -> None:
        check(type(self), vars(self), "trainer.")

    def rate(self, step: int) -> float:
        """Learning rate of a step, counted from 0."""
        share = min(step / max(self.decay_steps or self.steps, 1), 1.0)
        return self.lr + (self.lr_end - self.lr) * share


LOSSES: dict[str, LossOptions] = {
    "innovations": LossOptions(),
    "replay": LossOptions(kind="replay"),
    "paper": LossOptions(kind="paper", particles=1),
}
"""Losses by name; "paper" has the supplement's single path."""

TRAINERS: dict[str, TrainerOptions] = {
    "default": TrainerOptions(),
    "fast": TrainerOptions(steps=60, batch=64, validate_every=20, checkpoint_every=20, polish=20),
    "paper": TrainerOptions(steps=10_000, decay_steps=10_000, polish=0),
}
"""Optimisations by name: a good model in minutes, a look in seconds, the supplement's."""


def named_options(argument: str, given: str | T, known: Mapping[str, T]) -> T:
    """A loss or an optimisation by its name, options as they are; ConfigError for no such name."""
    kind = type(next(iter(known.values())))
    if isinstance(given, kind):
        return given
    if given not in known:
        raise ConfigError(
            f"`{argument}` must be one of {', '.join(known)}, or {kind.__name__}; got {given!r}."
        )
    return known[str(given)]


def machine_losses(losses: LossOptions, system: SystemOptions) -> LossOptions:
    """Losses with the constants that the user gave for the machine, where the losses leave them open."""
    mu = system.lambda_mu if losses.mu is None else losses.mu
    radius = system.ball_radius if losses.ball_radius is None else losses.ball_radius
    return replace(losses, mu=mu, ball_radius=radius)
