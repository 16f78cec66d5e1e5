"""One policy from an environment to a directory: learn, evaluate on the truth along the way, keep the best, write.

The policy that is kept is the one that does best in the environment that it learned in; what it does on the truth is
reported and decides nothing. Evaluations take the mean action and start where the supplement's figures start, always
in the same states.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import torch
from torch import Tensor
from tqdm.auto import tqdm

from nsde_torch.errors import CheckpointError, ConfigError
from nsde_torch.policy.actor import Actor, load_policy
from nsde_torch.policy.environment import BatchEnvironment, Box, CartpoleSwingUp, Dynamics
from nsde_torch.policy.options import PolicyOptions
from nsde_torch.progress import no_bar
from nsde_torch.whole_files import json_text

if TYPE_CHECKING:
    from nsde_torch.policy.ppo import Learner


# What a policy is worth: rewards of whole episodes, and the score that compares environments.
#
#     score = (R - R_random) / (R_truth - R_random)
#
# R is the mean reward per episode on the true dynamics, R_random that of actions uniform in [-1, 1], and
# R_truth that of policies trained on the truth: 0 is a policy that has learned nothing, 1 one that had the
# real machine.

Policy = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Rewards:
    """Rewards of episodes; `left` of these left the track or the finite numbers."""

    mean: float
    std: float
    worst: float
    episodes: int
    left: int


@torch.no_grad()
def episode_rewards(policy: Policy, environment: BatchEnvironment) -> Rewards:
    """Play one whole episode on every machine of an environment that is not staggered."""
    seen = environment.reset()
    total = torch.full((environment.n,), torch.nan, dtype=torch.float64)
    left = torch.zeros(environment.n, dtype=torch.bool)
    for _ in range(environment.task.steps):
        made = environment.step(policy(seen))
        first = (made.terminated | made.truncated) & torch.isnan(total)
        total = torch.where(first, made.total, total)
        left |= first & made.terminated
        seen = made.observation
    mean, std, worst = float(total.mean()), float(total.std(correction=0)), float(total.min())
    return Rewards(mean, std, worst, environment.n, int(left.sum()))


def random_policy(environment: BatchEnvironment, generator: torch.Generator) -> Policy:
    """Actions uniform in [-1, 1], whatever is seen."""
    shape = (environment.n, len(environment.task.action_names))
    return lambda _: 2.0 * torch.rand(*shape, generator=generator) - 1.0


def score(reward: float, *, random: float, truth: float) -> float | None:
    """The score; None where the policy trained on the truth is no better than chance."""
    return (reward - random) / (truth - random) if truth > random else None


REPORT = "policy.json"
_CHECKPOINT = "checkpoints/learner.safetensors"
_EVALUATION_SEED, _FINAL_SEED = 101, 102
MakeDynamics = Callable[[torch.Generator], Dynamics]


@final
@dataclass(eq=False)
class PolicyTraining:
    """One training. `run` does all of it; interrupted and run again, it goes on from its last evaluation.

    CheckpointError: what it is scored against is none, or its truth is another.
    """

    task: CartpoleSwingUp  # what is asked for
    _: KW_ONLY
    environment: MakeDynamics  # makes the machines to learn on from a source of randomness
    truth: MakeDynamics  # makes the true machines; the same object as `environment` to learn on the truth
    options: PolicyOptions
    seed: int  # seed of everything random but the evaluations
    folder: Path  # folder to write into
    about: Mapping[str, Any]
    """Plain values for `policy.json`: `environment` (`kind` and `name`), `truth` and `sensor_noise`, which must be
    those of a reference, and whatever else says what they are."""
    scored_against: Sequence[str | Path] = ()
    """Folders of policies that were trained on this truth; the score compares with them."""
    say: Callable[[str], None] = print  # where text for people goes

    def __post_init__(self) -> None:
        self.folder = Path(self.folder)
        self._reference = _reference_reward(self.scored_against, self.about)
        self._rows: list[dict[str, float]] = []
        self._started = time.perf_counter()
        self._seconds_before = 0.0

    def run(self) -> dict[str, Any]:
        """Learn, evaluate and write; what `policy.json` holds."""
        options, total = self.options, self.options.interactions
        self.folder.mkdir(parents=True, exist_ok=True)
        learner = self._learner()
        shown: dict[str, Any] = {"desc": "policy", "unit": "step", "unit_scale": True, "mininterval": 0.5}
        bar = tqdm(total=total, initial=learner.interactions, disable=no_bar(), leave=False, **shown)

        def between_updates() -> None:
            done = learner.interactions
            last = self._rows[-1]["interactions"] if self._rows else -1
            due = done // options.evaluate_every > last // options.evaluate_every
            if due or (done >= total and done > last):
                self._evaluate(learner, bar)

        with bar:
            learner.learn(between_updates, at_every_step=lambda done: bar.update(done - bar.n))
        result = self._conclude(learner.actor())
        (self.folder / REPORT).write_text(json_text(result))
        self._draw(result)
        self._tell(result)
        return result

    def _learner(self) -> Learner:
        from nsde_torch.policy.ppo import Learner

        path = self.folder / _CHECKPOINT
        # further machines start in other states: those of the seed have been played before an interruption
        generator = torch.Generator().manual_seed(2 * self.seed + (1 if path.is_file() else 0))
        machines = BatchEnvironment(
            self.task,
            self.environment(generator),
            n=self.options.n_envs,
            generator=generator,
            start=self.task.training,
            stagger=True,
        )
        learner = Learner(machines, options=self.options, seed=self.seed)
        if path.is_file():
            kept = learner.restore(path)
            self._rows, self._seconds_before = kept["rows"], kept["seconds"]
            self.say(f"going on after {learner.interactions} interactions")
        return learner

    def _evaluate(self, learner: Learner, bar: Any) -> None:
        actor, done = learner.actor(), learner.interactions
        true = self._play(actor, self.truth, self.options.episodes, _EVALUATION_SEED)
        own = true
        if not self._on_truth:
            own = self._play(actor, self.environment, self.options.episodes, _EVALUATION_SEED)
        row = {
            "interactions": done,
            "environment_reward": own.mean,
            "environment_reward_std": own.std,
            "truth_reward": true.mean,
            "truth_reward_std": true.std,
            "action_std": float(actor.log_std.exp().mean()),
            "seconds": self._seconds(),
        }
        if not self._rows or own.mean > max(r["environment_reward"] for r in self._rows):
            actor.save(self.folder)
        self._rows.append(row)
        learner.save(self.folder / _CHECKPOINT, {"rows": self._rows, "seconds": self._seconds()})
        where = "" if self._on_truth else f"environment {own.mean:.1f}, "
        if bar.disable:
            self.say(f"{done:>9,} interactions: {where}truth {true.mean:.1f}, {row['seconds']:.0f} s")
        else:
            bar.set_postfix_str(f"{where}truth {true.mean:.1f}")

    def _play(
        self, policy: Actor | None, dynamics: MakeDynamics, episodes: int, seed: int, start: Box | None = None
    ) -> Rewards:
        """Rewards of a policy, None for random actions."""
        generator = torch.Generator().manual_seed(seed)
        machines = BatchEnvironment(
            self.task,
            dynamics(generator),
            n=episodes,
            generator=generator,
            start=start or self.task.evaluation,
        )
        plays: Policy = random_policy(machines, generator) if policy is None else policy
        return episode_rewards(plays, machines)

    def _conclude(self, last: Actor) -> dict[str, Any]:
        kept, n = load_policy(self.folder), self.options.final_episodes
        best = max(self._rows, key=lambda row: row["environment_reward"])

        def true(policy: Actor | None, start: Box | None = None) -> Rewards:
            return self._play(policy, self.truth, n, _FINAL_SEED, start)

        reward, random = true(kept), true(None)
        own = reward if self._on_truth else self._play(kept, self.environment, n, _FINAL_SEED)
        value = None
        if self._reference is not None:
            value = score(reward.mean, random=random.mean, truth=self._reference)
        return {
            "system": self.task.system,
            "model": self.about["environment"]["name"],
            **self.about,
            "seed": self.seed,
            "interactions": int(self._rows[-1]["interactions"]),
            "kept_after": int(best["interactions"]),
            "validation": {"score": -own.mean, "unit": "minus the reward where it learned"},
            "truth_reward": asdict(reward),
            "environment_reward": asdict(own),
            "truth_reward_of_last": asdict(true(last)),
            "truth_reward_training_starts": asdict(true(kept, self.task.training)),
            "random_reward": asdict(random),
            "score": value,
            "reference_reward": self._reference,
            "scored_against": list(map(str, self.scored_against)),
            "units": {
                "reward": self.task.reward_unit,
                "interactions": "steps of the environment",
                "seconds": "s",
                "score": "0 random, 1 trained on the truth",
            },
            "episode": {"steps": self.task.steps, "dt_s": self.task.dt},
            "options": {**asdict(self.options), "hidden": list(self.options.hidden)},
            "seconds": self._seconds(),
            "curve": self._rows,
        }

    def _draw(self, result: Mapping[str, Any]) -> None:
        from nsde_torch.plots import save
        from nsde_torch.plots.evaluation import policy_rewards

        name = result["environment"]["name"]
        figure = policy_rewards(
            {f"learned in {name}": [result["curve"]]},
            random=result["random_reward"]["mean"],
            truth=result["reference_reward"],
            title=f"{result['system']}: reward of a policy while it learns",
        )
        save(figure, self.folder / "plots" / "learning_curve.png")

    def _tell(self, result: Mapping[str, Any]) -> None:
        reward, own = result["truth_reward"], result["environment_reward"]
        self.say(
            f"reward per episode on the truth: {reward['mean']:.1f} +- {reward['std']:.1f} "
            f"({reward['episodes']} episodes; worst {reward['worst']:.1f}); random actions "
            f"{result['random_reward']['mean']:.1f}"
        )
        if not self._on_truth:
            self.say(f"in the environment that it learned in: {own['mean']:.1f} +- {own['std']:.1f}")
        if result["score"] is not None:
            self.say(f"score (0 random, 1 trained on the truth): {result['score']:.3f}")
        else:
            self.say("no score: name policies trained on the truth, scored_against=[DIR,...]")
        self.say(f"took {result['seconds']:.0f} s; wrote {self.folder}")

    @property
    def _on_truth(self) -> bool:
        return self.environment is self.truth

    def _seconds(self) -> float:
        return self._seconds_before + time.perf_counter() - self._started


def _reference_reward(folders: Sequence[str | Path], about: Mapping[str, Any]) -> float | None:
    """Mean reward on the truth of policies that learned there; None without any."""
    rewards = []
    for folder in folders:
        try:
            other = json.loads((Path(folder) / REPORT).read_text())
            found = {key: other[key] for key in ("truth", "sensor_noise")}
            learned_in, reward = other["environment"]["kind"], float(other["truth_reward"]["mean"])
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise CheckpointError(
                f"`scored_against`: {folder} holds no finished policy ({error}); give folders that `nsde policy` wrote."
            ) from error
        wanted = {key: about.get(key) for key in found}
        if found != wanted or learned_in != "truth":
            raise ConfigError(
                f"`scored_against`: {folder} must be a policy that was trained on the truth of this one {wanted}; it "
                f"was trained in {learned_in} and judged by {found}."
            )
        rewards.append(reward)
    return sum(rewards) / len(rewards) if rewards else None
