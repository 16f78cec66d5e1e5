"""A diagnosis that is stopped, or goes on, leaves what is known, marked as such; progress names what was found."""

import io
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import nsde_torch
from nsde_torch.data import DataSet
from nsde_torch.diagnosis.files import EFFECTS, REPORT, RESULT
from nsde_torch.diagnosis.result import Diagnosis
from nsde_torch.diagnosis.stages import ERRORS, SELECTION, STOPPED, TESTS
from nsde_torch.diagnosis.text import lines
from nsde_torch.effects import files as effects_files
from nsde_torch.errors import CheckpointError, ConfigError, DataError
from nsde_torch.progress import Stages
from nsde_torch.time_limit import TimeLimit, check_time
from nsde_torch.whole_files import write_whole
from tests.helpers.diagnosed import recorded

SPRING, FRICTION = "mass_spring_damper", "coulomb_friction"


@cache
def made() -> DataSet:
    return recorded(SPRING, {FRICTION: {"size": 0.3}}, durations=[3.0] * 3, dt=0.02)


def _diagnosed(**options: Any) -> Diagnosis:
    return nsde_torch.diagnose(made(), system=SPRING, candidates=[FRICTION], **options)


@cache
def stopped(at: str) -> Diagnosis:
    """A diagnosis that is stopped as this stage begins."""

    def say(stage: str, done: int, total: int) -> None:
        if stage.startswith(at):
            raise KeyboardInterrupt

    return _diagnosed(say=say)


@pytest.mark.parametrize(
    ("at", "verdict", "added", "first"),
    [
        ("round 1: trying 1 effect", "undecided", [], SELECTION),
        ("testing what is left", "undecided", [FRICTION], TESTS),
        (ERRORS, "effect_found", [FRICTION], ERRORS),
    ],
)
def test_what_is_known_is_kept_where_it_is_stopped(
    tmp_path: Path, at: str, verdict: str, added: list[str], first: str
) -> None:
    found = stopped(at)
    found.save(tmp_path)
    content = json.loads((tmp_path / RESULT).read_text())
    assert content["so_far"].keys() == {"stopped_during", "stopped_after_min", "roughly_left_s", "declared"}
    assert content["so_far"]["stopped_during"] == at
    assert content["so_far"]["stopped_after_min"] is content["so_far"]["roughly_left_s"] is None
    assert (content["verdict"], content["added"]) == (verdict, added)
    assert content["not_done"][0] == {"stage": first, "why": STOPPED}
    assert lines(content)[0].startswith(f"so far: stopped during {at}; not done: {first}, ")
    assert all(f["lead"] and f["lead_reason"] for f in content["findings"])
    own = {**content["parameters"], **content["declared_parameters"]}
    assert own
    assert all(p["provisional"] for p in own.values())
    text = (tmp_path / EFFECTS).read_text()
    assert text.startswith("# so far, not finished: ")
    assert list(effects_files.read(tmp_path / EFFECTS)[1]) == added
    assert f"stopped during {at}" in (tmp_path / REPORT).read_text().partition('<div class="verdict')[0]
    with pytest.raises(KeyboardInterrupt):
        found.finished()


def test_before_anything_is_known_it_is_an_interrupt_as_ever() -> None:
    with pytest.raises(KeyboardInterrupt):
        stopped("fitting the declared physics")


def test_a_resumed_diagnosis_goes_on_from_what_was_selected(tmp_path: Path) -> None:
    stopped("testing what is left").save(tmp_path)
    told: list[tuple[str, list[str]]] = []
    rounds: list[str] = []

    def say(stage: str, done: int, total: int) -> None:
        rounds.extend([stage] if stage.startswith("round 1: trying") else [])

    def so_far(known: Diagnosis) -> None:
        told.append((known.verdict, known.added))

    found = _diagnosed(say=say, resume=tmp_path, so_far=so_far)
    assert told[0] == ("undecided", [FRICTION])  # before any round: an interrupt loses nothing
    assert all(added == [FRICTION] for _, added in told)
    assert not [stage for stage in rounds if "1 effect" in stage]
    assert (found.verdict, found.added) == ("effect_found", [FRICTION])
    assert found.parameters[f"{FRICTION}.size"]["value"] == pytest.approx(0.3, abs=0.02)


@pytest.mark.slow
def test_only_the_same_data_and_model_are_gone_on_with(tmp_path: Path) -> None:
    known = stopped("round 1: trying 1 effect")
    known.save(tmp_path)
    other = nsde_torch.simulate(SPRING, durations=[3.0] * 3, dt=0.02, seed=2)
    with pytest.raises(DataError, match="looked at other data: fingerprint was "):
        nsde_torch.diagnose(other, system=SPRING, resume=tmp_path)
    with pytest.raises(DataError, match=r"runs was \['run_0', .* and is \['run_0', 'run_1'\] now"):
        nsde_torch.diagnose(made(), system=SPRING, resume=tmp_path, test=[2])
    with pytest.raises(ConfigError, match=r"its effects was \[\], and is \['quadratic_damping'\] now"):
        nsde_torch.diagnose(made(), system=SPRING, effects="quadratic_damping", resume=tmp_path)
    with pytest.raises(CheckpointError, match="no diagnosis to go on with"):
        nsde_torch.diagnose(made(), system=SPRING, resume=tmp_path / "elsewhere")
    replace(known, so_far=None).save(tmp_path)
    with pytest.raises(CheckpointError, match="came to its end"):
        nsde_torch.diagnose(made(), system=SPRING, resume=tmp_path)


def test_a_line_says_what_was_found_and_roughly_how_long_is_left() -> None:
    stream = io.StringIO()
    stages = Stages(stream)
    stages("round 1: trying 57 effects", 0, 57)
    stages.known("motor_lag (+812 nats)", 61.0)
    stages("round 2: trying 56 effects", 0, 56)
    stages.known("motor_lag (+812 nats)", 300.0)
    stages("round 3: trying 55 effects", 0, 55)
    stages.known("motor_lag (+812 nats)", 0.0)  # it took longer than that: nothing is said of it
    stages("testing what is left", 0, 1)
    assert stream.getvalue().splitlines() == [
        "[    0 s] round 1: trying 57 effects",
        "[    0 s] round 2: trying 56 effects; so far: motor_lag (+812 nats); roughly 60 s left",
        "[    0 s] round 3: trying 55 effects; so far: motor_lag (+812 nats); roughly 5 min left",
        "[    0 s] testing what is left; so far: motor_lag (+812 nats)",
    ]


def test_a_stage_that_lasts_is_said_again(monkeypatch: pytest.MonkeyPatch) -> None:
    stream, now = io.StringIO(), [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    monkeypatch.setattr("nsde_torch.time_limit.perf_counter", lambda: now[0])
    stages = Stages(stream)
    stages("round 5: trying 44 effects", 0, 44)
    with TimeLimit(None, lambda: stages("round 5: trying 44 effects", 0, 44)):
        for _ in range(70):
            now[0] += 1.0
            check_time()
    assert stream.getvalue().splitlines() == [
        f"[{seconds:5d} s] round 5: trying 44 effects" for seconds in (0, 31, 62)
    ]


def test_an_interrupt_leaves_no_half_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / RESULT
    write_whole(path, "whole")

    def half(self: Path, text: str, encoding: str) -> int:
        with self.open("w", encoding=encoding) as file:
            file.write(text[:2])
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_text", half)
    with pytest.raises(KeyboardInterrupt):
        write_whole(path, "other")
    assert path.read_text() == "whole"
