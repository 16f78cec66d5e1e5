"""Blind cases: what a list holds, and that the files of a case do not say what is in it."""

import importlib
import json
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks" / "blind"
SPRING = ("mass_spring_damper",)

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="the benchmarks are not part of a wheel")


@pytest.fixture
def generate(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module("generate")


def test_equal_seeds_make_equal_cases_and_a_longer_list_begins_as_a_shorter_one(generate: ModuleType) -> None:
    few, many = generate.cases(5, 3, systems=SPRING), generate.cases(5, 8, systems=SPRING)
    assert many[:3] == few
    assert generate.cases(6, 3, systems=SPRING) != few


def test_every_effect_of_a_plant_takes_its_turn_at_both_levels_of_noise(generate: ModuleType) -> None:
    names = generate.holdable("mass_spring_damper")
    assert {"coulomb_friction", "input_delay", "periodic_force"} < set(names)
    made = generate.cases(5, 2 * len(names), systems=SPRING, kinds=["single"])
    assert Counter(name for case in made for name in case.effects) == dict.fromkeys(names, 2)
    assert len({(name, case.noise) for case in made for name in case.effects}) == 2 * len(names)


def test_every_kind_is_there_and_holds_what_it_says(generate: ModuleType) -> None:
    made = generate.cases(5, 36, systems=SPRING)
    assert {case.kind for case in made} == set(generate.KINDS)
    for case in made:
        count = {"single": 1, "pair": 2, "outside": 1}.get(case.kind, 0)
        assert len(case.effects) == count
        assert bool(case.recording) == (case.kind == "recording")
        assert all((":" in key) == (case.kind == "outside") for key in case.effects)


@pytest.mark.parametrize("kind", ["single", "outside", "recording", "null"])
@pytest.mark.slow
def test_a_case_is_written_as_data_and_truth_apart(generate: ModuleType, kind: str, tmp_path: Path) -> None:
    case = generate.cases(3, 1, systems=SPRING, kinds=[kind])[0]
    data = generate.write(case, tmp_path)
    assert data == tmp_path / "data" / "case_000"
    assert {p.suffix for p in data.iterdir()} == {".csv"}
    assert (data / "run_0.csv").read_text().splitlines()[0] == "t,q,q_dot,force"
    truth = json.loads((tmp_path / "truth" / "case_000.json").read_text())
    assert truth["case"]["kind"] == kind
    assert len(truth["effects"]) == len(case.effects)
    assert bool(truth["recording"]) == (kind == "recording")
