"""`nsde benchmark`: the list, a run, its stages, and what is said of wrong words, folders and files."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from nsde_benchmarks.public import BENCHMARKS
from nsde_benchmarks.public.command import COMMAND
from nsde_benchmarks.public.files import Work, matrices, table
from nsde_benchmarks.public.output_error import silent
from nsde_torch.errors import CheckpointError, DataError


def test_without_words_it_lists_the_sets(capsys: pytest.CaptureFixture[str]) -> None:
    assert COMMAND.main([]) == 0
    out = capsys.readouterr().out
    assert "fetch: biaslab/nsi-silverbox" in out
    assert "nsde benchmark NAME data.path=FOLDER" in out


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["emps"], "data.path"),
        (["nothing", "data.path=here"], "benchmark 'nothing' is unknown; choose among emps"),
        (["emps", "data.path=/nowhere/at/all"], "no such folder. Clone forgi86/sysid-neural-continuous"),
    ],
)
def test_bad_words_are_one_sentence(
    words: list[str],
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert COMMAND.main(words) == 2
    assert told in capsys.readouterr().err


@pytest.mark.parametrize("name", sorted(BENCHMARKS))
def test_a_wrong_folder_names_the_repository_and_the_file(name: str, tmp_path: Path) -> None:
    benchmark = BENCHMARKS[name]()
    with pytest.raises(DataError, match=f"no such folder. Clone {benchmark.repository}"):
        benchmark.paths(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"holds no .* Name a checkout of"):
        benchmark.paths(tmp_path)


def test_cut_and_foreign_tables_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t,x\n0,1\n1,2\n2")
    with pytest.raises(DataError, match=r"a.csv:4 has 1 cells and not 2: the file is cut off"):
        table(path, ("t", "x"), what="the set")
    with pytest.raises(DataError, match="lacks the columns y: it is not of the set"):
        table(path, ("t", "y"), what="the set")
    path.write_text("t,x\n0,one\n")
    with pytest.raises(DataError, match=r"a.csv:2 holds a cell that is no number"):
        table(path, ("t", "x"), what="the set")


def test_cut_and_foreign_matlab_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"V1": np.arange(500.0), "other": 1.0}, do_compression=True)
    with pytest.raises(DataError, match="lacks V2 and holds V1, other: it is not of Silverbox"):
        matrices(path, ("V1", "V2"), what="Silverbox")
    whole = path.read_bytes()
    for size in (40, len(whole) // 2, len(whole) - 30):
        path.write_bytes(whole[:size])
        with pytest.raises(DataError, match="cannot be read as a MATLAB file"):
            matrices(path, ("V1",), what="Silverbox")


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
