"""`nsde close-loop by=link`: what a flight over a link may do to the loop, on vehicles in virtual time."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from nsde_torch.cli import closed_loop, fly_build
from nsde_torch.cli.main import main
from nsde_torch.control.shapes import waypoints
from nsde_torch.design.experiment import write_plan
from nsde_torch.px4.flight.cascade import CascadeController, PathPoints
from nsde_torch.px4.flight.controller import Inline
from nsde_torch.px4.flight.safety import Phase
from nsde_torch.px4.link import connection as links
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot
from nsde_torch.px4.simulator.body import Body
from nsde_torch.px4.simulator.simulated import VirtualLink
from tests.cli.test_close_loop import diagnosis
from tests.helpers.commands import Said

pytestmark = pytest.mark.usefixtures("elsewhere")


LINKED = (
    *("close-loop", "by=link", "plant=quadrotor", "reference=hover", "reference.duration=1", "logged=1"),
    *("flights=1", "experiments=1", "out_dir=out"),
)
NAMES = ["linear_drag", "quadratic_drag"]


class Flights:
    """Vehicles that the loop flew, and what happens to the flight of that number."""

    def __init__(self) -> None:
        self.paths: list[str] = []
        self.vehicle: SimulatedAutopilot | None = None
        self.harm: dict[int, Callable[[Any, SimulatedAutopilot], None]] = {}


@pytest.fixture
def flights(monkeypatch: pytest.MonkeyPatch) -> Flights:
    """Every flight is of a new vehicle in virtual time, by the cascade; a diagnosis is written, not made."""
    made, fly = Flights(), closed_loop.fly_vehicle

    def opened(url: str, **more: Any) -> VirtualLink:
        made.vehicle = SimulatedAutopilot(Body("quadrotor", seed=len(made.paths), latency=0.02), seed=1)
        return VirtualLink(made.vehicle)

    def flown(link: Any, runner: Any, path: PathPoints, **more: Any) -> Any:
        made.paths.append(path.name)
        harm, vehicle = made.harm.get(len(made.paths)), made.vehicle
        assert vehicle is not None

        def watch(flight: Any, now: float) -> None:
            if harm is not None and flight.phase is Phase.TRACK and flight._elapsed > 0.5:
                harm(flight, vehicle)

        return fly(link, runner, path, **more, watch=watch)

    def diagnosed(logs: Path, out: Path, *given: Any, **settings: Any) -> None:
        if not (out / "diagnosis.json").is_file():
            runs = [p.stem for p in sorted(logs.glob("*.csv"))]
            settled: dict[str, Any] = {} if out.parent.name == "out" else {"ties": []}
            diagnosis(out, data={"runs": runs, "clock_scale": 1.0}, **settled)

    monkeypatch.setattr(links, "open_link", opened)
    monkeypatch.setattr(closed_loop, "fly_vehicle", flown)
    monkeypatch.setattr(
        fly_build, "Process", lambda maker, **more: Inline(CascadeController(PathPoints(maker.path)))
    )
    monkeypatch.setattr(closed_loop, "diagnose_logs", diagnosed)
    told = {"speaks_for": "linear_drag", "broken": True, "expected_nats": 8.0, "doubt": None}
    told["nats"] = {"linear_drag": 9.0, "quadratic_drag": -9.0}
    monkeypatch.setattr(closed_loop, "obtained", lambda **given: SimpleNamespace(content=lambda: told))
    return made


def _plan() -> None:
    """A plan for the tie, as an earlier start left it: two metres away in four seconds."""
    place = Path("out/experiment_1")
    place.mkdir(parents=True)
    path = waypoints([[0.0, 0.0, 1.5], [2.0, 0.0, 1.2]], times=[0.0, 4.0])
    rows = [[0.0, 0.0, 0.0, 1.5, 0.0], [4.0, 2.0, 0.0, 1.2, 0.0]]
    write_plan(place / "plan.csv", ("p_x", "p_y", "p_z", "yaw"), torch.tensor(rows).double().numpy())
    expected = [{"if_true": n, "nats": {"mean": 8.0}} for n in NAMES]
    question = {"kind": "tie", "members": [[n] for n in NAMES], "names": NAMES, "parameters": []}
    plan = {"words": ["one way"], "duration_s": path.duration, "largest_share_of_limits": {}}
    design = {"question": question, "expected": expected, "plan": plan, "path_limits": None}
    (place / "design.json").write_text(json.dumps(design))


def _content() -> dict[str, Any]:
    content: dict[str, Any] = json.loads(Path("out/close_loop.json").read_text())
    return content


@pytest.mark.slow
def test_a_stopped_experiment_does_not_count_and_is_flown_again_alone(
    flights: Flights, capsys: pytest.CaptureFixture[str]
) -> None:
    _plan()
    flights.harm[2] = lambda flight, vehicle: flight.stop() if not flight._stop else None
    assert main(LINKED) == 130
    said = capsys.readouterr().err
    assert "experiment 1: the flight was stopped, and landed" in said
    assert f"start the same command again with out_dir={Path('out').resolve()}" in said
    assert flights.paths == ["hover", "plan"]
    # nothing of it is among the logs that are diagnosed
    assert {p.name for p in Path("out/log").iterdir()} == {"flight_0.csv", "flight_0.ulg", "flight_0.json"}
    assert not Path("out/experiment_1/flight.json").exists()
    assert main(LINKED) == 0
    assert flights.paths == ["hover", "plan", "plan", "hover", "hover"]
    assert (Path("out/log/experiment_1.csv")).stat().st_size > 1000
    (entry,) = _content()["experiments"]
    assert entry["flight"]["tracked"]
    assert entry["nats_obtained"] == 9.0
    assert _content()["plant"] is None  # what is at the other end of a link is not known
    assert main(LINKED) == 0
    assert len(flights.paths) == 5


@pytest.mark.parametrize(
    ("harm", "status", "said"),
    [
        (lambda flight, vehicle: vehicle.set_mode(d.LAND), 3, "the mode is LAND"),
        (lambda flight, vehicle: setattr(vehicle, "mute", True), 4, "NOT seen to land"),
    ],
)
@pytest.mark.slow
def test_a_vehicle_that_was_taken_or_lost_is_not_flown_on(
    harm: Any, status: int, said: str, flights: Flights, capsys: pytest.CaptureFixture[str]
) -> None:
    flights.harm[1] = harm
    assert main(LINKED) == status
    error = capsys.readouterr().err
    assert said in error
    assert "log 1: " in error
    assert f"start the same command again with out_dir={Path('out').resolve()}" in error
    assert flights.paths == ["hover"]
    assert not list(Path("out/log").glob("*.csv")) if Path("out/log").is_dir() else True


def test_a_refused_flight_says_why_and_what_to_do(
    flights: Flights, monkeypatch: pytest.MonkeyPatch, refused: Said
) -> None:
    def empty(url: str, **more: Any) -> VirtualLink:
        body = Body("quadrotor", seed=1)
        body.used = 0.95
        flights.vehicle = SimulatedAutopilot(body, seed=1)
        return VirtualLink(flights.vehicle)

    monkeypatch.setattr(links, "open_link", empty)
    said = refused(*LINKED)
    assert "log 1: " in said
    assert "battery" in said
    assert f"with out_dir={Path('out').resolve()}, and it is flown again" in said


@pytest.mark.slow
def test_what_trips_a_limit_counts_as_an_experiment_and_is_flown_again_where_it_is_compared(
    flights: Flights, capsys: pytest.CaptureFixture[str]
) -> None:
    _plan()

    def push(flight: Any, vehicle: Any) -> None:
        if flight._elapsed > 0.6 * flight.path.duration:
            vehicle.body.v = (0.0, 9.0, 0.0)

    flights.harm[2], flights.harm[3] = push, push
    assert main(LINKED) == 0
    assert flights.paths == ["hover", "plan", "hover", "hover"]
    content = _content()
    assert content["experiments"][0]["flight"]["trouble"]["kind"] in ("speed", "jump")
    assert content["ratio"] is None
    assert "before 1 was not flown to its end" in capsys.readouterr().out
    # a limit may be changed, and what was flown to its end is not flown again
    assert main([*LINKED, "limits.speed=8"]) == 0
    assert flights.paths == ["hover", "plan", "hover", "hover", "hover"]
    assert _content()["ratio"] is not None


@pytest.mark.slow
def test_a_plan_that_leans_further_than_a_flight_may_is_not_begun(flights: Flights, refused: Said) -> None:
    _plan()
    said = refused(*LINKED, "limits.tilt=5")
    assert "`limits.tilt=5` ends a flight there" in said
    assert flights.paths == ["hover"]
    # the limit may be another at the next start
    assert main(LINKED) == 0
    assert flights.paths == ["hover", "plan", "hover", "hover"]


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("limits.fence=[[-2,2],[-2,2],[-0.5,6]]", "`experiment.fence` reaches from -3.5 to 3.5 m along x"),
        ("limits.speed=3", "`experiment.speed` is 4 m/s, beyond `limits.speed` of 3 m/s"),
        ("limits.fence=[[1,2]]", "`limits.fence` takes"),
        ("experiment.fence=[[1,2]]", "`experiment.fence` takes"),
    ],
)
def test_experiments_stay_within_what_a_flight_is_ended_by(
    word: str, said: str, flights: Flights, refused: Said
) -> None:
    assert said in refused(*LINKED, word)
    assert not flights.paths
