"""`nsde sweep-report` on folders made by hand."""

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from nsde_torch.cli.commands.sweep_report import SCORES
from nsde_torch.cli.main import main
from tests.helpers.commands import Said


def _job(folder: Path, number: int, overrides: list[str], metrics: Any = None, failed: Any = None) -> None:
    job = folder / f"{number}_job"
    (job / ".hydra").mkdir(parents=True)
    (job / ".hydra" / "overrides.yaml").write_text("".join(f"- {word}\n" for word in overrides) or "[]\n")
    if metrics is not None:
        (job / "metrics.json").write_text(metrics if isinstance(metrics, str) else json.dumps(metrics))
    if failed is not None:
        (job / "failed.json").write_text(json.dumps(failed))


def _metrics(score: float) -> dict[str, Any]:
    outer, _, inner = SCORES[0].partition(".")
    return {outer: {inner: score}} if inner else {outer: score}


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """Two settings with two finished seeds each, one failed job, two unfinished."""
    common = ["system=hexacopter"]
    for number, (loss, seed, score) in enumerate(
        [("paper", 0, 3.0), ("paper", 1, 5.0), ("default", 0, 1.0), ("default", 1, 2.0)]
    ):
        _job(tmp_path, number, [*common, f"loss={loss}", f"seed={seed}"], _metrics(score))
    reason = {"error": "NonFiniteError", "message": "left the finite\nnumbers at step 7", "traceback": ""}
    _job(tmp_path, 4, [*common, "loss=paper", "seed=2"], failed=reason)
    _job(tmp_path, 5, [*common, "loss=default", "seed=2"])
    _job(tmp_path, 10, [*common, "loss=default", "seed=3"], metrics='{"validation": {"sco')
    return tmp_path


def test_settings_are_ranked_by_the_mean_over_their_seeds(sweep: Path, shown: Said) -> None:
    text = shown("sweep-report", str(sweep))
    rows = [line.split() for line in text.splitlines()]
    assert ["1", "2", "1.5", "+-", "0.71", "loss=default"] in rows
    assert ["2", "2", "4", "+-", "1.4", "loss=paper"] in rows
    assert f"best job: {sweep / '2_job'}" in text


def test_failed_jobs_are_named_with_the_reason_and_unfinished_ones_too(sweep: Path, shown: Said) -> None:
    text = shown("sweep-report", str(sweep))
    assert "7 jobs: 4 done, 1 failed, 2 unfinished" in text
    assert "  4_job: NonFiniteError: left the finite numbers at step 7" in text
    assert "  5_job\n  10_job" in text


def test_report_is_written_as_json_and_csv(sweep: Path) -> None:
    assert main(["sweep-report", str(sweep)]) == 0
    content = json.loads((sweep / "sweep_report.json").read_text())
    assert [row["label"] for row in content["ranking"]] == ["loss=default", "loss=paper"]
    assert content["ranking"][0]["mean"][SCORES[0]] == 1.5
    assert content["failed"] == [
        {"job": "4_job", "reason": "NonFiniteError: left the finite numbers at step 7"}
    ]
    rows = list(csv.DictReader((sweep / "sweep_report.csv").open()))
    assert len(rows) == 7
    assert rows[0]["loss"] == "paper"
    assert float(rows[0][SCORES[0]]) == 3.0


def test_any_number_of_the_metrics_can_rank_or_be_shown(tmp_path: Path, refused: Said, shown: Said) -> None:
    _job(tmp_path, 0, ["seed=0", "loss=a"], {"speed": 2.0, "test": {"size": 7}})
    _job(tmp_path, 1, ["seed=0", "loss=b"], {"speed": 1.0, "test": {"size": 8}})
    rows = [
        line.split()
        for line in shown("sweep-report", str(tmp_path), "--by", "speed", "--columns", "test.*").splitlines()
    ]
    assert ["1", "1", "1", "8", "loss=b"] in rows
    assert "there are: speed, test.size" in refused("sweep-report", str(tmp_path), "--by", "sped")


def test_a_score_that_is_not_finite_ranks_last(tmp_path: Path) -> None:
    _job(tmp_path, 0, ["loss=a"], '{"score": NaN}')
    _job(tmp_path, 1, ["loss=b"], {"score": 9.0})
    assert main(["sweep-report", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "sweep_report.json").read_text())
    assert [row["label"] for row in content["ranking"]] == ["loss=b", "loss=a"]
    assert content["ranking"][1]["mean"]["score"] is None


def test_a_model_without_intervals_has_none_and_not_some_that_hold_nothing(
    tmp_path: Path, shown: Said
) -> None:
    test = {"spread": {"position": {"1": 0.0}}, "coverage": {"0.9": {"position": {"1": 0.0}}}}
    _job(tmp_path, 0, ["model=sysid"], {**_metrics(1.0), "test": test})
    assert "90 % holds" not in shown("sweep-report", str(tmp_path))
    test["spread"]["position"]["1"] = 0.1
    _job(tmp_path, 1, ["model=nsde"], {**_metrics(1.0), "test": test})
    assert "90 % holds position 1 s" in shown("sweep-report", str(tmp_path))


def test_jobs_that_differ_in_the_seed_alone_are_one_group(tmp_path: Path, shown: Said) -> None:
    for seed in (0, 1):
        _job(tmp_path, seed, [f"seed={seed}"], _metrics(1.0 + seed))
    rows = [line.split() for line in shown("sweep-report", str(tmp_path)).splitlines()]
    assert ["1", "2", "1.5", "+-", "0.71", "all", "alike"] in rows


def test_a_folder_without_jobs_is_refused(tmp_path: Path, refused: Said) -> None:
    assert "no jobs in" in refused("sweep-report", str(tmp_path))
    assert "is not a folder" in refused("sweep-report", str(tmp_path / "missing"))


def test_scores_that_do_not_compare_are_ranked_apart_unless_a_number_is_named(
    tmp_path: Path, shown: Said
) -> None:
    for number, (loss, score, error) in enumerate([("paper", 9.0, 0.1), ("default", 1.0, 0.2)]):
        metrics = {
            **_metrics(score),
            "system": "cartpole",
            "loss": loss,
            "test": {"errors": {"model": {"rate": {"1": error}}}},
        }
        _job(tmp_path, number, [f"loss={loss}"], metrics)
    text = shown("sweep-report", str(tmp_path))
    assert "among system=cartpole loss=paper" in text
    assert "do not compare" in text
    assert "rate 1 s" in text
    text = shown("sweep-report", str(tmp_path), "--by", "test.errors.model.rate.1")
    assert "among" not in text
    assert [line.split()[0] for line in text.splitlines() if "loss=" in line] == ["1", "2"]
