"""Question: is a policy that learned in a learned model as good as one that learned on the truth?

    python benchmarks/bench_policy.py --published .../cartpole --out results/policy --seeds 5 --at-once 2

As the supplement's Figures 13 and 14. Models learn from 20,000 interactions: the authors' on-policy and random data
(`truth=published`), or those of this package's plant (`truth=plant`). In each model a policy learns by PPO, and is
judged on the truth that the data came from. Score: 0 is random actions, 1 the mean of policies that had 600,000
interactions with that truth; `limited` had 20,000. A machine of `ensemble` keeps the member that it drew at the start
of its episode, one of `ensemble_redrawn` draws one at every step. Whatever is finished in --out is used again;
`nsde figures policies=...` draws figures of policies.json.
"""

import argparse
import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from common import finished, markdown, options, read_json, write_json

DATA = {"on_policy": "published", "random": "published", "plant_on_policy": "plant", "plant_random": "plant"}
FILES = {"on_policy": "learned.pkl", "random": "random.pkl"}
REDRAWN = "ensemble_redrawn"
KINDS = ("nsde", "blackbox_nsde", "node", "ensemble", REDRAWN)
EPISODES, INTERACTIONS = 100, 20_000


class Cell(NamedTuple):
    """One row of the table: where policies learned, and their folders."""

    data: str
    kind: str
    truth: str
    folders: tuple[Path, ...]

    @property
    def finished(self) -> list[Path]:
        return [folder for folder in self.folders if (folder / "policy.json").is_file()]

    def means(self, key: str) -> list[float]:
        """A mean reward of each policy."""
        return [read_json(folder / "policy.json")[key]["mean"] for folder in self.finished]


def cells(a: argparse.Namespace) -> list[Cell]:
    """What is asked for, the truths first."""
    truths = dict.fromkeys(DATA[data] for data in a.data)
    asked = [(truth, kind, truth) for truth in truths for kind in ("truth", "limited")]
    asked += [(data, kind, DATA[data]) for data in a.data for kind in a.kinds]
    return [
        Cell(data, kind, truth, tuple(a.out / data / f"{kind}_{seed}" for seed in range(a.seeds)))
        for data, kind, truth in asked
    ]


def make(cell: Cell, seed: int, a: argparse.Namespace) -> None:
    """Make one policy, and first the model that it learns in."""
    folder = cell.folders[seed]
    words = [f"truth={cell.truth}", f"seed={seed}"]
    if cell.kind == "truth":
        words += [f"steps={a.steps}"]
    elif cell.kind == "limited":
        words += [f"steps={INTERACTIONS}", "ppo=short"]
    else:
        own = seed % a.models
        kind = "ensemble" if cell.kind == REDRAWN else cell.kind
        if cell.data not in FILES:
            durations, policy = ",".join(["4"] * EPISODES), cell.data.removeprefix("plant_")
            data = [f"data.durations=[{durations}]", f"data.options.policy={policy}"]
        elif a.published is not None:
            data = ["data=published", f"data.path={a.published / FILES[cell.data]}"]
        else:
            raise SystemExit(f"data {cell.data}: give the folder of {FILES[cell.data]} with --published.")
        model = a.out / "models" / cell.data / f"{kind}_{own}"
        more = [f"model={kind}", f"seed={own}", *data]
        finished("train", "metrics.json", model, ["system=cartpole", *more])
        words += [f"environment={model}", f"steps={a.steps}"]
        if kind == "ensemble":
            words.append(f"propagation={'redrawn' if cell.kind == REDRAWN else 'fixed'}")
    started = time.perf_counter()
    finished("policy", "policy.json", folder, words)
    reward = read_json(folder / "policy.json")["truth_reward"]["mean"]
    print(f"{folder}: reward {reward:.1f}, {time.perf_counter() - started:.0f} s", flush=True)


def spread(values: Sequence[float]) -> float:
    return statistics.stdev(values) if len(values) > 1 else 0.0


def rows(made: Sequence[Cell]) -> Iterator[dict[str, Any]]:
    """One row per cell: rewards and scores, mean and standard deviation over seeds."""
    truth = {c.truth: statistics.fmean(c.means("truth_reward")) for c in made if c.kind == "truth"}
    for cell in made:
        random, rewards = statistics.fmean(cell.means("random_reward")), cell.means("truth_reward")
        scores = [(value - random) / (truth[cell.truth] - random) for value in rewards]
        yield {
            "data": cell.data,
            "environment": cell.kind,
            "truth": cell.truth,
            "seeds": len(rewards),
            "reward": statistics.fmean(rewards),
            "reward_std_over_seeds": spread(rewards),
            "reward_in_environment": statistics.fmean(cell.means("environment_reward")),
            "score": statistics.fmean(scores),
            "score_std_over_seeds": spread(scores),
            "random_reward": random,
            "truth_reward": truth[cell.truth],
            "policies": [str(folder) for folder in cell.finished],
        }


def table(found: Sequence[Mapping[str, Any]]) -> str:
    head = ("data", "learned in", "reward on the truth", "where it learned", "score", "seeds")
    lines = []
    for r in found:
        reward, score = (
            f"{r[k]:.{n}f} ± {r[f'{k}_std_over_seeds']:.{n}f}" for k, n in (("reward", 1), ("score", 3))
        )
        lines.append(
            (r["data"], r["environment"], reward, f"{r['reward_in_environment']:.1f}", score, r["seeds"])
        )
    return "\n".join(markdown(head, lines))


def main() -> None:
    parser = options(__doc__, "out", seeds=5, at_once=1)
    parser.add_argument("--published", type=Path, help="folder of learned.pkl and random.pkl")
    parser.add_argument("--data", nargs="+", default=list(DATA), choices=list(DATA), help="data sets")
    parser.add_argument(
        "--kinds", nargs="*", default=list(KINDS), choices=list(KINDS), help="kinds of models"
    )
    parser.add_argument(
        "--models", type=int, default=5, help="models of each kind; policies share them in turn"
    )
    parser.add_argument("--steps", type=int, default=600_000, help="interactions of a policy")
    parser.add_argument("--report", action="store_true", help="make nothing; report what is finished")
    a = parser.parse_args()
    made = cells(a)
    # seed by seed, so that an unfinished study has something of everything
    for seed in () if a.report else range(a.seeds):
        with ThreadPoolExecutor(a.at_once) as pool:
            for done in [pool.submit(make, cell, seed, a) for cell in made]:
                done.result()
    made = [cell for cell in made if cell.finished]
    judged = {cell.truth for cell in made if cell.kind == "truth"}
    if not made or {cell.truth for cell in made} != judged:
        raise SystemExit(f"nothing to report in {a.out}: no policy is finished on the truth.")
    found = list(rows(made))
    content = {"unit": "reward per episode", "score": "0 random, 1 trained on the truth", "rows": found}
    write_json(a.out / "policies.json", content)
    (a.out / "table.md").write_text(table(found) + "\n")
    print(table(found))


if __name__ == "__main__":
    main()
