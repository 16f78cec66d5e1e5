"""`nsde close-loop` from the command line to files; the diagnosis itself is tested where it is."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from nsde_torch.cli.commands.close_loop import ClosedLoop
from nsde_torch.cli.main import main
from nsde_torch.effects import files
from nsde_torch.px4.flight.path import CascadeController
from nsde_torch.px4.simulator import simulated

SHORT = (
    *("plant=quadrotor", "plant.effects=[{linear_drag:{drag:[0.6,0.6,0.2]}}]", "reference=hover"),
    *("reference.duration=1", "logged=1", "flights=1", "out_dir=out"),
)


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Flown by the cascade, which costs little; what the predictive controller would know is listed."""
    known: list[Any] = []

    def cascade(loop: ClosedLoop, effects: list[Any]) -> CascadeController:
        known.append(effects)
        return CascadeController(loop.path)

    monkeypatch.setattr(ClosedLoop, "_controller", cascade)
    return known


def _diagnosed(effects: dict[str, Any]) -> None:
    """A diagnosis as an earlier start of the command left it."""
    folder = Path("out/diagnosis")
    folder.mkdir(parents=True)
    files.write(folder / "effects.yaml", "quadrotor", effects, "found")
    findings = [{"sentence": f"There is {name}."} for name in effects]
    content = {"verdict": "effect_found" if effects else "no_effect", "findings": findings}
    (folder / "diagnosis.json").write_text(json.dumps(content))


def test_flights_before_and_after_are_compared_and_nothing_finished_is_done_again(
    told: list[Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _diagnosed({"motor_lag": {"time_constant": 0.05}, "linear_drag": {"drag": [0.5, 0.5, 0.1]}})
    assert main(["close-loop", *SHORT]) == 0
    printed = capsys.readouterr().out
    assert "The controller is told of: linear_drag." in printed
    assert "better in" in printed
    # a lag is what `delay` stands for
    assert told == [[], [], [{"linear_drag": {"drag": [0.5, 0.5, 0.1]}}]]
    content = json.loads(Path("out/close_loop.json").read_text())
    assert content["told"] == [{"linear_drag": {"drag": [0.5, 0.5, 0.1]}}]
    (pair,) = content["rmse_m"]
    assert 0.0 < pair["before_m"] < 0.2
    assert 0.0 < pair["after_m"] < 0.2
    assert content["ratio"] == pytest.approx(pair["after_m"] / pair["before_m"])
    assert Path("out/close_loop.png").stat().st_size > 1000
    for stage in ("log", "before", "after"):
        assert Path(f"out/{stage}/flight_0.csv").is_file()
        assert Path(f"out/{stage}/flight_0.ulg").is_file()

    def refuse(*arguments: Any, **options: Any) -> None:
        raise AssertionError("flown again")

    monkeypatch.setattr(simulated, "fly_simulated", refuse)
    assert main(["close-loop", *SHORT]) == 0
    assert json.loads(Path("out/close_loop.json").read_text()) == content
    assert main(["close-loop", *SHORT, "seed=1"]) == 2
    assert "holds a closed loop with other settings" in capsys.readouterr().err


def test_where_nothing_is_found_nothing_changes(told: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    _diagnosed({})
    assert main(["close-loop", *SHORT]) == 0
    assert "Nothing is missing" in capsys.readouterr().out
    content = json.loads(Path("out/close_loop.json").read_text())
    assert content["ratio"] == 1.0
    assert not Path("out/after").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["plant=learned"], "plant=hexacopter or plant=quadrotor"),
        (["plant.dt=0.01"], "without plant.dt"),
        (["plant.system=cartpole", "plant.effects=[]"], "multirotor"),
        (["plant.effects=[linear_drg]"], "linear_drag"),
        (["reference.speed=20"], "reference.check=false"),
        (["flights=0"], "`flights` must be at least 1"),
        (["flihgts=2"], "Did you mean `flights`"),
    ],
)
def test_what_cannot_be_flown_is_said_at_once(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["close-loop", "out_dir=out", *words]) == 2
    assert said in capsys.readouterr().err
    assert not Path("out/log").exists()
