"""`nsde policy` from the command line to a directory, in the truth and in a learned model."""

import json
from pathlib import Path

import pytest
import torch

from nsde_torch.cli.main import main
from nsde_torch.models import EnsembleSpec, GaussianEnsemble, NeuralSDE, SDESpec, run_directory
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


@pytest.mark.slow
def test_sweep_over_seeds_is_ranked(tmp_path: Path, capsys: pytest.CaptureFixture[str], shown: Said) -> None:
    sweep = tmp_path / "sweep"
    assert main(["policy", "-m", "seed=0,1", "truth=published", f"sweep_dir={sweep}", *TINY]) == 0
    assert len(list(sweep.glob("*/policy.safetensors"))) == 2
    capsys.readouterr()
    assert "truth_reward.mean" in shown("sweep-report", str(sweep))


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("environment=nowhere", "no run directory nowhere"),
        ("environment=hexacopter", "is a model of hexacopter"),
        ("system=hexacopter", "must be one that has a task: cartpole"),
        ("truth=gym", "plant | published"),
        ("ppo.batch=7", "`ppo.batch` must divide"),
        ("sensor_noise=-1", "sensor_noise"),
        ("scored_against=[nowhere]", "holds no finished policy"),
        ("stepz=1", "Did you mean `steps`?"),
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


@pytest.mark.slow
def test_members_of_an_ensemble_are_kept_or_redrawn_as_asked_and_only_an_ensemble_has_them(
    tmp_path: Path, refused: Said
) -> None:
    learned = tmp_path / "ensemble"
    spec = EnsembleSpec("cartpole", dt=0.02, horizon=10)
    run_directory.save(GaussianEnsemble(spec, generator=torch.Generator().manual_seed(0)), learned)
    for asked, found in ((None, "fixed"), ("redrawn", "redrawn")):
        folder = tmp_path / found
        words = [f"environment={learned}", f"run_dir={folder}", *TINY]
        assert main(["policy", *words, *([f"propagation={asked}"] if asked else [])]) == 0
        assert json.loads((folder / "policy.json").read_text())["environment"]["propagation"] == found
    words = ["propagation=fixed", f"run_dir={tmp_path / 'none'}", *TINY]
    assert "this model is nsde" in refused("policy", f"environment={model(tmp_path / 'sde')}", *words)
    # the folder of a run that never began is free
    assert "environment=truth is none" in refused("policy", *words)
