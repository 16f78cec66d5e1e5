"""Question: is a policy that learned in a learned model as good as one that learned on the truth?

As the supplement's Figures 13 and 14. Models learn from 20,000 interactions (100 episodes of 200 steps): the authors'
on-policy and random data, whose truth is `truth=published`, or those of this package's plant under its swing-up
controller and under random pushes (`truth=plant`). In each model a policy learns by PPO, and is judged on the truth
that the data came from. Score: 0 is random actions, 1 the mean of policies that had 600,000 interactions with that
truth. `limited` had 20,000 of them, as much as the models. A machine of `ensemble` keeps the member that it drew at the
start of its episode, one of `ensemble_redrawn` draws one at every step; they share models. The settings of PPO were
chosen on the truth alone.

    python benchmarks/bench_policy.py --published .../cartpole --out results/policy --seeds 5 --at-once 2

Whatever is finished in --out is used again. Writes policies.json, of which
`nsde figures 'figures=[fig13,fig14]' policies=...` draws the figures, and table.md.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import learn_policy, options, read_json, train

DATA = {"on_policy": "published", "random": "published", "plant_on_policy": "plant", "plant_random": "plant"}
FILES = {"on_policy": "learned.pkl", "random": "random.pkl"}
REDRAWN = "ensemble_redrawn"
KINDS = ("nsde", "blackbox_nsde", "node", "ensemble", REDRAWN)
EPISODES, INTERACTIONS = 100, 20_000


@dataclass(frozen=True)
class Cell:
    """One row of the table: where policies learned, and their folders."""

    data: str
    kind: str
    truth: str
    folders: tuple[Path, ...]

    @property
    def finished(self) -> list[Path]:
        return [folder for folder in self.folders if (folder / "policy.json").is_file()]

    def reports(self) -> list[dict[str, Any]]:
        return [read_json(folder / "policy.json") for folder in self.finished]


def data_words(data: str, published: Path | None) -> list[str]:
    """Words of `nsde train` for a data set."""
    if data in FILES:
        if published is None:
            raise SystemExit(f"data {data}: give the folder of {FILES[data]} with --published.")
        return ["data=published", f"data.path={published / FILES[data]}"]
    durations = ",".join(["4"] * EPISODES)
    return [f"data.durations=[{durations}]", f"data.options.policy={data.removeprefix('plant_')}"]


def cells(a: argparse.Namespace) -> list[Cell]:
    """What is asked for, the truths first."""
    out, seeds = [], range(a.seeds)
    for truth in dict.fromkeys(DATA[data] for data in a.data):
        for kind in ("truth", "limited"):
            folders = tuple(a.out / truth / f"{kind}_{seed}" for seed in seeds)
            out.append(Cell(truth, kind, truth, folders))
    for data in a.data:
        for kind in a.kinds:
            folders = tuple(a.out / data / f"{kind}_{seed}" for seed in seeds)
            out.append(Cell(data, kind, DATA[data], folders))
    return out


def job(cell: Cell, seed: int, a: argparse.Namespace) -> Callable[[], None]:
    """Make one policy, and first the model that it learns in."""

    def run() -> None:
        folder = cell.folders[seed]
        words = [f"truth={cell.truth}", f"seed={seed}"]
        if cell.kind == "truth":
            words += [f"steps={a.steps}"]
        elif cell.kind == "limited":
            words += [f"steps={INTERACTIONS}", "ppo=short"]
        else:
            own = seed % a.models
            kind = "ensemble" if cell.kind == REDRAWN else cell.kind
            model = a.out / "models" / cell.data / f"{kind}_{own}"
            more = [f"model={kind}", f"seed={own}", *data_words(cell.data, a.published), *a.train]
            train(model, ["system=cartpole", *more])
            words += [f"environment={model}", f"steps={a.steps}"]
            if kind == "ensemble":
                words.append(f"propagation={'redrawn' if cell.kind == REDRAWN else 'fixed'}")
        started = time.perf_counter()
        learn_policy(folder, [*words, *a.policy])
        reward = read_json(folder / "policy.json")["truth_reward"]["mean"]
        print(f"{folder}: reward {reward:.1f}, {time.perf_counter() - started:.0f} s", flush=True)

    return run


def spread(values: Sequence[float]) -> float:
    return statistics.stdev(values) if len(values) > 1 else 0.0


def rows(made: Sequence[Cell]) -> Iterator[dict[str, Any]]:
    """One row per cell: rewards and scores, mean and standard deviation over seeds."""
    truth = {
        c.truth: statistics.fmean(r["truth_reward"]["mean"] for r in c.reports())
        for c in made
        if c.kind == "truth"
    }
    for cell in made:
        reports = cell.reports()
        random = statistics.fmean(r["random_reward"]["mean"] for r in reports)
        unit = truth[cell.truth] - random

        def of(key: str, reports: Sequence[Mapping[str, Any]] = reports) -> list[float]:
            return [r[key]["mean"] for r in reports]

        scores = [(value - random) / unit for value in of("truth_reward")]
        last = [(value - random) / unit for value in of("truth_reward_of_last")]
        yield {
            "data": cell.data,
            "environment": cell.kind,
            "truth": cell.truth,
            "seeds": len(reports),
            "reward": statistics.fmean(of("truth_reward")),
            "reward_std_over_seeds": spread(of("truth_reward")),
            "reward_in_environment": statistics.fmean(of("environment_reward")),
            "reward_std_over_episodes": statistics.fmean(r["truth_reward"]["std"] for r in reports),
            "score": statistics.fmean(scores),
            "score_std_over_seeds": spread(scores),
            "scores": scores,
            "score_of_last": statistics.fmean(last),
            "random_reward": random,
            "truth_reward": truth[cell.truth],
            "seconds": statistics.fmean(r["seconds"] for r in reports),
            "policies": [str(folder) for folder in cell.finished],
        }


def table(found: Sequence[Mapping[str, Any]]) -> str:
    head = (
        "| data | learned in | reward on the truth | where it learned | score | last policy's score | seeds |"
    )
    lines = [head, "|" + "---|" * 7]
    for r in found:
        lines.append(
            f"| {r['data']} | {r['environment']} | {r['reward']:.1f} ± {r['reward_std_over_seeds']:.1f} | "
            f"{r['reward_in_environment']:.1f} | {r['score']:.3f} ± {r['score_std_over_seeds']:.3f} | "
            f"{r['score_of_last']:.3f} | {r['seeds']} |"
        )
    return "\n".join(lines)


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
    parser.add_argument("--train", nargs="*", default=[], help="further words for nsde train")
    parser.add_argument("--policy", nargs="*", default=[], help="further words for nsde policy")
    a = parser.parse_args()
    made = cells(a)
    # seed by seed, so that an unfinished study has something of everything
    for seed in () if a.report else range(a.seeds):
        with ThreadPoolExecutor(a.at_once) as pool:
            for done in [pool.submit(job(cell, seed, a)) for cell in made]:
                done.result()
    made = [cell for cell in made if cell.finished]
    judged = {cell.truth for cell in made if cell.kind == "truth"}
    if not made or {cell.truth for cell in made} != judged:
        raise SystemExit(f"nothing to report in {a.out}: no policy is finished on the truth.")
    found = list(rows(made))
    content = {"unit": "reward per episode", "score": "0 random, 1 trained on the truth", "rows": found}
    (a.out / "policies.json").write_text(json.dumps(content, indent=1))
    (a.out / "table.md").write_text(table(found) + "\n")
    print(table(found))


if __name__ == "__main__":
    main()
