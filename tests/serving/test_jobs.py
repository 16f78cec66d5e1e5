"""A job from drop to report, stopped, taken up again, and after a restart."""

import json
from pathlib import Path

from nsde_torch.cli.serving.job import machines
from tests.serving.conftest import INSPECTION, Page, Played, make_page

CSV = {"run.csv": b"t,q\n0,1\n"}


def _begun(job: dict) -> bool:
    return len(job["stages"]) > 1


def _finish(page: Page, played: Played, name: str) -> dict:
    assert page.ask("POST", f"/api/jobs/{name}/diagnose", {}).status_code == 200
    played.go.set()
    return page.until(name, lambda job: job["state"] == "done")


def test_from_drop_to_report(page: Page, played: Played) -> None:
    job = page.drop(CSV)
    assert (job["state"], job["machine"]) == ("ready", "mass_spring_damper")
    page.ask("POST", f"/api/jobs/{job['id']}/diagnose", {})
    running = page.until(job["id"], _begun)
    assert running["state"] == "running"
    now = running["stages"][-1]
    assert (now["stage"], now["done"], now["total"]) == ("screening effects", 1, 4)
    assert now["found"] == "motor_lag (+812 nats)"
    played.go.set()
    done = page.until(job["id"], lambda j: j["state"] == "done")
    golden = json.loads((Path(__file__).parents[1] / "golden" / "diagnosis.json").read_text())
    assert done["summary"]["summary"] == golden["summary"]
    assert [f["name"] for f in done["summary"]["findings"]] == [f["name"] for f in golden["findings"]]
    assert done["summary"]["pictures"] == ["residual.png"]
    kinds = {"report.html": "html", "effects.yaml": "plain", "diagnosis.json": "json", "residual.png": "png"}
    for file, kind in kinds.items():
        answer = page.ask("GET", f"/jobs/{job['id']}/{file}")
        assert (answer.status_code, kind in answer.content_type) == (200, True)
    saved = page.ask("GET", f"/jobs/{job['id']}/report.html?save")
    assert "attachment" in saved.headers["Content-Disposition"]


def test_stopping_keeps_the_logs_and_starting_again_works(page: Page, played: Played) -> None:
    job = page.drop(CSV)
    page.ask("POST", f"/api/jobs/{job['id']}/diagnose", {})
    page.until(job["id"], _begun)
    assert page.ask("DELETE", f"/api/jobs/{job['id']}").status_code == 409  # at work
    page.ask("POST", f"/api/jobs/{job['id']}/cancel", {})
    stopped = page.until(job["id"], lambda j: j["state"] == "cancelled")
    assert stopped["sentence"] == "It was stopped."
    assert (page.folder / job["id"] / "logs" / "run.csv").is_file()
    assert _finish(page, played, job["id"])["summary"]


def test_one_is_diagnosed_at_a_time_and_a_waiting_one_can_be_stopped(page: Page, played: Played) -> None:
    first, second, third = (page.drop(CSV)["id"] for _ in range(3))
    for name in (first, second, third):
        page.ask("POST", f"/api/jobs/{name}/diagnose", {})
    page.until(first, _begun)
    assert page.ask("GET", f"/api/jobs/{second}").json["state"] == "waiting"
    assert page.ask("POST", f"/api/jobs/{second}/diagnose", {}).status_code == 409
    page.ask("POST", f"/api/jobs/{second}/cancel", {})
    assert page.ask("GET", f"/api/jobs/{second}").json["state"] == "cancelled"
    played.go.set()
    page.until(first, lambda j: j["state"] == "done")
    page.until(third, lambda j: j["state"] == "done")
    assert page.ask("GET", f"/api/jobs/{second}").json["state"] == "cancelled"
    assert [w[0] for w in played.words].count("diagnose") == 2


def test_a_mapping_that_contradicts_the_data_is_refused_with_its_reason_and_can_be_corrected(
    page: Page, played: Played
) -> None:
    said = "q_dot leaves 400% of what q moves, and 0.1% if it has the opposite sign."
    wrong = [{"name": "q and q_dot", "passed": False, "text": said}]
    proposed = "columns:\n  q: {from: a}\n"
    played.inspection |= {"usable": False, "native": False, "checks": wrong, "mapping": proposed}
    job = page.drop(CSV)
    assert (job["state"], job["sentence"]) == ("refused", f"The mapping contradicts the data: {said}")
    assert page.ask("POST", f"/api/jobs/{job['id']}/diagnose", {}).status_code == 409
    assert job["mapping"] == proposed
    played.inspection = {**INSPECTION, "native": False, "mapping": "columns: ..."}
    mine = "columns:\n  q: {from: b}\n"
    page.ask("POST", f"/api/jobs/{job['id']}/inspect", {"system": "mass_spring_damper", "mapping": mine})
    now = page.until(job["id"], lambda j: j["state"] == "ready")
    assert now["mapping"] == mine
    assert f"mapping={page.folder / job['id'] / 'mapping.yaml'}" in played.words[-1]
    assert "data.mapping=" in now["repeat"]
    assert [w[0] for w in played.words] == ["inspect", "inspect"]


def test_a_restart_lists_what_was_finished_and_what_was_at_work(page: Page, played: Played) -> None:
    done = page.drop(CSV)["id"]
    _finish(page, played, done)
    played.go.clear()
    broken = page.drop(CSV)["id"]
    page.ask("POST", f"/api/jobs/{broken}/diagnose", {})
    page.until(broken, _begun)
    page.runner.close()
    (page.folder / "notes").mkdir()  # of somebody else
    again = make_page(page.folder, played)
    assert {job["id"] for job in again.jobs()} == {done, broken}
    assert again.ask("GET", f"/api/jobs/{done}").json["summary"]["findings"]
    left = again.ask("GET", f"/api/jobs/{broken}").json
    assert (left["state"], left["inspection"]["usable"]) == ("cancelled", True)
    assert "closed while it was at work" in left["sentence"]
    assert _finish(again, played, broken)["summary"]
    again.runner.close()


def test_machines_of_ones_own_are_offered(tmp_path: Path) -> None:
    (tmp_path / "system").mkdir()
    (tmp_path / "system" / "mine.yaml").write_text("name: my_machine:Mine\n")
    known = machines(tmp_path)
    assert known.names["mine"] == "my_machine:Mine"
    words = machines(tmp_path, first="mine", typed=["system.effects=[linear_drag]"])
    logs = tmp_path / "logs"
    made = words.diagnose_words(logs, system="mine", mapping=None, max_minutes=10.0)
    assert made[1:5] == ["--config-dir", str(tmp_path), "system=mine", "system.effects=[linear_drag]"]
    assert made[-2:] == ["retrain=false", "max_minutes=10"]
    other = words.diagnose_words(logs, system="cartpole", mapping=None, max_minutes=10.0)
    assert "linear_drag" not in str(other)
    looks = words.inspect_words(logs, system="mine", mapping=None, out=logs)
    assert looks[-1] == "system=my_machine:Mine"
    assert set(machines(None).names) == {"mass_spring_damper", "cartpole", "hexacopter", "quadrotor"}
