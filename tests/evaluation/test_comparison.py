"""Comparisons of models: differences with intervals from blocks, and what is read, refused and written."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nsde_torch.data import DataSet, RawRun, Run
from nsde_torch.errors import ConfigError, DataError, NonFiniteError
from nsde_torch.evaluation import evaluate
from nsde_torch.evaluation.bootstrap import (
    Blocks,
    Difference,
    make_blocks,
    paired_bootstrap,
    verdict,
)
from nsde_torch.evaluation.common_grid import Candidate
from nsde_torch.evaluation.comparison import Comparison, compare
from nsde_torch.evaluation.comparison_figures import write_figures
from nsde_torch.evaluation.comparison_text import lines
from nsde_torch.evaluation.seen import SeenRuns, record
from nsde_torch.models import NeuralSDE
from nsde_torch.recording import assemble
from nsde_torch.systems import make_system
from tests.helpers.draws import generator
from tests.helpers.toy_systems import DT, Decay, Gusty, decay_runs, fix_sigma, make_model

NEW = SeenRuns([], {}, {})


def words(made: Difference) -> list[str]:
    return [verdict(float(a), float(b)) for a, b in zip(made.low, made.high, strict=True)]


def data_set(*runs: Run) -> DataSet:
    return assemble([RawRun(r.name, r.t, r.x, r.u) for r in runs], make_model(Decay).system, kind="csv")


def candidate(name: str, model: NeuralSDE, seen: SeenRuns = NEW, **more: Any) -> Candidate:
    return Candidate(name=name, model=model, seen=seen, **more)


def good(**spec: Any) -> NeuralSDE:
    return fix_sigma(make_model(Decay, **spec), 0.5)


@torch.no_grad()
def bad() -> NeuralSDE:
    """A decay five times too fast."""
    model = good()
    model.system.load_state_dict(make_system(model.spec.system, values={"rate": 5.0}).state_dict())
    return model


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    return decay_runs(2, 30.0, sigma=0.5)


@pytest.fixture(scope="module")
def data(runs: list[Run]) -> DataSet:
    return data_set(*runs)


@pytest.fixture(scope="module")
def three(data: DataSet) -> Comparison:
    """The true model, itself again, and one that is wrong; the last was trained on the first run."""
    seen = SeenRuns.of({"train_runs": ["run_0"], **record(data.runs[:1])})
    models = [candidate("true", good()), candidate("again", good()), candidate("wrong", bad(), seen)]
    return compare(models, data, data.runs, seed=0, particles=39)


def test_figures_of_one_model_are_those_of_a_training(three: Comparison, data: DataSet) -> None:
    expected = evaluate(good(), data.runs, seed=0, particles=39)
    made = three.content["models"][0]
    assert made["errors"] == expected["errors"]["model"]
    for name in ("coverage", "coverage_channels", "crps", "spread", "nll"):
        assert made[name] == expected[name]
    for name in ("hold", "constant_velocity"):
        for group, row in expected["errors"][name].items():
            assert three.content["baselines"][name][group] == pytest.approx(row)
    assert three.content["starts"] == expected["starts"]


def test_equal_models_show_no_difference_and_a_wrong_one_is_worse(three: Comparison) -> None:
    against = three.content["differences"]["against"]
    assert three.content["differences"]["first"] == "true"
    for h in three.content["horizons_s"]:
        same, wrong = (against[name]["errors"]["position"][f"{h:g}"] for name in ("again", "wrong"))
        assert (same["difference"], same["verdict"]) == (0.0, "no difference")
        assert wrong["difference"] == pytest.approx(wrong["other"] - wrong["first"], abs=1e-12)
    assert against["wrong"]["errors"]["position"]["0.25"]["verdict"] == "worse"
    assert {"hold", "constant_velocity"} <= set(against)


def test_models_of_different_steps_are_scored_from_the_same_starts(data: DataSet) -> None:
    models = [candidate("fine", good()), candidate("coarse", good(dt=4 * DT))]
    done = compare(models, data, data.runs, seed=0, particles=9)
    fine, coarse = done.grids
    assert np.array_equal(fine.windows.rows(fine.starts), coarse.windows.rows(coarse.starts))
    assert done.content["horizons_s"] == [0.25, 0.5, 1.0, 2.0]
    texts = " ".join(n["text"] for n in done.content["notes"])
    assert "0.1 s left out: below the step of coarse, 0.2 s" in texts
    assert "0.25 s at 0.2 s, 0.5 s at 0.4 s" in texts
    assert done.content["models"][1]["evaluated_at_s"] == {"0.25": 0.2, "0.5": 0.4, "1": 1.0, "2": 2.0}
    against = done.content["differences"]["against"]["coarse"]["errors"]["position"]
    assert against["0.25"] is against["0.5"] is None
    first, second = (model["errors"]["position"]["1"] for model in done.content["models"])
    assert against["1"]["difference"] == pytest.approx(second - first, abs=1e-6)
    assert any("0.25 s" in line and " - " in line for line, _ in lines(done.content))


class Fragile(NeuralSDE):
    """Leaves the finite numbers from starts above `limit`, a tenth if nothing else is said."""

    limit = 0.1

    def sample(self, x0: torch.Tensor, u: torch.Tensor, **more: Any) -> torch.Tensor:
        if bool((x0 > self.limit).any()):
            raise NonFiniteError("too far")
        return super().sample(x0, u, **more)


def test_a_model_that_diverges_everywhere_has_no_figures_and_the_others_have(
    data: DataSet, tmp_path: Path
) -> None:
    lost = good()
    lost.__class__, lost.limit = Fragile, -math.inf
    for models in ([candidate("lost", lost), candidate("true", good())], [candidate("lost", lost)]):
        done = compare(models, data, data.runs, seed=0, particles=9)
        json.dumps(done.content, allow_nan=False)
        assert done.content["models"][0]["errors"] == {}
        assert any("lost diverged from" in line for line, red in lines(done.content) if red)
        assert len(write_figures(tmp_path / models[-1].name, done)) == (3 if len(models) == 2 else 0)


def test_a_deterministic_model_has_neither_intervals_nor_likelihood(data: DataSet, tmp_path: Path) -> None:
    node = make_model(Decay, step="rk4", kind="node")
    done = compare([candidate("node", node)], data, data.runs, seed=0, particles=9)
    model = done.content["models"][0]
    assert not model["stochastic"]
    assert model["coverage"] is None
    assert model["calibration"] is None
    assert set(model["nll"]["position"].values()) == {None}
    text = "\n".join(line for line, _ in lines(done.content))
    assert "node is deterministic" in text
    assert "interval" not in text.split("node is")[0].replace("intervals and scores", "")
    assert [file.name for file in write_figures(tmp_path, done)] == ["errors.png", "rollouts.png"]


def test_a_model_that_knows_no_other_step_keeps_its_own_and_that_is_red(data: DataSet) -> None:
    class Stubborn(NeuralSDE):
        def sample(self, x0: torch.Tensor, u: torch.Tensor, *, dt: float, **more: Any) -> torch.Tensor:
            if dt != self.spec.dt:
                raise ConfigError("no other step")
            return super().sample(x0, u, dt=dt, **more)

    model = good()
    model.__class__ = Stubborn
    model.clock_scale.fill_(1.25)
    done = compare([candidate("stubborn", model)], data, data.runs, seed=0, particles=9)
    assert done.grids[0].dt == DT
    assert any(n["red"] and "knows no step but its own" in n["text"] for n in done.content["notes"])


@pytest.mark.parametrize(
    ("names", "models", "horizons", "error", "words"),
    [
        (["a", "a"], [good, good], None, ConfigError, "name of two models"),
        (["hold"], [good], None, ConfigError, "baseline"),
        (["a", "b"], [good, lambda: make_model(Gusty)], None, ConfigError, "only models of one system"),
        (["a"], [lambda: good(dt=0.07)], None, ConfigError, "no whole multiple of the data's 0.05 s"),
        (["a"], [good], [0.01], ConfigError, "below the step of 'a'"),
        (["a"], [good], [], ConfigError, "empty"),
        (["a"], [good], [100.0], DataError, "longest stretch"),
    ],
)
def test_what_cannot_be_compared_is_refused_before_any_work(
    data: DataSet, names: list[str], models: list[Any], horizons: Any, error: type[Exception], words: str
) -> None:
    made = [candidate(name, model()) for name, model in zip(names, models, strict=True)]
    with pytest.raises(error, match=words):
        compare(made, data, data.runs, seed=0, horizons=horizons)


def test_a_model_takes_the_columns_that_it_reads(runs: list[Run]) -> None:
    """Data read for several models may hold more than one of them reads."""
    wide = [Run(r.name, r.t, r.x, np.column_stack([r.u, np.full(len(r), 9.0)])) for r in runs]
    data = data_set(*runs)
    both = replace(data, runs=tuple(wide), input_names=("u", "voltage"))
    seen = SeenRuns.of({"train_runs": ["run_0"], **record(runs[:1])})
    made, expected = (
        compare([candidate("true", good(), seen)], d, d.runs, seed=0, particles=9) for d in (both, data)
    )
    assert made.content["models"] == expected.content["models"]
    assert made.content["models"][0]["trained_on_match"]["run_0"] == "whole"
    with pytest.raises(DataError, match="needs the columns x, u"):
        compare([candidate("true", good())], replace(data, input_names=("w",)), data.runs, seed=0)


def test_inputs_that_are_not_smoothed_as_those_of_training_are_pointed_out(data: DataSet) -> None:
    models = [candidate("a", good(), smoothing=0.4, reach=0.2), candidate("b", good())]
    done = compare(models, data, data.runs, seed=0, particles=9)
    texts = [n["text"] for n in done.content["notes"]]
    assert any(
        "a was trained on inputs smoothed over 0.4 s" in text and "all the same" in text for text in texts
    )
    assert not any(text.startswith("b was trained") for text in texts)


def test_interventions_are_where_predictions_start_and_the_report_says_so(runs: list[Run]) -> None:
    raw = []
    for run in runs:
        on = np.zeros(len(run))
        on[200:225] = on[500:520] = 1.0
        raw.append(RawRun(run.name, run.t, run.x, run.u, extra={"intervention": on}))
    data = assemble(raw, make_model(Decay).system, kind="csv")
    done = compare([candidate("true", good())], data, data.runs, seed=0, particles=19)
    content = done.content
    assert (content["starts"], content["start_every_s"]) == (4, None)
    assert content["data"]["inputs"] == "interventional"
    assert content["horizons_s"][-1] == 1.0  # what fits behind the starts, whatever the length of the runs
    _, t = done.grids[0].located()
    np.testing.assert_allclose(np.sort(t), np.sort([run.t[k] for run in runs for k in (200, 500)]))
    text = "\n".join(line for line, _ in lines(content))
    assert "4 interventions (inputs do not depend on the state), 19 paths each" in text
    assert "errors and intervals tell what an input does" in " ".join(text.split())


QUARTER = 0.25


def one_run(starts: int) -> Blocks:
    """Blocks of 4 s of a single run."""
    return make_blocks(np.zeros(starts, dtype=np.int64), QUARTER * np.arange(starts), length=4.0)


def correlated(shape: tuple[int, int], tau: float, rng: np.random.Generator) -> np.ndarray:
    """Stationary unit Gaussian sequences (columns) with the correlation exp(-t / tau)."""
    keep = math.exp(-QUARTER / tau)
    out = np.empty(shape)
    out[0] = rng.standard_normal(shape[1])
    for k in range(1, shape[0]):
        out[k] = keep * out[k - 1] + math.sqrt(1 - keep**2) * rng.standard_normal(shape[1])
    return out


def held(tau: float, *, runs: int, seconds: float) -> float:
    """Share of 400 repetitions in which the 95 % interval holds the true difference of two correlated errors."""
    rng, n, many = np.random.default_rng(0), round(seconds / QUARTER), 400
    parts = []
    for _ in range(runs):
        shared, own, other = (correlated((n, many), tau, rng) for _ in range(3))
        parts.append((shared + 0.5 * own, 0.9 * shared + 0.7 * other))
    first, second = (torch.from_numpy(np.concatenate([p[k] for p in parts])) ** 2 for k in range(2))
    run, t = np.repeat(np.arange(runs), n), np.tile(QUARTER * np.arange(n), runs)
    blocks = make_blocks(run, t, length=4.0)
    made = paired_bootstrap(first, second, blocks, generator=generator(), replicates=600)
    truth = math.sqrt(0.81 + 0.49) - math.sqrt(1.25)
    return float(((made.low <= truth) & (made.high >= truth)).double().mean())


@pytest.mark.parametrize(
    ("tau", "runs", "seconds"), [(0.1, 1, 60.0), (0.5, 3, 40.0), (1.0, 3, 60.0), (0.5, 12, 20.0)]
)
def test_intervals_hold_the_true_difference_of_errors_correlated_in_time(
    tau: float, runs: int, seconds: float
) -> None:
    assert 0.89 <= held(tau, runs=runs, seconds=seconds) <= 0.98


def test_the_difference_is_that_of_the_root_mean_squares_in_its_sign() -> None:
    first = torch.rand(400, 2, generator=generator(), dtype=torch.float64) + 1
    other = first * torch.tensor([4.0, 0.25])
    blocks = one_run(400)
    made = paired_bootstrap(first, other, blocks, generator=generator())
    root = first.mean(0).sqrt()
    torch.testing.assert_close(made.value, root * torch.tensor([1.0, -0.5]))
    assert words(made) == ["worse", "better"]
    assert bool(((made.low < made.value) & (made.value < made.high)).all())


def test_too_few_blocks_are_said_to_be_so() -> None:
    first, other = torch.rand(2, 48, 1, generator=generator())
    made = paired_bootstrap(first, other, one_run(48), generator=generator())
    assert one_run(48).count == 3
    assert words(made) == ["too few blocks"]
    assert bool(made.value.isfinite())


def noisy(name: str, seed: int, rows: int = 2000) -> Run:
    rng = np.random.default_rng(seed)
    return Run(name, 0.01 * np.arange(rows), rng.standard_normal((rows, 3)), rng.standard_normal((rows, 1)))


TRAINED = [noisy("a", 0), noisy("b", 1, rows=50)]
SEEN = SeenRuns.of({"train_runs": ["a", "b"], **record(TRAINED)})


A, B = TRAINED
OTHER = noisy("c", 2)


def joined(first: Run, then: np.ndarray) -> Run:
    x = np.concatenate([first.x, then])
    return Run("long", 0.01 * np.arange(len(x)), x, np.zeros((len(x), 1)))


@pytest.mark.parametrize(
    ("run", "found"),
    [
        (A, "whole"),
        (replace(A, name="another", t=A.t + 7), "whole"),
        *((A.slice(*rows, name="cut"), "part") for rows in ((0, 200), (700, 1000), (1800, 2000))),
        (Run("a", A.t[::5], A.x[::5], A.u[::5]), "part"),
        (replace(A, u=np.column_stack([A.u, A.u])), "part"),
        (joined(noisy("long", 5), B.x), "part"),
        (OTHER, ""),
        (noisy("a", 2), "same name"),
        (replace(OTHER, x=np.concatenate([A.x[:2], OTHER.x[2:]])), ""),
    ],
    ids=[
        *("itself", "another name and clock", "its beginning", "a tenth of it", "its end", "another step"),
        *(
            "other inputs", "a recording that holds it", "another run", "a namesake", "another from its first state",
        ),
    ],
)  # fmt: skip
def test_a_training_run_is_found_in_what_holds_some_of_it_and_in_nothing_else(run: Run, found: str) -> None:
    assert SEEN.match(run) == found
