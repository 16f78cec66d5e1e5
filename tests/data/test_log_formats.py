"""Logs of every format: written as their programs write them, read back as the run; and damaged or hostile ones."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from nsde_torch.data.mapping.mapping import mapping_of
from nsde_torch.data.mapping.reader import format_of, log_files, read_log, read_mapped
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import DataError, NsdeError
from nsde_torch.systems import System, make_system
from tests.helpers import log_writers
from tests.helpers.leaning import leaning_flight, same_flight

TABLES = {".csv": None, ".tsv": None, ".npz": None, ".mat": None, ".h5": "h5py", ".parquet": "pyarrow"}
LOGS = {".mcap": "mcap", ".bag": "rosbags", ".db3": "rosbags", ".bin": None}
NEEDS = {**TABLES, **LOGS}


@pytest.fixture(scope="module")
def quadrotor() -> System:
    return make_system("quadrotor")


@pytest.fixture(scope="module")
def flight() -> RawRun:
    return leaning_flight(12.0)


@pytest.fixture(scope="module")
def folders(flight: RawRun, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A folder for each format whose package is installed."""
    out = {}
    for suffix, package in NEEDS.items():
        if package is not None:
            try:
                __import__(package)
            except ImportError:
                continue
        folder = tmp_path_factory.mktemp(suffix[1:])
        if suffix in TABLES:
            log_writers.write_table(folder / f"run{suffix}", log_writers.ned_columns(flight))
            (folder / "mapping.yaml").write_text(log_writers.NED_MAPPING, encoding="utf-8")
        elif suffix == ".bin":
            log_writers.write_ardupilot(folder / "run.bin", flight)
        else:
            log_writers.write_ros(folder / ("run" if suffix == ".db3" else f"run{suffix}"), flight)
        out[suffix] = folder
    return out


def _folder(folders: dict[str, Path], suffix: str) -> Path:
    if suffix not in folders:
        pytest.skip(f"needs the package {NEEDS[suffix]}")
    return folders[suffix]


@pytest.mark.parametrize("suffix", NEEDS)
def test_every_format_gives_the_run_back(
    folders: dict[str, Path], flight: RawRun, quadrotor: System, suffix: str
) -> None:
    (run,) = read_log(quadrotor, path=_folder(folders, suffix))
    assert run.name == "run"
    assert len(run.t) == len(flight.t)
    assert np.abs(run.t - flight.t).max() < 2e-6
    # ArduPilot logs single precision and whole microseconds of pulses, ROS microns of nothing
    assert same_flight(run, flight, 3e-6 if suffix == ".bin" else 3e-9)
    assert np.abs(run.u - flight.u).max() < (1e-9 if suffix in TABLES else 1e-3 if suffix == ".bin" else 1e-7)
    assert (suffix in LOGS) == any("proposed" in note.message for note in run.notes)


def test_a_table_with_clear_names_needs_no_mapping(tmp_path: Path, flight: RawRun, quadrotor: System) -> None:
    columns = log_writers.ned_columns(flight)
    motors = {f"motor{k + 1}": 1000 + 1000 * flight.u[:, k] for k in range(4)}
    log_writers.write_table(tmp_path / "run.csv", {**columns, **motors})
    assert format_of(tmp_path, quadrotor) == "table"
    (run,) = read_log(quadrotor, path=tmp_path)
    assert same_flight(run, flight, 1e-9)  # NED and FRD are seen by where it speeds up


def test_two_sources_of_one_quantity_are_not_chosen_unseen(
    tmp_path: Path, flight: RawRun, quadrotor: System
) -> None:
    columns = log_writers.ned_columns(flight)
    columns |= {f"ekf_vel_{a}": columns[f"vel_{a}"] + 0.01 for a in "xyz"}
    log_writers.write_table(tmp_path / "run.npz", columns)
    with pytest.raises(
        DataError, match=r"velocity may be vel_x.* or ekf_vel_x.* Run `nsde inspect .*quadrotor"
    ):
        read_log(quadrotor, path=tmp_path)


def test_a_mapping_that_contradicts_the_log_is_refused(
    tmp_path: Path, flight: RawRun, quadrotor: System
) -> None:
    log_writers.write_table(tmp_path / "run.csv", log_writers.ned_columns(flight))
    wrong = log_writers.NED_MAPPING.replace("unit: deg/s", "unit: rad/s")
    with pytest.raises(
        DataError, match=r"'run': the mapping contradicts the log: .*unit: deg/s.*nsde inspect"
    ):
        read_mapped(quadrotor, path=tmp_path, kind="table", mapping=mapping_of(yaml.safe_load(wrong)))


def test_files_of_other_columns_are_streams_of_one_run(
    tmp_path: Path, flight: RawRun, quadrotor: System
) -> None:
    columns = log_writers.ned_columns(flight)
    motors = {name: columns.pop(name)[::2] for name in list(columns) if name.startswith("motor")}
    log_writers.write_table(tmp_path / "mocap.csv", columns)
    log_writers.write_table(tmp_path / "motors.csv", {"timestamp_us": columns["timestamp_us"][::2], **motors})
    own = str([f"motors/motor{k}" for k in (1, 2, 3, 4)])
    mapping = log_writers.NED_MAPPING.replace("[motor1, motor2, motor3, motor4]", own)
    (tmp_path / "mapping.yaml").write_text(mapping, encoding="utf-8")
    (run,) = read_log(quadrotor, path=tmp_path)
    assert np.abs(run.u[::2][:-1] - flight.u[::2][:-1]).max() < 1e-9
    assert [note.kind for note in run.notes] == ["slow_topic"]


def test_a_table_without_a_clock_says_what_to_write(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", q=np.sin(np.arange(500.0)), force=np.cos(np.arange(500.0)))
    system = make_system("mass_spring_damper")
    with pytest.raises(DataError, match=r"has no column of times.*time: \{rate: 100\}"):
        read_log(system, path=tmp_path)
    (tmp_path / "mapping.yaml").write_text("time: {rate: 50}\ncolumns: {q: q, force: force}\n")
    (run,) = read_log(system, path=tmp_path)
    assert np.allclose(np.diff(run.t), 0.02)


# ---- damaged and hostile files -----------------------------------------------------------------------------


def _beside(folder: Path, other: Path, suffix: str, content: bytes) -> Path:
    """Another folder with a changed log, and the mapping of the first."""
    shutil.copytree(folder, other)
    (other / f"run{suffix}").write_bytes(content)
    return other


def _read_or_refused(system: System, path: Path) -> str | list[RawRun]:
    """The runs, or what is said in their place; anything but an error of ours is a failure."""
    try:
        return read_log(system, path=path)
    except NsdeError as error:
        return str(error)


@pytest.mark.parametrize("suffix", [s for s in NEEDS if s != ".db3"])
@pytest.mark.parametrize("how", ["cut", "noise", "empty"])
def test_a_damaged_file_is_one_sentence_or_its_sound_part(
    folders: dict[str, Path], tmp_path: Path, quadrotor: System, suffix: str, how: str
) -> None:
    folder = _folder(folders, suffix)
    content = (folder / f"run{suffix}").read_bytes()
    rng = np.random.default_rng(1)
    damaged = {"cut": content[: len(content) * 2 // 3 + 5], "noise": rng.bytes(5000), "empty": b""}[how]
    found = _read_or_refused(quadrotor, _beside(folder, tmp_path / "damaged", suffix, damaged))
    if isinstance(found, str):
        assert "\n" not in found
        assert "run" in found
    else:
        assert how == "cut"
        assert suffix in (".mcap", ".bin")  # written message by message: what lies before the end is sound
        assert 200 < len(found[0].t) < 1201


def test_flipped_bytes_never_end_in_a_traceback(
    folders: dict[str, Path], tmp_path: Path, quadrotor: System
) -> None:
    rng = np.random.default_rng(0)
    for suffix, folder in folders.items():
        if suffix != ".db3":
            content = bytearray((folder / f"run{suffix}").read_bytes())
            for place in rng.integers(0, len(content), 30):
                content[place] = rng.integers(0, 256)
            assert _read_or_refused(quadrotor, _beside(folder, tmp_path / suffix[1:], suffix, bytes(content)))


def test_a_pickle_in_an_npz_is_not_opened(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return (Path.touch, (str(tmp_path / "ran"),))  # type: ignore[return-value]

    np.savez(tmp_path / "run.npz", t=np.arange(9.0), q=np.arange(9.0), bad=np.array([Evil()], dtype=object))
    log = log_files("table", tmp_path)[0].open()
    assert log.names() == ["q"]
    assert not (tmp_path / "ran").exists()


def test_links_to_other_files_are_not_followed(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "other.hdf", "w") as file:
        file["secret"] = np.arange(100.0)
    (tmp_path / "data").mkdir()
    with h5py.File(tmp_path / "data" / "run.h5", "w") as file:
        file["t"], file["q"] = np.arange(100.0), np.arange(100.0)
        file["linked"] = h5py.ExternalLink(str(tmp_path / "other.hdf"), "/secret")
        file["loop"] = h5py.SoftLink("/")
    assert log_files("table", tmp_path / "data")[0].open().names() == ["q"]
    (tmp_path / "raw").write_bytes(bytes(800))
    with h5py.File(tmp_path / "data" / "run.h5", "w") as file:
        file.create_dataset("q", (100,), "f8", external=[(str(tmp_path / "raw"), 0, 800)])
    with pytest.raises(DataError, match="lie in another file"):
        log_files("table", tmp_path / "data")[0].open()


# ---- Betaflight --------------------------------------------------------------------------------------------


def test_betaflight_logs_give_rates_and_motors(tmp_path: Path, flight: RawRun) -> None:
    pytest.importorskip("orangebox")
    log_writers.write_betaflight(tmp_path / "two.bbl", flight, logs=2)
    files = log_files("betaflight", tmp_path)
    assert [file.name for file in files] == ["two_1", "two_2"]
    log = files[1].open()
    (stream,) = log.streams
    assert len(stream.t) == len(flight.t)
    gyro = np.deg2rad(stream.vector("gyroADC", 3))
    assert np.abs(gyro - flight.x[:, 10:]).max() < np.deg2rad(0.51)
    assert log.columns["u"]["low"] == 48.0
    assert log.columns["u"]["numbering"] == "betaflight"
    with pytest.raises(
        DataError, match=r"no columns are an attitude .*, a position, a velocity.*nsde inspect"
    ):
        read_log(make_system("quadrotor"), path=tmp_path)


def test_a_damaged_betaflight_log_is_one_sentence_or_its_sound_part(tmp_path: Path, flight: RawRun) -> None:
    pytest.importorskip("orangebox")
    log_writers.write_betaflight(tmp_path / "run.bbl", flight)
    content = (tmp_path / "run.bbl").read_bytes()
    (tmp_path / "run.bbl").write_bytes(content[: len(content) // 2])
    assert 400 < len(log_files("betaflight", tmp_path)[0].open().streams[0].t) < 800
    (tmp_path / "run.bbl").write_bytes(np.random.default_rng(0).bytes(4000))
    with pytest.raises(DataError, match=r"run\.bbl"):
        log_files("betaflight", tmp_path)[0].open()


def test_json_and_px4_messages_in_mcap(tmp_path: Path, flight: RawRun, quadrotor: System) -> None:
    """Odometry of PX4 over ROS 2 (NED, FRD, microseconds of its own clock) and motors as JSON on another topic."""
    pytest.importorskip("mcap")
    pytest.importorskip("rosbags")
    log_writers.write_px4_mcap(tmp_path / "run.mcap", flight)
    (file,) = log_files("mcap", tmp_path)
    log = file.open()
    assert log.frames == {"world": "NED", "body": "FRD"}
    assert any("left out" in note and "/blob" in note for note in log.notes)
    (run,) = read_log(quadrotor, path=tmp_path)
    assert same_flight(run, flight, 1e-6)
    assert np.abs(run.u - flight.u).max() < 1e-6


def test_a_chunk_that_would_fill_the_memory_is_not_unpacked(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    import struct

    import zstandard
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader
    from mcap.writer import Writer

    with (tmp_path / "run.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        writer.add_message(channel, 1, b"1", 1)
        writer.finish()
    content = (tmp_path / "run.mcap").read_bytes()
    with (tmp_path / "run.mcap").open("rb") as file:
        (chunk,) = (r for r in StreamReader(file, emit_chunks=True).records if isinstance(r, Chunk))
    packed = zstandard.compress(bytes(1 << 29))  # 512 MiB of zeros in some kilobytes
    place = content.index(chunk.data)
    # two times, a size, a checksum, the packing, the length of the data
    body = place - 8 - len("zstd") - 4 - 4 - 3 * 8
    record = content[body : place - 8] + struct.pack("<Q", len(packed)) + packed
    (tmp_path / "run.mcap").write_bytes(content[: body - 8] + struct.pack("<Q", len(record)) + record)
    with pytest.raises(DataError, match=r"run\.mcap is not a readable MCAP file \(.*a chunk of 536870912"):
        log_files("mcap", tmp_path)[0].open()
