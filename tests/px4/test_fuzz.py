"""Two seconds of hostile bytes at a flight in virtual time: nothing is believed, nothing breaks, nothing stops."""

from __future__ import annotations

from nsde_torch.control import shapes
from nsde_torch.px4.flight.path import PathPoints
from nsde_torch.px4.flight.phases import Phase
from tests.helpers.fuzzed import hostile
from tests.helpers.px4_world import World

SHORT = PathPoints(shapes.hover(duration=2.5, height=1.0))


def test_a_flight_goes_on_through_hostile_bytes_as_if_there_were_none() -> None:
    calm, world = World(path=SHORT).run(), World(path=SHORT)
    source, bytes_sent = hostile(seed=1), 0

    def attack(w: World) -> None:
        nonlocal bytes_sent
        if w.phase is Phase.TRACK and w.flight._elapsed < 2.0:
            for _ in range(30):  # 3000 datagrams a second
                data = next(source)
                bytes_sent += len(data)
                w.inject(data)

    world.run(attack)
    assert bytes_sent > 100_000
    assert world.flight.outcome.tracked, world.says
    assert world.safe
    assert world.setpoints == calm.setpoints
    assert world.rmse == calm.rmse
    counts = world.endpoint.codec.counts
    assert min(counts[k] for k in ("rubbish", "cut", "foreign", "unwanted")) > 0


def test_the_vehicle_takes_hostile_bytes_as_calmly() -> None:
    world, source = World(path=SHORT), hostile(seed=2, system=9)

    def attack(w: World) -> None:
        if w.phase is Phase.TRACK and w.flight._elapsed < 2.0:
            for _ in range(30):
                w.vehicle.receive(next(source))

    world.run(attack)
    assert world.safe
