"""Only logs are taken, under names of our own, as large as announced; what is refused leaves nothing behind."""

from pathlib import Path

import pytest

from nsde_torch.cli.serving.job import FORMATS, RefusedError, file_names
from nsde_torch.data.readers import READERS
from tests.serving.conftest import Page, Played


def test_every_format_of_the_package_but_pickles_is_taken() -> None:
    every = {suffix for reader in READERS.values() for suffix in reader.suffixes} | {".csv"}
    assert every - set(FORMATS) == {".pkl", ".pickle"}


@pytest.mark.parametrize(
    ("given", "names"),
    [
        (["../../etc/passwd.csv"], ["passwd.csv"]),
        (["C:\\logs\\Flug 7 (ä).CSV"], ["Flug_7.csv"]),
        (["a.csv", "A.csv", "a.csv"], ["a.csv", "A_2.csv", "a_3.csv"]),
        ([".csv"], ["log.csv"]),
        (["\u202egpj.csv", "-rf.csv"], ["gpj.csv", "-rf.csv"]),
        (["x\n\0y.csv"], ["x_y.csv"]),
        (["v" * 500 + ".csv"], ["v" * 60 + ".csv"]),
        (["a.csv", "b.npz"], ["a.csv", "b.npz"]),
    ],
)
def test_names_are_made_of_letters_and_digits(given: list[str], names: list[str]) -> None:
    assert file_names(given) == names


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("holiday.jpg", "no log"), ("log", "no log"), ("run.csv.exe", "no log"), ("flights.zip", "unpack it"),
        ("flight.ulg.gz", "unpack it"), ("trajs.pkl", "may hold a program"), ("mapping.yaml", "no log"),
        ("<img src=x onerror=alert(1)>.svg", "no log"),
    ],
)  # fmt: skip
def test_what_is_no_log_is_refused_in_one_sentence(page: Page, played: Played, name: str, said: str) -> None:
    answer = page.drop({name: b"x"})
    assert answer.status_code == 415
    assert said in answer.json["error"]
    assert answer.json["error"].count(". ") == 0
    assert not page.jobs()
    assert not list(page.folder.iterdir())
    assert not played.words


def test_logs_of_two_formats_are_not_mixed() -> None:
    with pytest.raises(RefusedError, match=r"a\.csv, b\.ulg"):
        file_names(["a.csv", "b.ulg"])


def test_an_upload_that_is_too_large_is_refused_before_it_is_sent(page: Page) -> None:
    answer = page.ask("POST", "/api/jobs", {"files": [{"name": "a.csv", "size": 1 << 20}]})
    assert answer.status_code == 413
    assert "at most 0.0625 MiB" in answer.json["error"]
    many = [{"name": f"{k}.csv", "size": 1} for k in range(1000)]
    assert page.ask("POST", "/api/jobs", {"files": many}).status_code == 413
    assert not list(page.folder.iterdir())


@pytest.mark.parametrize(("sent", "status"), [(b"x" * 11, 413), (b"x" * 9, 400)])
def test_more_or_less_than_announced_is_refused_and_leaves_nothing(
    page: Page, played: Played, sent: bytes, status: int
) -> None:
    job = page.ask("POST", "/api/jobs", {"files": [{"name": "a.csv", "size": 10}]}).json
    answer = page.ask("PUT", f"/api/jobs/{job['id']}/logs/0", data=sent)
    assert answer.status_code == status
    assert "a.csv" in answer.json["error"]
    assert not list(page.folder.iterdir())
    assert not played.words


def test_logs_that_were_not_announced_are_not_taken(page: Page) -> None:
    job = page.ask("POST", "/api/jobs", {"files": [{"name": "a.csv", "size": 1}]}).json
    place = f"/api/jobs/{job['id']}/logs"
    assert page.ask("PUT", f"{place}/1", data=b"x").status_code == 409
    assert page.ask("PUT", f"{place}/-1", data=b"x").status_code == 404
    assert page.ask("POST", f"/api/jobs/{job['id']}/inspect", {}).status_code == 409  # not all are there
    assert page.ask("PUT", f"{place}/0", data=b"x").status_code == 200
    assert page.ask("PUT", f"{place}/0", data=b"y").status_code == 409
    assert (page.folder / job["id"] / "logs" / "a.csv").read_bytes() == b"x"


def test_no_more_than_so_many_are_kept_and_none_is_lost(page: Page) -> None:
    first = page.drop({"a.csv": b"t,q\n"})
    for _ in range(3):
        page.drop({"a.csv": b"t,q\n"})
    answer = page.drop({"a.csv": b"t,q\n"})
    assert answer.status_code == 409
    assert "delete one first" in answer.json["error"]
    assert len(page.jobs()) == 4
    assert page.ask("DELETE", f"/api/jobs/{first['id']}").status_code == 200
    assert not (page.folder / first["id"]).exists()
    assert page.drop({"a.csv": b"t,q\n"})["state"] == "ready"


def test_folders_that_are_no_jobs_are_left_alone(page: Page, tmp_path: Path) -> None:
    assert page.ask("GET", "/api/jobs/..").status_code == 404
    assert page.ask("DELETE", "/api/jobs/..").status_code == 404
    assert page.ask("DELETE", "/api/jobs/%2e%2e").status_code == 404
    assert page.folder.is_dir()
