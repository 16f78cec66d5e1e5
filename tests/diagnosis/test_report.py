"""`report.html` and the terminal say what was found, and what was not."""

import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from nsde_torch.diagnosis.report import write_report
from nsde_torch.diagnosis.text import lines, short_lines
from nsde_torch.diagnosis.time_series import plotly_script
from nsde_torch.evaluation.report import between_ends, number
from tests.helpers.diagnosed import Diagnosed, pushed_spring, sound_spring

_VOID = {"meta", "br", "img"}


class _Balanced(HTMLParser):
    """Refuses tags that are not closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.images = 0

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.images += tag == "img"
        if tag not in _VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def _with_a_blind_spot(case: Diagnosed) -> Diagnosed:
    """The same diagnosis of data that could not show one effect, as `diagnosis.json` has it."""
    unseen = {
        **{"effect": "input_delay", "parameter": "input_delay.delay", "smallest": 0.031, "usual": 0.05},
        **{"unit": "s", "experiment": "inputs that change within some milliseconds", "declared": False},
    }
    return case[0], {**case[1], "not_shown": [unseen]}


def written(folder: Path, case: Diagnosed) -> tuple[str, int]:
    """The page, and the number of its pictures."""
    diagnosis, content = case
    write_report(folder / "report.html", diagnosis, json.loads(json.dumps(content, allow_nan=False)))
    page = (folder / "report.html").read_text(encoding="utf-8")
    parser = _Balanced()
    parser.feed(page)
    assert parser.open == []
    return page, parser.images


@pytest.mark.slow
def test_the_page_loads_nothing_and_fits_a_phone(tmp_path: Path) -> None:
    page, images = written(tmp_path, pushed_spring())
    # the script can ask for maps; that it asks for nothing: test_time_series
    own = page.replace(plotly_script(), "")
    assert not re.search(r"(src|href)=\"(?!data:image/png;base64,)", own)
    assert "http" not in own
    assert "@import" not in own
    assert len(own) < 1_000_000
    assert 'name="viewport"' in page
    assert len(page) < 6_000_000
    names = {p.name for p in (tmp_path / "plots").iterdir()}
    assert names >= {"residual.png", "held_out.png", "errors.png", "spectrum.png"}
    assert images == len(names)


def test_the_page_names_the_effect_its_values_its_tie_and_the_experiment(tmp_path: Path) -> None:
    page, _ = written(tmp_path, _with_a_blind_spot(pushed_spring()))
    _, content = pushed_spring()
    text = re.sub(r"<[^>]+>", " ", re.sub(r"<style>.*?</style>", "", page))
    words = "Found what is missing", "constant_force", "Indistinguishable.", "sensor_bias", "left before"
    words += "beside everything else: log-likelihood", "All effects that were tried"
    words += "What these data cannot show", "0.031 s", content["findings"][0]["sentence"]
    assert [word for word in (*words, content["ties"][0]["experiment"]) if word not in text] == []
    # what runs left out say of steps comes before predictions, which are called what they are
    first, second = text.index("Log-likelihood of one-step predictions"), text.index("Open-loop, inputs")
    assert first < text.index("Before and after, on runs left out") < second


@pytest.mark.slow
def test_a_page_of_nothing_found_shows_the_residual_and_the_floor(tmp_path: Path) -> None:
    page, images = written(tmp_path, sound_spring())
    assert images == 2
    assert "Nothing is missing" in page
    assert "→" not in page


def test_the_terminal_says_the_same() -> None:
    said = "\n".join(lines(_with_a_blind_spot(pushed_spring())[1]))
    assert said.startswith("verdict: effect_found")
    words = "constant_force.acceleration", "90 % interval", "indistinguishable from sensor_bias"
    for word in (*words, "cannot show", "input_delay: delay below 0.031 s"):
        assert word in said
    # residual and likelihood come before predictions, which are called what they are
    first, second = said.index("log-likelihood [nat]"), said.index("open-loop, inputs replayed from the log")
    assert first < second < said.index("position [m]")


def test_the_short_text_fits_a_screen_and_has_every_finding_with_its_interval(root: Path) -> None:
    content = json.loads((root / "tests" / "golden" / "diagnosis.json").read_text(encoding="utf-8"))
    text = short_lines(content)
    assert len(text) <= 20 < len("\n".join(lines(content)).splitlines())
    assert text[0] == f"verdict: {content['verdict']}"
    for name in content["told"]["few"]:
        own = next(line for line in text if line.startswith(f"{name}: "))
        for key, p in content["parameters"].items():
            if key.startswith(f"{name}.") and p["interval_90"] and not p["bound"]:
                assert between_ends(p["interval_90"]) in own
    assert any(line.startswith("these data cannot show: ") for line in text) == bool(content["not_shown"])


@pytest.mark.parametrize(
    ("value", "width", "text"),
    [
        (0.397312, 0.0079, "0.3973"),
        (4.6, 0.1386, "4.600"),
        (1034.2, 240.0, "1030"),
        (0.02, 3.0, "0"),
        (-0.0000123456, 0.000002, "-1.23e-05"),
        (7.0, math.inf, "7"),
        (0.0, 0.0, "0"),
        (123456.0, 20.0, "1.23456e+05"),
    ],
)
def test_a_value_has_the_digits_that_half_of_its_interval_has(value: float, width: float, text: str) -> None:
    assert number(value, width) == text
