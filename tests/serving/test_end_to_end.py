"""Real logs through the real commands: what is found, that the shown command repeats it, and what is refused."""

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nsde_torch
from nsde_torch.cli.main import main
from nsde_torch.cli.serving.process import CommandProcess
from tests.serving.conftest import InProcess, Page, make_page

SPRING = "mass_spring_damper"


@pytest.fixture
def real(tmp_path: Path) -> Any:
    """A page whose commands are the real ones."""
    made = make_page(tmp_path / "served", InProcess)
    yield made
    made.runner.close()


def _springs(seconds: float, effects: list[dict[str, dict[str, float]]]) -> dict[str, bytes]:
    """Two runs of a spring as CSV."""
    out = {}
    for run in nsde_torch.simulate(SPRING, effects=effects, durations=[seconds] * 2, seed=1).runs:
        rows = np.column_stack([run.t, run.x, run.u[: len(run.t)]]).tolist()
        lines = ["t,q,q_dot,force", *(",".join(map(repr, row)) for row in rows)]
        out[f"{run.name}.csv"] = "\n".join(lines).encode()
    return out


@pytest.fixture(scope="module")
def springs() -> dict[str, bytes]:
    return _springs(12.0, [])


@pytest.mark.slow
def test_what_is_found_and_the_command_that_repeats_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = make_page(tmp_path / "served", CommandProcess)  # in processes of their own, with limits
    job = real.drop(_springs(5.0, [{"coulomb_friction": {"size": 0.3}}]), SPRING)
    assert job["state"] == "ready", job["sentence"]
    real.ask("POST", f"/api/jobs/{job['id']}/diagnose", {})
    done = real.until(job["id"], lambda j: j["state"] in ("done", "failed"))
    assert done["state"] == "done", done["sentence"]
    first = done["summary"]["findings"][0]
    assert first["name"] == "coulomb_friction"
    assert float(first["parameters"][0]["value"].split()[0]) == pytest.approx(0.3, rel=0.1)
    assert first["picture"] == "effect_coulomb_friction.png"
    assert real.ask("GET", f"/jobs/{job['id']}/{first['picture']}").data.startswith(b"\x89PNG")
    assert b"coulomb_friction" in real.ask("GET", f"/jobs/{job['id']}/report.html").data
    monkeypatch.chdir(tmp_path)
    nsde, *words = shlex.split(done["repeat"])
    assert nsde == "nsde"
    assert main(words) == 0
    (again,) = (tmp_path / "diagnoses").rglob("diagnosis.json")
    before = json.loads(real.ask("GET", f"/jobs/{job['id']}/diagnosis.json").data)
    after = json.loads(again.read_text())
    before.pop("seconds"), after.pop("seconds")
    assert after == before
    real.runner.close()


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".mat", ".bin", ".ulg", ".txt"])
@pytest.mark.parametrize(
    "content",
    [bytes(range(256)) * 9, b"<script>alert(1)</script>\n" * 9],
)
def test_what_is_no_log_under_a_log_s_name_is_one_sentence(real: Page, suffix: str, content: bytes) -> None:
    job = real.drop({f"run{suffix}": content}, "quadrotor")
    assert job["state"] == "refused"
    assert job["sentence"].endswith(".")
    assert "fault" not in job["sentence"]
    assert str(real.folder) not in job["sentence"]
    assert not job["repeat"]
    assert real.ask("POST", f"/api/jobs/{job['id']}/diagnose", {}).status_code == 409


def test_a_mapping_of_more_than_a_mapping_takes_is_not_looked_at(
    real: Page, springs: dict[str, bytes]
) -> None:
    job, long = real.drop(springs, SPRING), {"system": SPRING, "mapping": "x" * 70_000}
    assert real.ask("POST", f"/api/jobs/{job['id']}/inspect", long).status_code == 413
