"""Question: is the Gaussian ensemble as good as the same ensemble of a public library, mbrl-lib (Meta, 2021)?

Five members, silu 64-64, bootstraps, batches of 32. Both see the same pairs of cartpole states: the same episodes are
held out for the test, the same blocks of the others for the choice of weights, and inputs and changes are
standardised by the same numbers (mbrl-lib standardises no targets by itself; without that it does worse). Each side
has its own initial weights, bounds of the variance, loss, optimiser settings and stopping:

    ours   what `nsde train model=ensemble` does: learning rate 0.01 to 0.001, 10,000 steps
    mbrl   GaussianMLP in a ModelTrainer with the settings of its own cartpole example (learning rate 7.5e-4, weight
           decay 3e-5, patience 25, fixed bounds), as many gradient steps if its patience lasts
    mbrl, stretched   the same with learned bounds, all steps, and weights kept at the smallest improvement

Score: negative log-likelihood of the changes over one step in the held-out episodes under the equally weighted
mixture of the members, nats per transition; lower is better. It depends on the units, so it is given for the
standardised change and for SI units; the difference of two models does not.

mbrl-lib pins a Hydra that this project cannot use, so it gets an environment of its own, without its pins:

    python -m venv /tmp/peer && . /tmp/peer/bin/activate && pip install . gymnasium==0.29.1 termcolor imageio
    pip install --no-deps mbrl==0.2.0
    python benchmarks/bench_ensemble.py --published .../cartpole/learned.pkl
"""

import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from common import options, write_json
from torch import Tensor

from nsde_torch.data import DataSet, Windows, split
from nsde_torch.models import EnsembleSpec, GaussianEnsemble
from nsde_torch.recording import read
from nsde_torch.simulation import simulated
from nsde_torch.systems import make_system
from nsde_torch.training import TrainerOptions
from nsde_torch.training.fit_ensemble import STEPS_FACTOR, EnsembleLoop, Pairs, cut_pairs, standardised_pairs

MEMBERS, HIDDEN, BATCH = 5, 64, 32
EPISODES_HELD_OUT = 0.2


@dataclass(frozen=True)
class Case:
    """Pairs of one seed, and the model that knows how they were standardised."""

    model: GaussianEnsemble
    train: Pairs
    validation: Pairs
    test: Pairs


def main() -> None:
    parser = options(__doc__, out=Path("bench_ensemble.json"))
    parser.add_argument("--published", type=Path, help="the authors' learned.pkl (or random.pkl)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    a = parser.parse_args()
    torch.set_num_threads(1)
    system = make_system("cartpole")
    data = {"simulated": simulated(system)}
    if a.published:
        data[f"published {a.published.stem}"] = read("published", system, path=str(a.published))
    results: dict[str, dict[str, list[dict[str, float]]]] = {}
    for name, runs in data.items():
        sides = results.setdefault(name, {"ours": [], "mbrl": [], "mbrl, stretched": []})
        for seed in a.seeds:
            case = make_case(runs, seed)
            sides["ours"].append(ours(case, seed))
            sides["mbrl"].append(mbrl(case, seed, stretched=False))
            sides["mbrl, stretched"].append(mbrl(case, seed, stretched=True))
        report(name, sides)
    write_json(a.out, results)


def make_case(data: DataSet, seed: int) -> Case:
    """The last fifth of the episodes is the test; blocks of the others, drawn by the seed, validate."""
    count = len(data.runs)
    parts = split(data, list(range(count - round(EPISODES_HELD_OUT * count), count)))
    own = make_system("cartpole").defaults
    spec = EnsembleSpec("cartpole", dt=own.dt, horizon=own.horizon, members=MEMBERS, hidden=(HIDDEN, HIDDEN))
    model = GaussianEnsemble(spec, generator=torch.Generator().manual_seed(seed))
    windows = Windows(parts.train, own.dt, own.horizon)
    train, held = windows.held_out(0.15, 4.0, torch.Generator().manual_seed(seed))
    pairs = standardised_pairs(model, train, clock_scale=1.0)
    test = Windows(parts.test, own.dt, 1)
    return Case(model, pairs, cut_pairs(model, held, most=2048), cut_pairs(model, test, most=len(test)))


def ours(case: Case, seed: int) -> dict[str, float]:
    """Fit as `nsde train model=ensemble` does."""
    options = TrainerOptions()
    started = time.perf_counter()
    loop = EnsembleLoop(
        case.model,
        case.train,
        case.validation,
        steps=STEPS_FACTOR * options.steps,
        options=options,
        seed=seed,
    )
    steps = loop.run(title="ours").step
    seconds = time.perf_counter() - started
    with torch.no_grad():
        mean, v = case.model.standard(case.test.inputs.expand(MEMBERS, -1, -1))
    return {**score(case, mean, v), "steps": steps, "seconds": seconds}


def mbrl(case: Case, seed: int, *, stretched: bool) -> dict[str, float]:
    """Fit GaussianMLP with mbrl-lib's own trainer and iterators."""
    from mbrl.models import GaussianMLP, ModelTrainer, OneDTransitionRewardModel
    from mbrl.types import TransitionBatch
    from mbrl.util.replay_buffer import BootstrapIterator, TransitionIterator

    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    n_in, n_out = case.train.inputs.shape[1], case.train.changes.shape[1]

    def batch(pairs: Pairs) -> TransitionBatch:
        # its "observation" and "action" are joined again at once; the first must be as wide as the target
        y, c, none = pairs.inputs.numpy(), pairs.changes.numpy(), np.zeros(len(pairs.inputs), np.float32)
        return TransitionBatch(y[:, :n_out], y[:, n_out:], c, none, none.astype(bool), none.astype(bool))

    networks = GaussianMLP(
        n_in,
        n_out,
        "cpu",
        num_layers=2,
        ensemble_size=MEMBERS,
        hid_size=HIDDEN,
        learn_logvar_bounds=stretched,
        activation_fn_cfg={"_target_": "torch.nn.SiLU"},
    )
    model = OneDTransitionRewardModel(networks, target_is_delta=False, learned_rewards=False)
    train = BootstrapIterator(
        batch(case.train), BATCH, MEMBERS, shuffle_each_epoch=True, permute_indices=False, rng=rng
    )
    validation = TransitionIterator(batch(case.validation), 2048)
    epochs = max(25, math.ceil(STEPS_FACTOR * TrainerOptions().steps / len(train)))
    started = time.perf_counter()
    losses, _ = ModelTrainer(model, optim_lr=7.5e-4, weight_decay=3e-5).train(
        train,
        validation,
        num_epochs=epochs,
        patience=None if stretched else 25,
        improvement_threshold=0.0 if stretched else 0.01,
        silent=True,
    )
    seconds = time.perf_counter() - started
    with torch.no_grad():
        mean, v = networks(case.test.inputs.expand(MEMBERS, -1, -1), use_propagation=False)
    return {**score(case, mean, v), "steps": len(losses) * len(train), "seconds": seconds}


def score(case: Case, mean: Tensor, v: Tensor) -> dict[str, float]:
    """Scores on the test pairs, from mean and log-variance of the standardised change (members, N, n_change)."""
    z = (case.test.changes - mean).square() * torch.exp(-v)
    each = -0.5 * (z + v + math.log(2 * math.pi)).sum(-1)
    mixture = -float((torch.logsumexp(each, 0) - math.log(MEMBERS)).mean())
    units = float(case.model.change_scale.scale.log().sum())
    return {
        "nll": mixture,
        "nll_si": mixture + units,
        "nll_member": -float(each.mean()),
        "rmse": float((mean.mean(0) - case.test.changes).square().mean().sqrt()),
    }


def report(name: str, sides: dict[str, list[dict[str, float]]]) -> None:
    """Mean over the seeds (standard deviation), and our excess over the library."""
    print(f"\n{name}: {len(sides['ours'])} seeds, mean (standard deviation)")
    for side, rows in sides.items():
        cells = []
        for key in ("nll", "nll_si", "nll_member", "rmse", "steps", "seconds"):
            values = np.array([row[key] for row in rows])
            digits = 0 if key in ("steps", "seconds") else 3
            cells.append(
                f"{key} {values.mean():.{digits}f} ({values.std(ddof=min(1, len(values) - 1)):.{digits}f})"
            )
        print(f"  {side:22s}" + "  ".join(cells))
    for peer in [side for side in sides if side != "ours"]:
        for key in ("nll", "nll_si"):
            excess = np.mean([o[key] - p[key] for o, p in zip(sides["ours"], sides[peer], strict=True)])
            share = excess / abs(np.mean([p[key] for p in sides[peer]]))
            print(f"  {key}: ours - {peer} = {excess:+.4f} nats a transition, {share:+.1%}")


if __name__ == "__main__":
    main()
