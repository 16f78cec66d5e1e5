"""`nsde design` from a diagnosis to a plan, from the plan to a flown run, and what that told."""

import json
import shutil
from pathlib import Path

import pytest

from nsde_torch.cli.main import main
from tests.helpers.commands import Said

MEMBERS = "members=[[coulomb_friction,constant_force],[asymmetric_friction]]"
TRUE = "plant.effects=[{coulomb_friction:{size:0.2,width:0.02}},{constant_force:{acceleration:0.06}}]"
FEW = ("samples=2", "proposals=8", "generations=1", "rehearsals=2", "duration=3", "baselines=false")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs and their diagnosis."""
    out = tmp_path_factory.mktemp("design")
    spring = "system=mass_spring_damper"
    assert (
        main(["simulate", spring, TRUE, "durations=[5,5]", "dt=0.05", "seed=3", f"out={out / 'runs'}"]) == 0
    )
    words = ["data=csv", f"data.path={out / 'runs'}", "candidates=[coulomb_friction,asymmetric_friction]"]
    assert main(["diagnose", spring, *words, "retrain=false", f"out_dir={out / 'diagnosis'}"]) == 0
    return out


@pytest.mark.slow
def test_a_diagnosis_that_was_stopped_is_no_question(folder: Path, tmp_path: Path, refused: Said) -> None:
    stopped = tmp_path / "stopped"
    shutil.copytree(folder / "diagnosis", stopped)
    content = json.loads((stopped / "diagnosis.json").read_text(encoding="utf-8"))
    content["so_far"] = {"stopped_during": "round 2", "roughly_left_s": None}
    (stopped / "diagnosis.json").write_text(json.dumps(content), encoding="utf-8")
    assert "is not finished" in refused("design", f"run={stopped}", f"out_dir={tmp_path / 'plan'}")


@pytest.mark.slow
def test_a_tie_is_planned_flown_and_broken(folder: Path, shown: Said) -> None:
    asked = ["design", f"run={folder / 'diagnosis'}"]
    told = shown(*asked, MEMBERS, *FEW, f"out_dir={folder / 'plan'}")
    assert "which is true: coulomb_friction + constant_force or asymmetric_friction" in told
    assert "expected evidence [nats]" in told
    content = json.loads((folder / "plan" / "design.json").read_text(encoding="utf-8"))
    assert [e["if_true"] for e in content["expected"]] == content["question"]["names"]
    plan = f"plan={folder / 'plan'}"
    flown = ["simulate", "system=mass_spring_damper", "dt=0.05", "pilot=plan", plan]
    assert main([*flown, TRUE, "seed=8", f"out={folder / 'flown'}"]) == 0
    assert main([*asked, f"flown={folder / 'flown'}", plan, f"out_dir={folder / 'obtained'}"]) == 0
    found = json.loads((folder / "obtained" / "obtained.json").read_text(encoding="utf-8"))
    assert found["broken"]
    assert found["speaks_for"] == "coulomb_friction + constant_force"
    assert found["expected_nats"] == pytest.approx(content["expected"][0]["nats"]["mean"])


def test_what_cannot_be_planned_is_said_before_any_work(folder: Path, refused: Said) -> None:
    run, nowhere = f"run={folder / 'diagnosis'}", folder / "nowhere"
    other = ["system=mass_spring_damper", "durations=[5,5]", "dt=0.05", "seed=4", f"out={folder / 'other'}"]
    assert main(["simulate", *other]) == 0
    for words, said in (
        ([run, MEMBERS, "limits={speed: [0,1]}"], "names 'speed'"),
        ([run, "members=[coulomb_friction]"], "takes lists of effects"),
        ([f"run={folder / 'runs'}"], "holds no diagnosis.json"),
        ([run, f"runs={nowhere}"], f"`runs`: {nowhere} does not exist"),
        ([run, f"flown={nowhere}"], f"`flown`: {nowhere} does not exist"),
        ([run, f"runs={folder / 'other'}"], "holds other runs"),
    ):
        assert said in refused("design", *words, f"out_dir={folder / 'none'}")
    assert "go together" in refused("simulate", "system=cartpole", "pilot=plan", f"out={folder / 'd'}")
