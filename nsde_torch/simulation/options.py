"""Settings of interventions."""

from dataclasses import dataclass

from nsde_torch.options import documented, key


@documented
@dataclass(frozen=True)
class ReplayOptions:
    """Interventions that are made of flights."""

    starts: int = key(400, "how many", low=1)
    duration: float = key(1.0, "how long commands of another time are replayed", unit="s", above=0)
    before: float = key(
        0.5,
        "how much of the flight is logged before each start: inputs that lags remember",
        unit="s",
        above=0,
    )
