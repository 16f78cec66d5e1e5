"""Settings of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass

from nsde_torch.diagnosis.decisions import DECISIONS, Decisions
from nsde_torch.errors import ConfigError
from nsde_torch.options import check, documented, key


@documented
@dataclass(frozen=True)
class Options:
    """Settings of a diagnosis."""

    alpha: float = key(DECISIONS.alpha, "chance of naming anything where nothing is missing", above=0)
    max_effects: int = key(DECISIONS.most_effects, "most effects to add", low=0)
    candidates: tuple[str, ...] | None = key(
        None, "effects to try, by name; null: all that the system may have"
    )
    also: tuple[str, ...] = key((), "effects of your own to try beside them, `module:Class`")
    seed: int = key(0, "seed of the resamples", low=0)
    max_minutes: float | None = key(
        None,
        "time after which the diagnosis ends with what is known; null: none. Training does not count",
        unit="min",
        above=0,
    )
    instruments: tuple[str, ...] = key(
        (), "logged columns that nothing inside the control loop moves: sticks, setpoints"
    )

    @property
    def decisions(self) -> Decisions:
        """What a diagnosis with these settings decides by."""
        return Decisions(alpha=self.alpha, most_effects=self.max_effects)

    def __post_init__(self) -> None:
        check(type(self), vars(self))
        if not 0 < self.alpha <= 0.5:
            raise ConfigError(f"`alpha` must lie in (0, 0.5]; got {self.alpha!r}.")
