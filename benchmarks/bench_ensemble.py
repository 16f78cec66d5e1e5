"""Question: is the Gaussian ensemble as good as the same ensemble of a public library, mbrl-lib (Meta, 2021)?

Five members, silu 64-64, bootstraps, batches of 32. Both see the same pairs of cartpole states, standardised by the
same numbers, with the same episodes held out for the test and the same blocks of the others for the choice of weights.
Each side has its own initial weights, bounds of the variance, loss, optimiser settings and stopping:

    ours   what `nsde train model=ensemble` does: learning rate 0.01 to 0.001, 10,000 steps
    mbrl   GaussianMLP in a ModelTrainer with the settings of its own cartpole example (learning rate 7.5e-4, weight
           decay 3e-5, patience 25, fixed bounds), as many gradient steps if its patience lasts
    mbrl, stretched   the same with learned bounds, all steps, and weights kept at the smallest improvement

Score: negative log-likelihood of the standardised changes over one step in the held-out episodes under the equally
weighted mixture of the members, nats per transition; lower is better. mbrl-lib pins a Hydra that this project cannot
use, so it gets an environment of its own, without its pins:

    python -m venv /tmp/peer && . /tmp/peer/bin/activate && pip install . gymnasium==0.29.1 termcolor imageio
    pip install --no-deps mbrl==0.2.0
    python benchmarks/bench_ensemble.py --published .../cartpole/learned.pkl
"""

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import torch
from common import options
from torch import Tensor

from nsde_torch.data import DataSet, Windows, split
from nsde_torch.models import EnsembleSpec, GaussianEnsemble
from nsde_torch.recording import read
from nsde_torch.simulation import simulated
from nsde_torch.systems import make_system
from nsde_torch.training import LossOptions, TrainerOptions
from nsde_torch.training.fit_ensemble import STEPS_FACTOR, EnsembleLoop, Pairs, cut_pairs, standardised_pairs
from nsde_torch.training.task import Task

MEMBERS, HIDDEN, BATCH = 5, 64, 32
EPISODES_HELD_OUT = 0.2


class Case(NamedTuple):
    """Pairs of one seed, and the model that knows how they were standardised."""

    model: GaussianEnsemble
    train: Pairs
    validation: Pairs
    test: Pairs


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--published", type=Path, help="the authors' learned.pkl (or random.pkl)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    a = parser.parse_args()
    system = make_system("cartpole")
    data = {"simulated": simulated(system)}
    if a.published:
        data[f"published {a.published.stem}"] = read("published", system, path=str(a.published))
    for name, runs in data.items():
        sides: dict[str, list[float]] = {"ours": [], "mbrl": [], "mbrl, stretched": []}
        for seed in a.seeds:
            case = make_case(runs, seed)
            sides["ours"].append(ours(case, seed))
            sides["mbrl"].append(mbrl(case, seed, stretched=False))
            sides["mbrl, stretched"].append(mbrl(case, seed, stretched=True))
        print(f"\n{name}: {len(a.seeds)} seeds, nats, mean (standard deviation)")
        for side, scores in sides.items():
            print(f"  {side:22s}{np.mean(scores):.3f} ({np.std(scores, ddof=min(1, len(scores) - 1)):.3f})")


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


def ours(case: Case, seed: int) -> float:
    options = TrainerOptions()
    how = {"spec": case.model.spec, "runs": [], "seed": seed, "name": "ours"}
    how |= {"loss": LossOptions(), "options": options, "validation": 0.15, "clock": 1.0, "values": {}}
    how |= {"device": torch.device("cpu"), "dtype": torch.float32, "log": lambda *_: None}
    with TemporaryDirectory() as folder:
        task = Task(**how, checkpoint=Path(folder) / "ours")
        many = STEPS_FACTOR * options.steps
        EnsembleLoop(case.model, case.train, case.validation, steps=many, task=task).run()
    with torch.no_grad():
        return score(case, *case.model.standard(case.test.inputs.expand(MEMBERS, -1, -1)))


def mbrl(case: Case, seed: int, *, stretched: bool) -> float:
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

    how = {"num_layers": 2, "ensemble_size": MEMBERS, "hid_size": HIDDEN, "learn_logvar_bounds": stretched}
    networks = GaussianMLP(n_in, n_out, "cpu", activation_fn_cfg={"_target_": "torch.nn.SiLU"}, **how)
    model = OneDTransitionRewardModel(networks, target_is_delta=False, learned_rewards=False)
    orders = {"shuffle_each_epoch": True, "permute_indices": False, "rng": rng}
    train = BootstrapIterator(batch(case.train), BATCH, MEMBERS, **orders)
    validation = TransitionIterator(batch(case.validation), 2048)
    epochs = max(25, math.ceil(STEPS_FACTOR * TrainerOptions().steps / len(train)))
    stops = {"patience": None if stretched else 25, "improvement_threshold": 0.0 if stretched else 0.01}
    trainer = ModelTrainer(model, optim_lr=7.5e-4, weight_decay=3e-5)
    trainer.train(train, validation, num_epochs=epochs, silent=True, **stops)
    with torch.no_grad():
        return score(case, *networks(case.test.inputs.expand(MEMBERS, -1, -1), use_propagation=False))


def score(case: Case, mean: Tensor, v: Tensor) -> float:
    """Score on the test pairs, from mean and log-variance of the standardised change (members, N, n_change)."""
    z = (case.test.changes - mean).square() * torch.exp(-v)
    each = -0.5 * (z + v + math.log(2 * math.pi)).sum(-1)
    return -float((torch.logsumexp(each, 0) - math.log(MEMBERS)).mean())


if __name__ == "__main__":
    main()
