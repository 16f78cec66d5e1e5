"""Settings of interventions."""

from dataclasses import dataclass
from math import isfinite

from nsde_torch.errors import ConfigError
from nsde_torch.options import documented, key


@documented
@dataclass(frozen=True)
class Replay:
    """Interventions that are made of flights."""

    starts: int = key(400, "how many", low=1)
    duration: float = key(1.0, "how long commands of another time are replayed", unit="s", above=0)
    before: float = key(
        0.5,
        "how much of the flight is logged before each start: inputs that lags remember",
        unit="s",
        above=0,
    )

    def rows(self, dt: float) -> tuple[int, int]:
        """Samples before the start, and of the replay; a ConfigError where a number is out of range."""
        if isinstance(self.starts, bool) or self.starts < 1:
            raise ConfigError(f"`replay.starts` must be a whole number of 1 or more; got {self.starts!r}.")
        for name, value in (("duration", self.duration), ("before", self.before)):
            if not (isfinite(value) and round(value / dt) >= 1):
                raise ConfigError(f"`replay.{name}` must be a sample of {dt:g} s or longer; got {value!r}.")
        return round(self.before / dt), round(self.duration / dt)
