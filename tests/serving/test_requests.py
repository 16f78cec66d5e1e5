"""Who may ask what, and what is taken: nothing without the token, and only logs, under names of our own."""

import contextlib
import re
import socket
import threading

import pytest

from nsde_torch.cli.serving.app import listen, serve
from nsde_torch.cli.serving.job import FORMATS, file_names
from nsde_torch.data.readers import READERS
from tests.serving.conftest import HOST, TOKEN, Page, Played

CSV = {"run.csv": b"t,q\n0,1\n"}


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", "/api/jobs"), ("POST", "/api/jobs"), ("GET", "/api/jobs/x"), ("DELETE", "/api/jobs/x"),
        ("PUT", "/api/jobs/x/logs/0"), ("POST", "/api/jobs/x/diagnose"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("token", [None, "", "another", "ü"])
def test_nothing_is_told_or_done_without_the_token(
    page: Page, method: str, path: str, token: str | None
) -> None:
    answer = page.ask(method, path, headers={"X-Nsde-Token": token})
    assert answer.status_code == 401
    assert "nsde serve" in answer.json["error"]


@pytest.mark.parametrize(
    "host", ["evil.example:8765", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example:8765", ""]
)
def test_another_name_is_refused_even_for_the_page_itself(page: Page, host: str) -> None:
    for path in ("/", "/api/jobs"):
        assert page.ask("GET", path, headers={"Host": host}).status_code == 421


def test_the_token_of_another_site_s_page_is_of_no_use(page: Page) -> None:
    for headers in ({"Origin": "http://evil.example"}, {"Origin": "null"}, {"Sec-Fetch-Site": "cross-site"}):
        answer = page.ask("POST", "/api/jobs", {"files": [{"name": "a.csv", "size": 1}]}, headers=headers)
        assert answer.status_code == 403
    assert page.ask("GET", "/api/jobs", headers={"Origin": f"http://{HOST}"}).status_code == 200
    assert not page.jobs()


def test_every_answer_lets_nothing_in_and_nothing_out(page: Page) -> None:
    job = page.drop(CSV)
    for path in ("/", "/page.js", "/api/jobs", f"/jobs/{job['id']}/log.txt", "/no/such"):
        headers = page.ask("GET", path).headers
        policy = headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none'")
        assert "http" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Cache-Control"] == "no-store"
    sheet = page.ask("GET", f"/jobs/{job['id']}/log.txt").headers["Content-Security-Policy"]
    assert "sandbox allow-scripts;" in sheet
    assert re.search(r"script-src 'sha256-[^']+';", sheet)  # that of a report, and no other


def test_the_page_asks_for_nothing_elsewhere(page: Page) -> None:
    for name in ("", "page.js", "views.js", "page.css", "icon.svg"):
        answer = page.ask("GET", f"/{name}")
        assert answer.status_code == 200
        assert "//" not in answer.text.replace("http://www.w3.org/2000/svg", "").replace("// ", "")
    assert "style=" not in page.ask("GET", "/").text  # its own policy would not let it


@pytest.mark.parametrize(
    "path",
    [
        "/../job.json", "/..%2fjob.json", "/%2e%2e/%2e%2e/etc/passwd", "/job.json", "/logs/run.csv",
        "/inspection.json", "/report.html%00.png",
    ],
)  # fmt: skip
def test_of_a_job_only_its_results_can_be_read(page: Page, path: str) -> None:
    job = page.drop(CSV)
    answer = page.ask("GET", f"/jobs/{job['id']}{path}")
    assert answer.status_code == 404
    assert b"root:" not in answer.data


def test_files_outside_the_page_cannot_be_read(page: Page) -> None:
    for path in ("/app.py", "/..%2fapp.py", "/%2fetc%2fpasswd", "/job.py"):
        assert page.ask("GET", path).status_code in (404, 405)


@pytest.mark.parametrize(
    "content",
    [
        [],
        {},
        {"files": "a.csv"},
        {"files": [{"name": 1, "size": 2}]},
        {"files": [{"name": "a.csv", "size": "3"}]},
        {"files": [{"name": "a.csv", "size": True}]},
        {"files": [{"name": "a.csv", "size": 3}], "system": "../x"},
        {"files": [{"name": "a.csv", "size": 3}], "system": 7},
        {"files": [{"name": "a.csv", "size": -3}]},
        {"files": []},
    ],
)
def test_requests_that_are_none_are_one_sentence(page: Page, played: Played, content: object) -> None:
    answer = page.ask("POST", "/api/jobs", content)
    assert answer.status_code == 400
    assert answer.json["error"].endswith(".")
    assert not page.jobs()
    assert not played.words


@pytest.mark.parametrize(
    ("token", "length", "status"),
    [(None, 1 << 29, b"401 Unauthorized"), ("another", 1 << 29, b"401 Unauthorized"), (TOKEN, 2, b"200 OK")],
)
def test_a_body_is_not_read_before_the_token_is_seen(token: str | None, length: int, status: bytes) -> None:
    taken: list[bytes] = []

    def page(environ, start_response):  # type: ignore[no-untyped-def]
        taken.append(environ["wsgi.input"].read())
        start_response("200 OK", [])
        return [b""]

    sock = listen("127.0.0.1", 0)

    def run() -> None:
        with contextlib.suppress(OSError):  # its socket is closed at the end, from another thread
            serve(sock, page, token=TOKEN, largest=1 << 30, threads=1)

    threading.Thread(target=run, daemon=True).start()
    head = f"PUT /api/jobs/x/logs/0 HTTP/1.1\r\nHost: {HOST}\r\nContent-Length: {length}\r\n"
    head += "" if token is None else f"X-Nsde-Token: {token}\r\n"
    head += "Connection: close\r\n"
    with socket.create_connection(sock.getsockname(), timeout=20) as client:
        client.sendall(f"{head}\r\n".encode() + b"ab")  # of half a GiB that is announced
        with client.makefile("rb") as arriving:
            answer = arriving.read()  # its header and its text may come apart
    sock.close()
    assert answer.startswith(b"HTTP/1.1 " + status)
    assert taken == ([b"ab"] if token == TOKEN else [])
    assert token == TOKEN or b"it holds the key to this page" in answer


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
