"""`nsde figures`: trains what is missing, draws, writes captions, and names what is wrong."""

import json
from pathlib import Path

import pytest

from nsde_benchmarks.paper import Check, ExperimentOutcome, figure_table
from nsde_torch.cli.main import main
from nsde_torch.errors import NsdeError

pytestmark = pytest.mark.drawn

TINY = [
    *("system=mass_spring_damper", "data.durations=[3,3,3]", "trainer=fast", "trainer.steps=2"),
    *("trainer.polish=0", "trainer.calibrate=false", "trainer.compile=off"),
]


def tiny_figure(words: list[str]) -> figure_table.Figure:
    def draw(settings: figure_table.Settings) -> ExperimentOutcome:
        from nsde_torch.models import load
        from nsde_torch.plots import learning_curves

        ((folder,),) = settings.run_dirs("tiny")
        split = figure_table.held_out(folder)
        assert [run.name for run in split.test] == ["run_2"]
        spec = load(folder).spec
        check = Check("a model is there", f"a {spec.kind} of {spec.system}", passed=True)
        figure = learning_curves([{"step": 0.0, "validation": 1.0}, {"step": 1.0, "validation": 0.5}], kept=1)
        return ExperimentOutcome("Tiny", "nothing", checks=[check], figures={"curve": figure})

    return figure_table.Figure(lambda settings: {"tiny": words}, draw)


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> dict[str, figure_table.Figure]:
    figures = {"tiny": tiny_figure(TINY), "broken": tiny_figure([*TINY, "data.test=[9]"])}
    monkeypatch.setattr(figure_table, "FIGURES", figures)
    monkeypatch.setattr(figure_table, "FAST", ())
    return figures


@pytest.mark.usefixtures("table")
@pytest.mark.slow
def test_a_figure_is_trained_drawn_and_captioned_and_a_second_call_trains_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["figures", "figures=[tiny]", f"out_dir={tmp_path}", "jobs=1"]
    assert main(words) == 0
    first = capfd.readouterr().out
    assert "trained tiny_seed0 (1 of 1" in first
    assert "[pass] a model is there: a nsde of mass_spring_damper" in first
    content = json.loads((tmp_path / "figures.json").read_text())
    assert content["figures"]["tiny"]["checks"][0]["result"] == "pass"
    assert (tmp_path / "tiny_curve.png").stat().st_size > 5000
    assert "![curve](tiny_curve.png)" in (tmp_path / "figures.md").read_text()
    assert main(words) == 0
    assert "1 of 1 models are there already" in capfd.readouterr().out


@pytest.mark.usefixtures("table")
@pytest.mark.slow
def test_a_training_that_fails_is_named_with_its_reason(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["figures", "figures=[broken]", f"out_dir={tmp_path}"]) == 2
    error = capfd.readouterr().err
    assert "training of tiny_seed0 failed" in error
    assert "tiny_seed0.log" in error


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["figures=[fig99]"], "`figures` must be `all` or of fig5, fig9"),
        (["published=nowhere"], "`published=nowhere`: no such folder."),
        (["settings=slow"], "`settings` must be fast | full"),
    ],
)
def test_a_mistake_is_one_clean_message(
    words: list[str], expected: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["figures", *words, f"out_dir={tmp_path}"]) == 2
    assert expected in capfd.readouterr().err


def test_every_figure_names_trainings_that_the_command_understands() -> None:
    from nsde_benchmarks.paper.command import chosen

    where = {"published": None, "models": Path("models"), "policies": None}
    settings = figure_table.Settings(fast=True, seeds=1, seed=0, **where)
    assert chosen(["all"]) == list(figure_table.FIGURES)
    for figure in figure_table.FIGURES.values():
        for words in figure.trainings(settings).values():
            assert words[0].startswith("system=")
    with pytest.raises(NsdeError):
        chosen([])


def test_a_folder_without_the_published_files_is_refused_before_anything_is_trained(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "figures"
    assert main(["figures", "figures=[fig9,fig12]", f"published={tmp_path}", f"out_dir={out}"]) == 2
    error = capfd.readouterr().err
    assert "must be the folder of the authors' files" in error
    assert "learned.pkl" in error
    assert not (out / "models").exists()
