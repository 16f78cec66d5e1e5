"""`nsde benchmark`: the list, a run, and what is said of wrong words."""

from pathlib import Path

import pytest

from nsde_benchmarks.public.command import COMMAND


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
