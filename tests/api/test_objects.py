"""What a notebook shows of data, models, scores and predictions, and what they are as tables."""

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import nsde_torch
from nsde_torch.data import DataSet
from nsde_torch.errors import ConfigError, DataError, ShapeError
from nsde_torch.evaluation.comparison import Comparison
from nsde_torch.models import Model, SDESpec, make_model


@pytest.fixture(scope="module")
def data() -> DataSet:
    made = nsde_torch.simulate("mass_spring_damper", durations=[5.0] * 3, seed=1)
    return nsde_torch.read(made, system="mass_spring_damper")


@pytest.fixture(scope="module")
def model(data: DataSet) -> Model:
    return nsde_torch.train(data, system="mass_spring_damper", model="sysid", say=False)


@pytest.fixture(scope="module")
def scores(data: DataSet, model: Model) -> Comparison:
    return nsde_torch.evaluate({"fitted": model}, data, runs=[2], particles=2, bootstrap=100, say=False)


@pytest.fixture
def pandas(monkeypatch: pytest.MonkeyPatch) -> None:
    """A package of that name whose frame is a dict of columns."""

    def frame(values: Any, columns: Any = None) -> dict[str, list[Any]]:
        named = () if columns is None else enumerate(columns)
        return dict(values) if columns is None else {name: [row[k] for row in values] for k, name in named}

    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=frame))  # type: ignore[arg-type]


def test_each_has_a_line_and_a_page_of_its_own(data: DataSet, model: Model, scores: Comparison) -> None:
    assert repr(model) == "<Model sysid of mass_spring_damper: 3 parameters, steps of 0.01 s>"
    assert "linear_spring.stiffness = " in model._repr_html_()
    assert repr(scores).startswith("<Comparison of fitted on mass_spring_damper: ")
    assert "rms error, inputs replayed" in scores._repr_html_()
    assert data._repr_html_().startswith("<pre>data: ")
    assert "found: nothing amiss" in data._repr_html_()
    assert repr(data) == "<DataSet of mass_spring_damper: 3 runs, 15.0 s at 100 Hz>"
    assert repr(data.runs[1]) == "<Run 'run_1': 501 rows, 5 s>"
    found = model.predict(data[2], horizon=0.5)
    assert repr(found) == "<RunPrediction of 'run_2': 10 starts, 0.5 s each, 90 % intervals>"
    assert "no intervals, as the model has no noise" in found._repr_html_()
    assert found.coverage is None


@pytest.mark.usefixtures("pandas")
def test_tables_hold_what_was_found(data: DataSet, model: Model, scores: Comparison) -> None:
    rows = data.to_frame()
    assert list(rows) == ["run", "t", "q", "q_dot", "force"]
    np.testing.assert_array_equal(rows["q"], np.concatenate([run.x[:, 0] for run in data]))
    assert (rows["run"][0], rows["run"][-1]) == ("run_0", "run_2")
    parameters = model.to_frame()
    values = dict(zip(parameters["name"], parameters["value"], strict=True))
    assert values["force_gain"] == pytest.approx(1, abs=0.1)
    errors = scores.to_frame()
    at = list(zip(errors["group"], errors["horizon"], strict=True)).index(("position", 0.5))
    assert errors["error"][at] == scores.errors["position"]["0.5"]
    assert errors["unit"][at] == "m"
    found = nsde_torch.diagnose(data, system="mass_spring_damper", candidates=[], say=False).to_frame()
    assert list(found) == ["name", "value", "low", "high", "unit"]
    predicted = list(model.predict(data[0], horizon=0.5).to_frame())
    assert predicted[:6] == ["t", "ahead", "q", "q_low", "q_median", "q_high"]


def test_without_pandas_a_table_says_what_to_install(data: DataSet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="needs pandas, which is not installed: pip install pandas"):
        data.to_frame()


def test_a_prediction_begins_at_what_was_measured_and_its_intervals_hold_their_share(data: DataSet) -> None:
    spec = SDESpec("mass_spring_damper", dt=0.02, horizon=10, step="euler_maruyama", sigma_max=(0.0, 0.3))
    model = make_model(spec, generator=torch.Generator().manual_seed(0))
    found = model.predict(data[1], horizon=0.5, level=0.8, seed=3)
    first = found.ahead == 0
    assert first.sum() == 10
    np.testing.assert_allclose(found.t[first], data[1].t[0] + 0.5 * np.arange(10), atol=1e-9)
    np.testing.assert_allclose(found.median[first], data[1].x[::50][:10], atol=1e-6)
    assert bool((found.low <= found.median).all() and (found.median <= found.high).all())
    narrow = model.predict(data[1], horizon=0.5, level=0.2, seed=3)
    assert narrow.coverage is not None
    assert found.coverage is not None
    assert narrow.coverage["q_dot"] < found.coverage["q_dot"]
    same = model.predict(data[1], horizon=0.5, level=0.8, seed=3)
    np.testing.assert_array_equal(same.low, found.low)
    figure = found.plot()
    assert [axes.get_ylabel() for axes in figure.axes] == ["q [m]", "q_dot [m/s]"]
    assert "80 % predicted" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_what_cannot_be_predicted_is_refused_by_its_name(data: DataSet, model: Model) -> None:
    for given, error, message in (
        ({"horizon": 0.001}, ConfigError, "`horizon` must be at least the model's step of 0.01 s"),
        ({"horizon": 1.0, "level": 90}, ConfigError, "`level` must lie between 0 and 1; got 90"),
        (
            {"horizon": 1.0, "inputs": "given"},
            ConfigError,
            "`inputs` must be logged, replayed or set; got 'given'",
        ),
        ({"horizon": 99.0}, DataError, "no segment is as long as a window"),
    ):
        with pytest.raises(error, match=message):
            model.predict(data[0], **given)
    with pytest.raises(ConfigError, match="`run` must be one run of a data set"):
        model.predict(data, horizon=1.0)  # type: ignore[arg-type]
    cart = nsde_torch.simulate("cartpole", durations=[3.0], seed=1)
    with pytest.raises(ShapeError, match="`run` must be of the model's system, 'mass_spring_damper'"):
        model.predict(nsde_torch.read(cart, system="cartpole")[0], horizon=0.5)
