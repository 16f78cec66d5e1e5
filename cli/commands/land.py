"""`nsde land`: land a PX4 vehicle that is in the air, and watch until it is disarmed."""

from __future__ import annotations

from dataclasses import dataclass

from ..hydra_command import Config, HydraCommand, Job, say
from ..keys import group
from ..schemas import LinkConfig


@dataclass
class LandConfig:
    link: LinkConfig = group(LinkConfig, "how the vehicle is reached")


COMMAND = HydraCommand(name="land", schema=LandConfig, groups={"link": "default"})


def run(config: Config, job: Job) -> None:
    """Land it; LinkError where no vehicle is heard or armed, EndedError where it was not seen to land."""
    from nsde_torch.px4.flight.flying import land

    from .. import fly_build

    with fly_build.connection(config.link)() as link:
        outcome = land(link, say=say)
    fly_build.check_end(outcome)
    print("landed and disarmed")
