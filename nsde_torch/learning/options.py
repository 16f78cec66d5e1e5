"""Settings of losses and training."""

from dataclasses import dataclass

from nsde_torch.errors import ConfigError

KINDS = ("innovations", "replay", "paper")
_DECAY = {"innovations": 1e-4, "replay": 0.003, "paper": 0.0}


@dataclass(frozen=True)
class LossOptions:
    """Weights of the losses.

    Args:
        kind: "innovations" (what is new at each step of the log, see `nsde_torch.learning.fit_innovations`), "replay"
            (CRPS of paths under the log's own inputs) or "paper" (squared error of one such path).
        data: Weight of the data loss (supplement: 1).
        gradient: Weight of the zero-gradient loss (supplement: 0.01).
        convexity: Weight of the strong-convexity loss (supplement: 0.01).
        mu: Weight of the reward on large mu; None takes the system's (supplement: 1) for "paper", 0.01 else.
        particles: Paths per window; "replay" takes them in pairs.
        points: States of a batch that the distance losses look at.
        ball_samples: Points drawn in the ball around each.
        ball_radius: Radius of the ball [standard deviations of the features]; None takes the system's.
        far_radius: Largest radius that the distance losses draw up to [standard deviations]; not with "paper".
        residual_decay: Weight of the squared weights of residual networks beside declared physics; None takes 1e-4
            with "innovations" and 0.003 with "replay", whose terms are of another size, and 0 with "paper".
        early: Weight of a step k of the window is k ** -early ("replay").
    """

    kind: str = "innovations"
    data: float = 1.0
    gradient: float = 0.01
    convexity: float = 0.01
    mu: float | None = None
    particles: int = 2
    points: int = 256
    ball_samples: int = 8
    ball_radius: float | None = None
    far_radius: float = 16.0
    residual_decay: float | None = None
    early: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ConfigError(f"`loss.kind` must be one of {', '.join(KINDS)}; got {self.kind!r}.")
        if self.kind == "replay" and (self.particles < 2 or self.particles % 2):
            raise ConfigError(
                "`loss.particles` must be an even number of at least 2 with loss=replay (paths come in pairs of "
                f"mirrored noise); got {self.particles}."
            )

    @property
    def decay(self) -> float:
        """Weight of the squared weights of residual networks."""
        return _DECAY[self.kind] if self.residual_decay is None else self.residual_decay


@dataclass(frozen=True)
class TrainerOptions:
    """Settings of the optimisation.

    Args:
        steps: Largest number of gradient steps.
        batch: Windows per gradient step (supplement: 512); with "innovations" all data are one batch.
        lr: Adam's learning rate at the start (supplement: 0.01).
        lr_end: Learning rate after the decay (supplement: 0.001).
        decay_steps: Steps over which it falls linearly (supplement: 10,000); None takes `steps`.
        patience: Validations without a better score before training stops.
        clip: Largest norm of the gradient, None for no clipping.
        validate_every: Steps between validations.
        checkpoint_every: Steps between checkpoints.
        compile: "auto" and "on" compile the integrator's step, "off" does not.
        polish: Steps at `lr_end` on all windows, the held-out ones included, after early stopping chose the weights;
            not with "innovations".
        calibrate: Scale the diffusion by errors across training runs at the end (not with "paper").
    """

    steps: int = 1000
    batch: int = 512
    lr: float = 0.01
    lr_end: float = 0.001
    decay_steps: int | None = None
    patience: int = 10
    clip: float | None = 10.0
    validate_every: int = 50
    checkpoint_every: int = 100
    compile: str = "auto"
    polish: int = 200
    calibrate: bool = True

    def rate(self, step: int) -> float:
        """Learning rate of a step, counted from 0."""
        share = min(step / max(self.decay_steps or self.steps, 1), 1.0)
        return self.lr + (self.lr_end - self.lr) * share
