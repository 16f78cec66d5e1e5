"""The authors' files: kinds told by shape, splits, scales; pickles hold arrays and plain containers, or are refused."""

import contextlib
import os
import pickle
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nsde_torch.data import Windows, read_pickle
from nsde_torch.errors import DataError
from nsde_torch.recording import read
from tests.helpers.data_systems import CARTPOLE, HEXACOPTER, MSD, QUADROTOR
from tests.helpers.flights import flight

PUBLISHED = Path(__file__).resolve().parents[3] / "shared" / "data" / "published"
needs_files = pytest.mark.skipif(
    not PUBLISHED.is_dir(), reason="the published data are not beside the checkout"
)


def write(path: Path, content: object) -> str:
    path.write_bytes(pickle.dumps(content))
    return str(path)


def flights(motors: int) -> dict:
    pairs = [flight(4.0, motors=motors, seed=s)[1:] for s in range(3)]
    return {"train": pairs, "test": [(pairs[1][0].copy(), pairs[1][1].copy())]}


def test_the_test_entry_that_repeats_a_training_flight_is_no_further_run(tmp_path: Path) -> None:
    data = read("published", HEXACOPTER, path=write(tmp_path / "trajs.pkl", flights(6)))
    assert data.names == ("trajs_0", "trajs_1", "trajs_2")
    assert data.dt == pytest.approx(0.01)


def test_cartpole_inputs_become_newtons_and_the_angle_is_unwrapped(tmp_path: Path) -> None:
    theta = np.linspace(3.0, 9.0, 101)
    y = np.stack([np.zeros(101), np.zeros(101), np.sin(theta), np.cos(theta), np.full(101, 3.0)], axis=1)
    path = write(tmp_path / "learned.pkl", [(y, np.linspace(-1, 1, 100)[:, None])])
    run = read("published", CARTPOLE, path=path)[0]
    np.testing.assert_allclose(run.x[:, 2], theta, atol=1e-12)
    assert (run.u[0, 0], run.u[-2, 0], run.u[-1, 0]) == (-25.0, 25.0, 25.0)
    assert run.dt == pytest.approx(0.02)


def test_the_wrong_system_is_named_with_what_the_file_holds(tmp_path: Path) -> None:
    path = write(tmp_path / "trajs.pkl", flights(6))
    with pytest.raises(DataError, match=r"holds hexacopter flights .* 'quadrotor' has 13 states, 4 inputs"):
        read("published", QUADROTOR, path=path)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ({"a": 1}, "expected the keys 'train' and 'test'"), (3.0, "expected a list"), ([], "holds no runs"),
        ([np.zeros(3)], "pairs"), ([(np.zeros((5, 7)), np.zeros((5, 1)))], "belong to no published file"),
        ([(np.zeros((5, 2)), np.zeros((3, 1)))], "has shapes"),
        ([(np.zeros((5, 2)), np.zeros((5, 1))), (np.zeros((5, 5)), np.zeros((5, 1)))], "mixes runs"),
    ],
)  # fmt: skip
def test_contents_of_no_known_kind_are_refused(tmp_path: Path, content: object, text: str) -> None:
    with pytest.raises(DataError, match=text):
        read("published", MSD, path=write(tmp_path / "file.pkl", content))


FLIGHTS = str(PUBLISHED / "hexacopter" / "trajs.pkl")


@needs_files
@pytest.mark.published
def test_published_hexacopter_flights_hide_two_gaps_and_a_slow_clock() -> None:
    data = read("published", HEXACOPTER, path=FLIGHTS)
    assert [run.segments for run in data] == [
        ((0, 4641), (4641, 6498)),
        ((0, 5871),),
        ((0, 3142), (3142, 5682)),
    ]
    assert 1.04 < data.clock_scale < 1.07
    assert all(1.03 < s.value < 1.09 for s in data.summary.slopes)
    assert data.summary.input_rank.rank == 4
    envelope = data.summary.envelope
    assert envelope is not None
    assert envelope["speed_q95_m_per_s"] == pytest.approx(1.71, abs=0.1)
    kept = read("published", HEXACOPTER, path=FLIGHTS, clock="trust")
    assert kept.clock_scale == 1.0
    with pytest.raises(DataError, match="clock runs wrong"):
        read("published", HEXACOPTER, path=FLIGHTS, clock="refuse")


@needs_files
@pytest.mark.published
def test_evaluation_starts_are_those_of_the_reference_script() -> None:
    data = read("published", HEXACOPTER, path=FLIGHTS)
    for run in data:
        jump = np.flatnonzero(np.linalg.norm(np.diff(run.x[:, :3], axis=0), axis=1) > 0.05)
        expected = [i for i in range(0, len(run) - 200, 25) if not ((jump >= i) & (jump < i + 200)).any()]
        windows = Windows([run], 0.05, 40)
        assert [s for _, s in windows.locate(windows.starts(0.25))] == expected


@needs_files
@pytest.mark.published
@pytest.mark.parametrize(
    ("system", "file", "runs"),
    [
        (QUADROTOR, "iris/trajs.pkl", 3), (CARTPOLE, "cartpole/learned.pkl", 100),
        (CARTPOLE, "cartpole/random.pkl", 100),
        (MSD, "mass_spring_damper/MSD_MeasHigh_TopRight_5.pkl", 5),
        (MSD, "mass_spring_damper/MSD_TestData.pkl", 10),
    ],
)  # fmt: skip
def test_the_other_published_files_keep_their_clock(system: object, file: str, runs: int) -> None:
    data = read("published", system, path=str(PUBLISHED / file))  # type: ignore[arg-type]
    assert len(data) == runs
    assert data.clock_scale == 1.0


def load(tmp_path: Path, content: bytes) -> object:
    file = tmp_path / "file.pkl"
    file.write_bytes(content)
    return read_pickle(file)


class Evil:
    """Pickles as a call of any function."""

    def __init__(self, function: object, *args: object) -> None:
        self.call = function, args

    def __reduce__(self) -> tuple:
        return self.call


@pytest.mark.parametrize(("protocol", "numpy_1"), [*((k, False) for k in range(6)), (4, True)])
def test_arrays_of_numpy_1_and_2_survive_every_protocol(tmp_path: Path, protocol: int, numpy_1: bool) -> None:
    content = {
        "train": [(np.arange(6, dtype=">f4").reshape(2, 3), np.asfortranarray(np.eye(3)[:, :2]))],
        "empty": np.zeros((0, 4)), "flags": np.array([True, False]),
        "step": np.float64(0.1), "n": np.int32(7),
        "plain": [1, 2.5, "text", None, True, b"\xff\x00"],
    }  # fmt: skip
    raw = pickle.dumps(content, protocol)
    if numpy_1:  # renamed in the bytes, with the length of the frame put right
        raw = raw.replace(b"\x8c\x16numpy._core.multiarray", b"\x8c\x15numpy.core.multiarray")
        raw = raw[:3] + struct.pack("<Q", len(raw) - 11) + raw[11:]
    read = load(tmp_path, raw)
    assert isinstance(read, dict)
    np.testing.assert_array_equal(read["train"][0][0], content["train"][0][0])
    np.testing.assert_array_equal(read["train"][0][1], np.eye(3)[:, :2])
    assert type(read["train"][0][0]) is np.ndarray
    assert read["empty"].shape == (0, 4)
    assert (read["step"], read["n"], read["plain"]) == (0.1, 7, content["plain"])


def test_a_call_is_refused_by_name_and_not_made(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    with pytest.raises(DataError, match=r"asks for `posix.mkdir`|asks for `nt.mkdir`"):
        load(tmp_path, pickle.dumps([np.zeros(3), Evil(os.mkdir, str(mark))]))
    assert not mark.exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\x80\x04\x8c\x05numpy\x8c\x11ndarray.__class__\x93.", "refused"),  # through attributes
        (b"(S'true'\nios\nsystem\n.", "`os.system`, which is refused"),  # an instance of old
        (b"Pnumber 7\n.", "outside itself"),
        (pickle.dumps({1, 2}), "holds a set"),
    ],
)
def test_other_ways_to_code_and_other_containers_are_refused(
    tmp_path: Path, content: bytes, words: str
) -> None:
    with pytest.raises(DataError, match=words):
        load(tmp_path, content)


@pytest.mark.parametrize(
    "array",
    [
        np.array([1, "a", None], dtype=object), np.array(["text"]), np.array([1 + 2j]),
        np.zeros(2, dtype=[("a", "f4"), ("b", "O")]), np.array(["2020-01-01"], dtype="M8[D]"),
    ],
)  # fmt: skip
def test_arrays_of_anything_but_numbers_are_refused(tmp_path: Path, array: np.ndarray) -> None:
    with pytest.raises(DataError, match=r"only plain numbers|structured dtype|refused"):
        load(tmp_path, pickle.dumps(array))


def test_an_array_that_claims_more_than_it_holds_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    array, huge = pickle.dumps(np.zeros(7, dtype="f4"), 4), 2**30
    assert array.count(b"K\x07\x85") == 1
    grown = array.replace(b"K\x07\x85", b"J" + struct.pack("<i", huge) + b"\x85")
    with pytest.raises(DataError, match=r"size 7 into shape \(1073741824,\)"):
        load(tmp_path, grown[:3] + struct.pack("<Q", len(grown) - 11) + grown[11:])


@pytest.mark.slow
def test_lists_that_share_each_other_many_times_are_refused_in_time(tmp_path: Path) -> None:
    bomb: list = []
    for _ in range(30):
        bomb = [bomb] * 10
    with pytest.raises(DataError, match="more than"):
        load(tmp_path, pickle.dumps(bomb))


@pytest.mark.parametrize("put", [b"r" + struct.pack("<I", 2**28), b"p268435456\n"])
def test_a_huge_index_into_the_memo_is_refused_before_memory_is_taken(tmp_path: Path, put: bytes) -> None:
    """The memo would take 4 GiB."""
    with pytest.raises(DataError, match="opcode 2 puts a value at index 268435456 of the memo"):
        load(tmp_path, b"\x80\x02}" + put + b".")


def test_folders_and_files_that_were_cut_short_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is a folder"):
        read_pickle(tmp_path)
    with pytest.raises(DataError, match="not a readable pickle"):
        load(tmp_path, pickle.dumps(np.zeros((100, 3)))[:-700])


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_damage_anywhere_gives_a_data_error_or_plain_data(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    raw = bytearray(
        pickle.dumps({"train": [(np.zeros((3, 2)), np.float32(1))], "n": 3}, data.draw(st.integers(0, 5)))
    )
    for _ in range(data.draw(st.integers(1, 3))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(DataError):
        load(tmp_path_factory.getbasetemp(), bytes(raw))
