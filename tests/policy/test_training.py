"""Learning a policy: what is kept, what is written, how an interrupted one goes on, and what the score is."""

import json
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nsde_torch.errors import CheckpointError, ConfigError
from nsde_torch.policy import (
    BatchEnvironment,
    CartpoleSwingUp,
    Dynamics,
    PolicyOptions,
    PolicyTraining,
    episode_rewards,
    load_policy,
    make_truth,
    score,
)

pytest.importorskip("stable_baselines3", reason="needs the extra nsde_torch[policy]")

from nsde_torch.policy.ppo import Learner, PolicyVecEnv

pytestmark = pytest.mark.drawn

TASK = CartpoleSwingUp(steps=20)  # a tenth of an episode, for speed
TINY = PolicyOptions(
    interactions=512, n_envs=4, rollout=32, batch=64, epochs=2, hidden=(8,), evaluate_every=128, episodes=5,
    final_episodes=8,
)  # fmt: skip
ABOUT: dict[str, Any] = {
    "environment": {"kind": "truth", "name": "published"},
    "truth": "published",
    "sensor_noise": 1.0,
}


def truth(generator: torch.Generator, sensor_noise: float = 1.0) -> Dynamics:
    return make_truth(
        "published", system="cartpole", dt=TASK.dt, sensor_noise=sensor_noise, generator=generator
    )


def training(folder: Path, **settings: Any) -> PolicyTraining:
    given: dict[str, Any] = {"environment": truth, "truth": truth, "options": TINY, "seed": 0, "about": ABOUT}
    return PolicyTraining(TASK, folder=folder, **{**given, "say": lambda _: None, **settings})


def machines(n: int, seed: int = 0) -> BatchEnvironment:
    generator = torch.Generator().manual_seed(seed)
    return BatchEnvironment(TASK, truth(generator), n=n, generator=generator, start=TASK.evaluation)


def test_training_writes_policy_report_and_picture_and_leaves_nothing_among_the_temporary_files(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = tmp_path_factory.mktemp("temporary")
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    result = training(tmp_path, environment=partial(truth, sensor_noise=0.0)).run()
    assert {p.name.partition("_")[0] for p in temporary.iterdir()} <= {"torchinductor"}  # torch's own
    assert json.loads((tmp_path / "policy.json").read_text()) == result
    assert (tmp_path / "plots" / "learning_curve.png").stat().st_size > 5000
    assert not list(tmp_path.rglob("*.pkl")) + list(tmp_path.rglob("*.zip"))
    assert [row["interactions"] for row in result["curve"]] == [0, 128, 256, 384, 512]
    best = max(result["curve"], key=lambda row: row["environment_reward"])
    assert result["kept_after"] == best["interactions"]
    assert result["truth_reward"]["episodes"] == TINY.final_episodes
    assert result["environment_reward"] != result["truth_reward"]
    assert result["score"] is None
    assert result["validation"]["score"] == -result["environment_reward"]["mean"]
    again = episode_rewards(load_policy(tmp_path), machines(TINY.final_episodes, seed=102))
    assert again.mean == pytest.approx(result["truth_reward"]["mean"])


def test_same_seed_learns_the_same_and_another_learns_another(tmp_path: Path) -> None:
    made = (training(tmp_path / name, seed=seed).run() for name, seed in (("a", 3), ("b", 3), ("c", 4)))
    first, second, other = (result["truth_reward"] for result in made)
    assert first == second != other


def test_policy_in_the_file_takes_the_mean_action_of_the_learner() -> None:
    learner = Learner(machines(4), options=TINY, seed=0)
    learner.learn(lambda: None, at_every_step=lambda done: None)
    seen = 3 * torch.randn(40, 5)
    scaled = seen / torch.tensor(learner.environment.task.observation_scale)
    theirs, _ = learner._ppo.predict(scaled.numpy(), deterministic=True)
    torch.testing.assert_close(learner.actor()(seen), torch.as_tensor(theirs), rtol=1e-5, atol=1e-6)


def test_interrupted_training_goes_on_where_it_was(tmp_path: Path) -> None:
    calls = 0

    def stop(generator: torch.Generator) -> Dynamics:
        nonlocal calls
        calls += 1
        if calls == 4:  # machines to learn on, and the evaluations after 0, 128 and 256 interactions
            raise KeyboardInterrupt
        return truth(generator)

    with pytest.raises(KeyboardInterrupt):
        training(tmp_path, environment=stop, truth=truth).run()
    said: list[str] = []
    result = training(tmp_path, say=said.append).run()
    assert said[0] == "going on after 128 interactions"
    assert [row["interactions"] for row in result["curve"]] == [0, 128, 256, 384, 512]
    assert result["interactions"] == 512


def test_the_learner_is_told_of_the_end_of_an_episode_and_sees_scaled_rewards() -> None:
    env = PolicyVecEnv(machines(2), reward_scale=0.1)
    env.reset()
    total = np.zeros(2)
    for _ in range(TASK.steps):
        seen, rewards, dones, infos = env.step(np.zeros((2, 1), dtype=np.float32))
        total += rewards
    assert dones.all()
    for row, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        assert info["terminal_observation"].shape == (5,)
        assert not np.array_equal(info["terminal_observation"], seen[row])
        assert info["episode"]["l"] == TASK.steps
        assert info["episode"]["r"] == pytest.approx(10 * total[row], rel=1e-4)


def test_score_is_relative_to_policies_of_the_same_truth(tmp_path: Path) -> None:
    reference = training(tmp_path / "reference").run()
    result = training(tmp_path / "own", seed=1, scored_against=[tmp_path / "reference"]).run()
    random, best = result["random_reward"]["mean"], reference["truth_reward"]["mean"]
    assert result["reference_reward"] == best
    assert result["score"] == pytest.approx((result["truth_reward"]["mean"] - random) / (best - random))
    assert score(80.0, random=-300.0, truth=-300.0) is None
    with pytest.raises(ConfigError, match="reference"):
        training(tmp_path / "x", about={**ABOUT, "truth": "plant"}, scored_against=[tmp_path / "reference"])
    with pytest.raises(CheckpointError, match="no finished policy"):
        training(tmp_path / "x", scored_against=[tmp_path / "nowhere"])
