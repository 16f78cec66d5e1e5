"""`nsde serve` as a process: the address that it prints, its port, its end."""

import json
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.commands import Said

pytest.importorskip("waitress", reason="needs the extra nsde_torch[serve]")


@pytest.fixture
def server(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A page on a free port, in an empty folder."""
    words = [sys.executable, "-m", "nsde_torch.cli", "serve", "port=0", "system=cartpole"]
    with subprocess.Popen(
        words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        yield process
        process.kill()


def _get(address: str, **headers: str) -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=10) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


@pytest.mark.slow
def test_the_printed_address_opens_the_page_and_sigterm_ends_it(
    server: subprocess.Popen[str], tmp_path: Path, refused: Said
) -> None:
    assert server.stdout is not None
    address, _, token = server.stdout.readline().strip().partition("#")
    assert address.startswith("http://127.0.0.1:")
    assert len(token) >= 32
    assert str(tmp_path / "served") in server.stdout.readline()
    status, page = _get(address)
    assert status == 200
    assert b"Diagnose a log" in page
    assert _get(f"{address}api/jobs")[0] == 401
    told = json.loads(_get(f"{address}api/jobs", **{"X-Nsde-Token": token})[1])
    assert (told["system"], told["jobs"]) == ("cartpole", [])
    assert _get(address, Host="evil.example")[0] == 421
    port = address.rstrip("/").rpartition(":")[2]
    said = refused("serve", f"port={port}", f"out_dir={tmp_path / 'other'}")
    assert f"127.0.0.1:{port} cannot be bound" in said
    assert "port=0" in said
    server.send_signal(signal.SIGTERM)
    rest, errors = server.communicate(timeout=20)
    assert server.returncode == 0
    assert "0 diagnoses are kept" in rest
    assert "Traceback" not in errors


@pytest.mark.parametrize("package", ["waitress", "werkzeug"])
def test_a_package_that_is_not_installed_is_named_with_its_extra(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Said
) -> None:
    for name in [n for n in sys.modules if n.startswith((package, "nsde_torch.cli.serving"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    said = refused("serve", "port=0", f"out_dir={tmp_path / 'served'}")
    assert f"'{package}'" in said
    assert "nsde_torch[serve]" in said
