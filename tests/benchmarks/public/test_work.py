"""Stages are kept whole, used again, and refused where they are of something else."""

from pathlib import Path

import pytest

from nsde_benchmarks.public.files import Work, key_of
from nsde_benchmarks.public.output_error import silent
from nsde_torch.errors import CheckpointError


def test_a_finished_stage_is_not_run_again(tmp_path: Path) -> None:
    told: list[str] = []
    for count in range(2):
        work = Work(tmp_path, "key", say=silent, tell=told.append)
        assert work.stage("a", lambda n=count: {"made": n}) == {"made": 0}
    assert told == ["kept from before: a"]


def test_an_interrupted_stage_leaves_nothing(tmp_path: Path) -> None:
    def interrupted() -> dict[str, int]:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Work(tmp_path, "key", say=silent, tell=print).stage("a", interrupted)
    assert not list(tmp_path.rglob("*"))


def test_stages_of_other_files_and_damaged_ones_are_refused(tmp_path: Path) -> None:
    Work(tmp_path, "key", say=silent, tell=print).stage("a", lambda: {"made": 1})
    words = r"of other files or settings than these. Name another `out_dir`"
    with pytest.raises(CheckpointError, match=words):
        Work(tmp_path, "other", say=silent, tell=print).stage("a", lambda: {"made": 2})
    (tmp_path / "stages" / "a.json").write_text('{"key": "key"')
    with pytest.raises(CheckpointError, match="is damaged"):
        Work(tmp_path, "key", say=silent, tell=print).stage("a", lambda: {"made": 3})


def test_the_key_follows_the_content_of_the_files(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("1")
    first = key_of("set", [path], {})
    path.write_text("2")
    assert first != key_of("set", [path], {}) != key_of("set", [path], {"version": 2})
