"""The log over time in `report.html`: what is shown is what was logged, by a script that a server can allow alone."""

import base64
import json
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from nsde_torch.diagnosis.report import page
from nsde_torch.diagnosis.time_series import thinned, time_series
from tests.helpers.browser import chromium
from tests.helpers.diagnosed import pushed_spring

pytestmark = pytest.mark.drawn

TEXTS = "return [...document.querySelectorAll(arguments[0])].map((e) => e.textContent)"
LINES = (
    "return [...document.querySelectorAll('#charts .scatterlayer .js-line')].map((e) => e.getAttribute('d'))"
)
SHOWN = "return document.querySelector('#charts .js-plotly-plot').layout.xaxis.range"
ASKED = "return performance.getEntriesByType('resource').map((e) => e.name)"
RUN = "const r = document.getElementById('run'); r.value = 2; r.dispatchEvent(new Event('change'))"


def values(encoded: list[Any]) -> np.ndarray[Any, Any]:
    low, size, packed = encoded
    whole = np.frombuffer(base64.b64decode(packed), "<i2").astype(float)
    return np.where(whole == -32768, np.nan, low + (whole + 32767) * size)


@pytest.mark.slow
def test_states_inputs_and_residuals_of_every_run_are_there() -> None:
    found = pushed_spring()[0]
    content = json.loads(time_series(found))
    assert [run["name"] for run in content["runs"]] == list(found.runs)
    assert [c["names"] for c in content["charts"]] == [
        ["q"],
        ["q_dot"],
        ["force"],
        ["q_dot before", "q_dot after"],
        ["q_dot measured", "q_dot before", "q_dot after", "q_dot low", "q_dot high"],
    ]
    for run, shown in zip(found.data.runs, content["runs"], strict=True):
        q = values(shown["log"]["y"]["q"])
        assert np.isnan(q[-1])  # a stretch ends
        assert np.allclose(q[:-1], run.x[:, 0], atol=1e-4 * np.ptp(run.x[:, 0]))
        assert np.allclose(shown["log"]["t"][:-1], run.t)
        before, after = (values(shown["left"]["y"][f"q_dot {name}"]) for name in ("before", "after"))
        assert before.mean() == pytest.approx(0.2, abs=0.05)
        assert after.mean() == pytest.approx(0.0, abs=0.05)


def test_predictions_have_a_band_that_holds_nine_in_ten_of_what_was_measured() -> None:
    found = pushed_spring()[0]
    made = found.errors.predictions
    assert made.horizon == 1.0
    content = json.loads(time_series(found))
    errors, inside = {"before": [], "after": []}, []
    for run, shown in zip(found.data.runs, content["runs"], strict=True):
        ahead = {name.removeprefix("q_dot "): values(y) for name, y in shown["ahead"]["y"].items()}
        t = np.array(shown["ahead"]["t"])
        begun = np.flatnonzero(np.isnan(np.append(np.nan, ahead["after"][:-1])))  # after each gap
        kept = ~np.isnan(ahead["measured"])
        assert np.allclose(np.diff(t[begun]), 1.0)
        assert np.allclose(ahead["measured"][kept], np.interp(t[kept], run.t, run.x[:, 1]), atol=1e-3)
        assert np.allclose(
            ahead["after"][begun], ahead["measured"][begun], atol=1e-3
        )  # from what was measured
        kept[begun] = False
        for name, own in errors.items():
            own.extend(ahead[name][kept] - ahead["measured"][kept])
        inside.extend((ahead["low"] <= ahead["measured"])[kept] & (ahead["measured"] <= ahead["high"])[kept])
    assert np.mean(inside) == pytest.approx(0.9, abs=0.06)
    assert np.std(errors["after"]) < 0.6 * np.std(errors["before"])


def test_of_a_long_log_no_spike_is_lost() -> None:
    t, y = 0.01 * np.arange(50_000), np.zeros((50_000, 2))
    y[12_345, 0], y[40_001, 1] = 9.0, -7.0
    few, shown = thinned(t, y, 1000)
    assert len(few) == len(shown) == pytest.approx(1000, rel=0.02)
    assert (np.diff(few) > 0).all()
    assert shown[:, 0].max() == 9.0
    assert shown[:, 1].min() == -7.0
    assert abs(few[shown[:, 0].argmax()] - 123.45) < 1.0


@pytest.mark.slow
def test_the_page_draws_them_in_a_browser(tmp_path: Path) -> None:
    found = pushed_spring()[0]
    series = time_series(found).replace('"path":[]', '"path":["q","q_dot","force"]')  # as of a flight
    (tmp_path / "report.html").write_text(
        page(found.content(), {}, width=0.25, series=series), encoding="utf-8"
    )
    with chromium(tmp_path / "profile") as driver:
        from selenium.webdriver.common.action_chains import ActionChains
        from selenium.webdriver.support.ui import WebDriverWait

        def until(script: str, reached: Callable[[Any], bool], *given: str) -> Any:
            wait = WebDriverWait(driver, 20, poll_frequency=0.05)
            wait.until(lambda _: reached(driver.execute_script(script, *given)))
            return driver.execute_script(script, *given)

        driver.get((tmp_path / "report.html").as_uri())
        left = "what the physics leaves of q_dot, before, after [m/s2]"
        titles = driver.execute_script(TEXTS, "#charts .annotation-text")
        ahead = "predictions of q_dot, measured, before, after [m/s]"
        assert titles == ["q [m]", "q_dot [m/s]", "force [N]", left, ahead]
        chart = driver.find_element("css selector", "#charts .nsewdrag")
        ActionChains(driver).move_to_element(chart).perform()
        time, *values = until(TEXTS, bool, "#charts .hoverlayer text")
        assert float(time.removesuffix(" s")) == pytest.approx(4.0, abs=0.1)  # the middle of 8 s
        names = "q, q_dot, force, q_dot before, q_dot after, q_dot measured, q_dot before, q_dot after"
        assert ", ".join(text.partition(" : ")[0] for text in values) == names  # of all charts
        whole = driver.execute_script(LINES)
        assert len(whole) == 5 + 8 * 4  # eight predictions of 1 s: three lines and a band
        across = ActionChains(driver).move_to_element(chart).click_and_hold()
        across.move_by_offset(round(chart.rect["width"] / 4), 0).release().perform()
        until(SHOWN, lambda ends: ends == pytest.approx([4.0, 6.0], abs=0.1))
        until(LINES, lambda zoomed: not set(zoomed) & set(whole))  # all charts
        ActionChains(driver).double_click(chart).perform()
        until(LINES, lambda again: again == whole)
        driver.execute_script(RUN)
        until(LINES, lambda other: not set(other) & set(whole))
        space = driver.find_element("css selector", "#charts canvas")
        red, _, blue = imread(BytesIO(space.screenshot_as_png))[..., :3].T
        assert (blue - red > 0.3).sum() > 200  # the line of the path
        assert not driver.execute_script(ASKED)
        assert not [e for e in driver.get_log("browser") if e["level"] == "SEVERE"]
