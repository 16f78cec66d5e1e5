"""`nsde policy` from the command line to a directory, in the truth and in a learned model."""

import json
from pathlib import Path

import pytest
import torch

from nsde_torch.cli.main import main
from nsde_torch.models import NeuralSDE, SDESpec, run_directory
from nsde_torch.policy import load_policy
from tests.helpers.commands import Said

pytest.importorskip("stable_baselines3", reason="needs the extra nsde_torch[policy]")

TINY = (
    *("steps=96", "ppo.n_envs=4", "ppo.rollout=12", "ppo.batch=24", "ppo.epochs=1", "ppo.hidden=[6]"),
    *("ppo.evaluate_every=48", "ppo.episodes=3", "ppo.final_episodes=4"),
)


def model(folder: Path, system: str = "cartpole") -> Path:
    spec = SDESpec(system, dt=0.02, horizon=10, step="euler_maruyama")
    run_directory.save(NeuralSDE(spec, generator=torch.Generator().manual_seed(0)), folder)
    return folder


@pytest.mark.slow
def test_policies_learn_on_the_truth_and_in_a_model_and_are_scored(tmp_path: Path, shown: Said) -> None:
    truth, own = tmp_path / "truth", tmp_path / "own"
    learned = model(tmp_path / "0_seed=1,dt=2")  # a folder as a sweep names them
    assert "reward per episode on the truth" in shown(
        "policy", "system=cartpole", "environment=truth", f"run_dir={truth}", *TINY
    )
    words = [f"environment={learned}", f"scored_against=[{truth}]", "seed=1"]
    assert main(["policy", *words, f"run_dir={own}", *TINY]) == 0
    first, second = (json.loads((folder / "policy.json").read_text()) for folder in (truth, own))
    assert first["environment"] == {"kind": "truth", "name": "plant"}
    assert second["environment"]["name"] == "nsde"
    assert second["environment"]["run"] == str(learned)
    assert (first["seed"], second["seed"]) == (0, 1)
    assert first["score"] is None
    assert isinstance(second["score"], float)
    assert second["units"]["reward"]
    assert [row["interactions"] for row in second["curve"]] == [0, 48, 96]
    assert load_policy(own)(torch.zeros(2, 5)).shape == (2, 1)
    assert (own / "plots" / "learning_curve.png").is_file()


def test_finished_policy_can_be_continued_to_more_interactions(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    assert main(["policy", "truth=published", "seed=2", f"run_dir={folder}", *TINY]) == 0
    assert main(["policy", f"resume={folder}", "steps=192"]) == 0
    result = json.loads((folder / "policy.json").read_text())
    assert (result["interactions"], result["seed"], result["truth"]) == (192, 2, "published")
    assert [row["interactions"] for row in result["curve"]] == [0, 48, 96, 144, 192]


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("environment=nowhere", "no run directory nowhere"),
        ("environment=hexacopter", "is a model of hexacopter"),
        ("system=hexacopter", "must be one that has a task: cartpole"),
        ("ppo.batch=7", "`ppo.batch` must divide"),
        ("scored_against=[nowhere]", "holds no finished policy"),
    ],
)
def test_fault_of_the_user_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Said, word: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    if word == "environment=hexacopter":
        model(tmp_path / "hexacopter", "hexacopter")
    assert message in refused("policy", word, f"run_dir={tmp_path / 'run'}")


def test_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Said) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "pip install 'nsde_torch[policy]'" in refused("policy", f"run_dir={tmp_path / 'run'}")
