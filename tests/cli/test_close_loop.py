"""`nsde close-loop` from the command line to files; the diagnosis itself is tested where it is."""

import json
from pathlib import Path
from typing import Any

import pytest

from nsde_torch.cli import closed_loop
from nsde_torch.cli.closed_loop import VirtualVehicle
from nsde_torch.cli.main import main
from nsde_torch.control.reference import FlightPath
from nsde_torch.design import designing
from nsde_torch.effects import files
from nsde_torch.px4.flight.cascade import CascadeController, PathPoints
from tests.helpers.commands import Said

pytestmark = pytest.mark.usefixtures("elsewhere")


SHORT = (
    *("plant=quadrotor", "plant.effects=[{linear_drag:{drag:[0.6,0.6,0.2]}}]", "reference=hover"),
    *("reference.duration=1", "logged=1", "flights=1", "out_dir=out"),
)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Flown by the cascade, which costs little; what the predictive controller would know is listed."""
    known: list[Any] = []

    def cascade(vehicle: VirtualVehicle, path: FlightPath, effects: list[Any]) -> CascadeController:
        known.append(effects)
        return CascadeController(PathPoints(path))

    monkeypatch.setattr(VirtualVehicle, "_controller", cascade)
    return known


DRAG = {"linear_drag": {"drag": [0.5, 0.5, 0.1]}}


def diagnosis(folder: Path = Path("out/diagnosis"), effects: dict[str, Any] = DRAG, **changed: Any) -> None:
    """A diagnosis of the hovering flight as an earlier start left it, which says which drag cannot be told."""
    folder.mkdir(parents=True, exist_ok=True)
    files.write(folder / "effects.yaml", "quadrotor", effects, "found")
    content: dict[str, Any] = {
        "verdict": "effect_found",
        "findings": [
            {"name": n, "kind": "effect", "sentence": f"There is {n}.", "lead": False} for n in effects
        ],
        "ties": [{"effects": ["linear_drag", "quadratic_drag"], "experiment": ""}],
        "data": {"runs": ["flight_0"], "clock_scale": 1.0},
        **{"not_shown": [], "ranking": [], "parameters": {}, "warnings": []},
    }
    (folder / "diagnosis.json").write_text(json.dumps(content | changed))


def test_flights_before_and_after_are_compared_and_nothing_finished_is_done_again(
    told: list[Any], monkeypatch: pytest.MonkeyPatch, refused: Said, shown: Said
) -> None:
    diagnosis(effects={"motor_lag": {"time_constant": 0.05}, **DRAG})
    printed = shown("close-loop", *SHORT)
    assert "The controller now has: linear_drag." in printed
    assert "better in" in printed
    # a lag is what `delay` stands for
    assert told == [[], [], [DRAG]]
    content = json.loads(Path("out/close_loop.json").read_text())
    assert content["told"] == [DRAG]
    (pair,) = content["rmse_m"]
    assert 0.0 < pair["before_m"] < 0.2
    assert 0.0 < pair["after_m"] < 0.2
    assert content["ratio"] == pytest.approx(pair["after_m"] / pair["before_m"])
    assert Path("out/close_loop.png").is_file()
    for stage in ("log", "before", "after"):
        assert Path(f"out/{stage}/flight_0.csv").is_file()
        assert Path(f"out/{stage}/flight_0.ulg").is_file()

    def refuse(*arguments: Any, **options: Any) -> None:
        raise AssertionError("flown again")

    monkeypatch.setattr(closed_loop, "fly_simulated", refuse)
    assert main(["close-loop", *SHORT]) == 0
    assert json.loads(Path("out/close_loop.json").read_text()) == content
    assert "holds a closed loop with other settings" in refused("close-loop", *SHORT, "seed=1")


TIED = (
    *(*SHORT, "candidates=[linear_drag,quadratic_drag]", "experiments=1", "experiment.duration=4"),
    *("experiment.samples=1", "experiment.proposals=4", "experiment.generations=0"),
    *("experiment.rehearsals=2", "experiment.baselines=false"),
)


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is chosen is rehearsed no more often than what it is chosen of: each rehearsal fits every member."""
    monkeypatch.setattr(designing, "CONFIRMED", 1)


@pytest.mark.usefixtures("few")
@pytest.mark.slow
def test_a_tie_is_asked_of_an_experiment_and_the_record_has_nats_expected_and_obtained(
    told: list[Any], monkeypatch: pytest.MonkeyPatch, shown: Said
) -> None:
    diagnosis()

    def settled(logs: Path, out: Path, *arguments: Any, **options: Any) -> None:
        """The diagnosis of all logs, which takes longer than all else: no tie is left."""
        if not out.exists():
            diagnosis(out, ties=[], data={"runs": sorted(log.stem for log in logs.glob("*.csv"))})

    monkeypatch.setattr(closed_loop, "diagnose_logs", settled)
    monkeypatch.setattr(designing, "FINALISTS", 1)
    tied = [*TIED, "seed=2"]
    printed = shown("close-loop", *tied)
    assert "experiment 1: which is true, linear_drag or quadratic_drag?" in printed
    content = json.loads(Path("out/close_loop.json").read_text())
    (entry,) = content["experiments"]
    assert entry["question"]["members"] == [["linear_drag"], ["quadratic_drag"]]
    assert set(entry["expected_nats"]) == {"linear_drag", "quadratic_drag"}
    assert entry["obtained"]["speaks_for"] in entry["expected_nats"]
    assert entry["nats_obtained"] == max(entry["obtained"]["nats"].values())
    assert entry["before"]["tied"] == [["linear_drag", "quadratic_drag"]]
    assert entry["flight"]["tracked"]
    assert entry["after"]["tied"] == []
    assert content["stopped"]["kind"] == "settled"
    diagnosed = json.loads(Path("out/experiment_1/diagnosis/diagnosis.json").read_text())
    assert diagnosed["data"]["runs"] == ["experiment_1", "flight_0"]
    fence = json.loads(Path("out/experiment_1/design.json").read_text())["limits"]
    assert fence["p_z"] == {"low": 0.4, "high": 4.0, "unit": "m", "from": "given"}

    def refuse(*arguments: Any, **options: Any) -> None:
        raise AssertionError("done again")

    # started again it does nothing anew, and by hand it would ask for the next log
    for name in ("design", "obtained"):
        monkeypatch.setattr(closed_loop, name, refuse)
    monkeypatch.setattr(closed_loop, "fly_simulated", refuse)
    assert main(["close-loop", *tied]) == 0
    assert json.loads(Path("out/close_loop.json").read_text()) == content


@pytest.mark.usefixtures("few")
@pytest.mark.slow
def test_by_hand_it_says_what_to_fly_and_goes_on_with_the_log(refused: Said, shown: Said) -> None:
    hand = [*TIED, "by=hand", "experiment.least_nats=0"]
    assert "out/log (CSV or ULog)" in shown("close-loop", *hand)
    machine = ["simulate", "system=quadrotor", "plant.effects=[{linear_drag:{drag:[0.6,0.6,0.2]}}]"]
    assert main([*machine, "durations=[10]", "seed=3", "out=flown"]) == 0
    (log,) = Path("flown").glob("*.csv")
    log.rename("out/log/flight_0.csv")
    drag = {"value": 0.5, "interval_90": [0.0, 1.0], "unit": "1/s"}
    diagnosis(ties=[], parameters={"linear_drag.drag[0]": drag})
    assert "as experiment_1.csv or experiment_1.ulg" in shown("close-loop", *hand)
    content = json.loads(Path("out/close_loop.json").read_text())
    assert content["stopped"]["kind"] == "waiting"
    assert content["rmse_m"] == []
    assert Path("out/experiment_1/plan.csv").read_text().startswith("t,p_x,p_y,p_z,yaw\n")
    assert main([*machine, "pilot=plan", "plan=out/experiment_1", "seed=4", "out=plan_flown"]) == 0
    (log,) = Path("plan_flown").glob("*.csv")
    Path("out/log/experiment_1.ulg").write_text("")
    assert "logs of several kinds (.csv, .ulg)" in refused("close-loop", *hand)
    Path("out/log/experiment_1.ulg").unlink()
    # of a log that is not of this machine it is said, by name, and another may be put in
    Path("out/log/experiment_1.csv").write_text("\n".join(_turned(log.read_text().splitlines())) + "\n")
    assert main(["close-loop", *hand]) == 0
    content = json.loads(Path("out/close_loop.json").read_text())
    assert content["stopped"]["kind"] == "other_machine"
    assert "the log of experiment_1 is not of this machine" in content["stopped"]["sentence"]
    assert not Path("out/experiment_1/obtained.json").exists()


def _turned(lines: list[str]) -> list[str]:
    """A log of a machine whose motors are numbered in another order."""
    names = lines[0].split(",")
    motors = [k for k, name in enumerate(names) if name.startswith("u_")]
    taken = dict(zip(motors, [*motors[1:], motors[0]], strict=True))
    rows = [line.split(",") for line in lines[1:]]
    return [lines[0], *(",".join(row[taken.get(k, k)] for k in range(len(row))) for row in rows)]
