"""What is no log at all: the cause is named before anything is opened, within seconds and without memory."""

import os
import socket
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import nsde_torch
from nsde_torch.api.inspecting import Inspection, inspect
from nsde_torch.cli.main import main
from nsde_torch.data import DataSet
from nsde_torch.data.csv_folder import read_csv_file
from nsde_torch.errors import NsdeError
from nsde_torch.systems import MassSpringDamper

GOOD = "t,q,q_dot\n" + "".join(f"{k / 100},{k},100\n" for k in range(20))
PIPES = (".csv", ".tsv", ".npz", ".mat", ".h5", ".parquet", ".mcap", ".bag", ".bin", ".bbl", ".ulg", ".pkl")
SPARSE = (".npz", ".bin", ".bbl", ".ulg", ".pkl")


def _folder(make: Callable[[Path], object]) -> Callable[[Path], None]:
    def made(path: Path) -> None:
        path.mkdir()
        (path / "run_0.csv").write_text(GOOD)
        make(path / "run_1.csv")

    return made


def _sparse(path: Path) -> None:
    path.write_text(GOOD)
    os.truncate(path, 2 << 30)


def _hole(path: Path) -> None:
    path.write_bytes(GOOD.encode() + bytes(5000) + b"\n0.3,1,100\n")


def _endless(path: Path) -> None:
    path.write_bytes(GOOD.encode() + b"1" * (3 << 20))


def _socket(path: Path) -> None:
    here = os.getcwd()
    os.chdir(path.parent)  # the name of a socket may not be long
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(path.name)
    os.chdir(here)


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "loop.csv": (lambda path: path.symlink_to(path), "cannot be opened"),
    "lost.csv": (lambda path: path.symlink_to("nowhere"), "does not exist"),
    "device.csv": (lambda path: path.symlink_to("/dev/zero"), "is no regular file"),
    "socket.csv": (_socket, "is no regular file"),
    "loop_inside": (_folder(lambda path: path.symlink_to(path)), "cannot be opened"),
    "folder_inside": (_folder(Path.mkdir), "is a folder with the name of a log"),
    "pipe_inside": (_folder(os.mkfifo), "is no regular file"),
    "sparse.csv": (_sparse, "ends with 16 MiB of zeros"),
    "sparse_inside": (_folder(_sparse), "ends with 16 MiB of zeros"),
    "hole.csv": (_hole, "holds bytes of zero"),
    "endless.csv": (_endless, "is longer than"),
    "endless_inside": (_folder(_endless), "is longer than"),
    "image.png": (
        lambda path: path.write_bytes(b"\x89PNG\r\n" + bytes(range(1, 200))),
        "table as CSV in UTF-8",
    ),
    "packed": (
        lambda path: (path.mkdir(), (path / "run.csv.gz").write_bytes(b"\x1f")),
        "it holds run.csv.gz",
    ),
    "damaged.pkl": (lambda path: path.write_bytes(b"\xc3" * 99), "is not a readable pickle"),
    "empty": (Path.mkdir, "holds no"),
    "utf16.csv": (lambda path: path.write_text(GOOD, encoding="utf-16"), "not UTF-8"),
    "noise.csv": (lambda path: path.write_bytes(np.random.default_rng(1).bytes(9999)), ""),
    **{f"empty{suffix}": (Path.touch, "is empty") for suffix in PIPES},
    **{f"pipe{suffix}": (os.mkfifo, "is no regular file") for suffix in PIPES},
    **{f"sparse{suffix}": (_sparse, "ends with 16 MiB of zeros") for suffix in SPARSE},
}


def _refusal(call: Callable[[], Inspection | DataSet]) -> str:
    """Why something is refused, which takes no more than 192 MiB to say."""
    tracemalloc.start()
    try:
        found = call()
    except NsdeError as error:
        return str(error)
    else:
        assert isinstance(found, Inspection)
        assert not found.usable
        return str(found.content()["checks"])
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 3 << 26


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_no_log_is_refused_by_its_cause_wherever_it_is_read(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    make, cause = BROKEN[name]
    make(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert cause in _refusal(lambda: nsde_torch.read(tmp_path / name, system="mass_spring_damper"))
    assert cause in _refusal(lambda: inspect(tmp_path / name, system="mass_spring_damper"))
    # a command reads them likewise
    if name in ("loop.csv", "hole.csv", "damaged.pkl", "sparse.ulg", "pipe.mcap"):
        assert main(["diagnose", "system=mass_spring_damper", f"data.path={name}", "out_dir=d"]) == 2
        said = capsys.readouterr().err
        assert cause in said
        assert len(said.splitlines()) <= 2


@pytest.mark.parametrize("path", ["x" * 300, "a\0b", "run.csv/x"])
def test_what_is_no_path_is_refused(path: str, tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text(GOOD)
    for call in (nsde_torch.read, inspect):
        with pytest.raises(NsdeError, match=r"cannot be opened|does not exist"):
            call(f"{tmp_path}/{path}", system="mass_spring_damper")


def test_an_archive_that_unpacks_to_more_than_is_read_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nsde_torch.data.places.LARGEST", 1 << 22)
    np.savez_compressed(tmp_path / "bomb.npz", t=np.zeros(1 << 20))
    assert (tmp_path / "bomb.npz").stat().st_size < 1 << 16
    said = _refusal(lambda: nsde_torch.read(tmp_path / "bomb.npz", system="mass_spring_damper"))
    assert "GiB of numbers" in said


def test_a_table_of_more_numbers_than_are_read_is_refused_before_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nsde_torch.data.places.LARGEST", 20 * 3 * 8)
    (tmp_path / "run.csv").write_text(GOOD)
    with pytest.raises(NsdeError, match=r"Split it, or\s+keep fewer columns or rows"):
        read_csv_file(tmp_path / "run.csv", MassSpringDamper())
