"""`nsde land`: land a vehicle that is in the air, whoever flew it there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..hydra_command import HydraCommand
from ..keys import group
from ..schemas.control import LinkConfig

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from ..jobs import Job


@dataclass
class LandConfig:
    """`nsde land`."""

    link: LinkConfig = group(LinkConfig, "how the vehicle is reached")


COMMAND = HydraCommand(
    name="land",
    help="Land a PX4 vehicle that is in the air, and watch until it is disarmed",
    schema=LandConfig,
    module=__name__,
    groups={"link": "default"},
)


def run(config: DictConfig, job: Job) -> None:
    """Land it; LinkError where no vehicle is heard or armed, EndedError where it was not seen to land."""
    from nsde_torch.px4.flight.flying import land
    from nsde_torch.px4.link.connection import open_link

    from .. import link_build
    from ..link_build import check_end

    key = link_build.key(config.link)
    with open_link(config.link.url, expose=config.link.expose, target=config.link.system, key=key) as link:
        outcome = land(link, say=link_build.say)
    check_end(outcome)
    link_build.say("landed and disarmed")
