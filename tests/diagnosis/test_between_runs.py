"""What differs between runs is named with its runs and its sizes; runs of one machine are not said to differ."""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data import DataSet, Run
from nsde_torch.diagnosis.text import lines, short_lines
from nsde_torch.errors import ConfigError
from nsde_torch.recording import assemble
from nsde_torch.simulation.generate import simulate
from nsde_torch.systems import make_system

HOME = "double_pendulum:DoublePendulum"


@pytest.fixture(scope="module")
def folder(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(root / "examples" / "double_pendulum")
        maker = importlib.import_module("make_data")
        out = tmp_path_factory.mktemp("zeros")
        push = maker.friction(np.array([0.02, 0.01]), np.zeros(2))
        maker.write(out, push, seed=21, runs=4, seconds=8.0)
    return out


@pytest.fixture(autouse=True)
def _importable(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(root / "examples" / "double_pendulum")


def off(data: DataSet, column: int, by: Mapping[str, float]) -> DataSet:
    """Runs in some of which a state reads too much."""
    out = []
    for run in data.runs:
        x = run.x.copy()
        x[:, column] += by.get(run.name, 0.0)
        out.append(replace(run, x=x))
    return replace(data, runs=tuple(out))


def springs(seed: int, *each: dict[str, float], effects: Sequence[Any] = ()) -> DataSet:
    """Runs of one spring with other values in each."""
    runs: list[Run] = []
    for r, values in enumerate(each):
        how = {
            "durations": [12.0] * len(each),
            "parameters": values,
            "effects": effects[r] if effects else [],
        }
        made = simulate("mass_spring_damper", seed=seed, **how)
        runs.append(made.runs[r])
    return assemble(runs, make_system("mass_spring_damper"), kind="simulated")


def diagnosed(
    data: DataSet, effects: Sequence[str] = (), system: str = "mass_spring_damper"
) -> dict[str, Any]:
    found = nsde_torch.diagnose(data, system=system, effects=list(effects), say=False)
    return dict(found.content())


def sizes(content: dict[str, Any], effect: str) -> dict[str, tuple[float, float, float]]:
    """Value and interval of an effect in each run."""
    own = [p for name, p in content["parameters"].items() if name.startswith(f"{effect}.")]
    return {p["run"]: (p["value"], *p["interval_90"]) for p in own}


@pytest.mark.slow
def test_another_load_in_one_run_is_a_mass_that_differs_in_that_run() -> None:
    value = {"force_gain": 1.0, "linear_spring.stiffness": 4.0, "viscous_friction.damping": 0.5}
    loaded = {name: v / 1.3 for name, v in value.items()}
    content = diagnosed(springs(3, value, value, loaded, value))
    assert (content["verdict"], content["added"]) == ("effect_found", ["run_difference[mass]"])
    found = sizes(content, "run_difference[mass]")
    against = {p["against"] for p in content["parameters"].values()}
    assert len(against) == 1
    assert against < {"run_0", "run_1", "run_3"}
    assert found["run_2"][0] == pytest.approx(0.3, abs=0.02)
    assert found["run_2"][1] < 0.3 < found["run_2"][2]
    assert all(abs(v) < 0.02 for run, (v, _, _) in found.items() if run != "run_2")
    said = "\n".join(short_lines(content))  # type: ignore[arg-type]
    assert f"change against {against.pop()}: run_" in said
    assert not content["warnings"]


@pytest.mark.slow
def test_a_spring_that_differs_beside_a_friction_of_all_runs() -> None:
    each = [{"linear_spring.stiffness": k} for k in (4.0, 4.6, 3.5, 4.2)]
    dry = [{"coulomb_friction": {"size": 0.15, "width": 0.01}}]
    content = diagnosed(springs(5, *each, effects=[dry] * 4))
    assert set(content["added"]) == {"coulomb_friction", "run_difference[linear_spring/stiffness]"}
    found = sizes(content, "run_difference[linear_spring/stiffness]")
    reference = next(p["against"] for p in content["parameters"].values() if p.get("against"))
    zero = each[int(reference[-1])]["linear_spring.stiffness"]
    for run, (value, _, _) in found.items():
        assert value == pytest.approx(each[int(run[-1])]["linear_spring.stiffness"] - zero, abs=0.06)
    assert content["parameters"]["coulomb_friction.size"]["value"] == pytest.approx(0.15, abs=0.02)


@pytest.mark.slow
def test_on_a_linear_spring_a_zero_is_a_force_of_each_run() -> None:
    data = off(springs(4, *[{}] * 4), 0, {"run_2": 0.1})
    content = diagnosed(data)
    assert content["added"] == ["run_force"]
    values = {run: value for run, (value, _, _) in sizes(content, "run_force").items()}
    others = float(np.median(list(values.values())))
    stiffness = content["declared_parameters"]["linear_spring.stiffness"]["value"]
    assert values["run_2"] - others == pytest.approx(0.1 * stiffness, rel=0.15)


@pytest.mark.slow
def test_runs_of_one_machine_are_not_said_to_differ() -> None:
    content = diagnosed(springs(6, *[{}] * 4))
    assert (content["verdict"], content["added"]) == ("no_effect", [])


@pytest.mark.slow
@pytest.mark.parametrize(("state", "column"), [("q1", 0), ("q2", 1)])
def test_a_zero_of_a_joint_that_differs_has_its_runs_and_the_option_that_takes_it_out(
    state: str, column: int, folder: Path
) -> None:
    data = off(nsde_torch.read(folder, system=HOME), column, {"run_1": 0.12, "run_3": -0.08})
    content = diagnosed(data, ["coulomb_friction[q1]", "coulomb_friction[q2]"], HOME)
    assert content["added"] == [f"run_zero[{state}]"]
    found = sizes(content, f"run_zero[{state}]")
    middle = found["run_2"][0]  # no stretch of run_0 is long enough without the rows at standstill
    assert found["run_1"][0] - middle == pytest.approx(0.12, abs=0.02)
    assert found["run_3"][0] - middle == pytest.approx(-0.08, abs=0.02)
    (finding,) = content["findings"]
    assert finding["take_out"].startswith("data.sensor_bias={run_")
    assert any("to take it out: data.sensor_bias" in line for line in lines(content))  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_reader_takes_out_what_one_run_reads_too_much(folder: Path) -> None:
    plain = nsde_torch.read(folder, system=HOME)
    data = nsde_torch.read(
        folder, system=HOME, options={"sensor_bias": {"run_1": {"q1": 0.12, "q2": 0.02}, "q2": 0.01}}
    )
    for before, after in zip(plain.runs, data.runs, strict=True):
        assert np.allclose(before.x[:, 0] - after.x[:, 0], 0.12 if before.name == "run_1" else 0.0)
        # what holds in all runs, and what is said of this one
        assert np.allclose(before.x[:, 1] - after.x[:, 1], 0.03 if before.name == "run_1" else 0.01)


def test_a_run_that_is_not_there_is_refused(folder: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"`sensor_bias` names 'run_9', which is no run; runs are run_0, run_1"
    ):
        nsde_torch.read(folder, system=HOME, options={"sensor_bias": {"run_9": {"q1": 0.12}}})
