"""A pickle may hold NumPy arrays and plain containers; all else is refused by name and never executed."""

import contextlib
import os
import pickle
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nsde_torch.data import read_pickle
from nsde_torch.errors import DataError


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
    "function", [eval, exec, getattr, np.load, np.fromfile, np.memmap, np.ndarray, pickle.loads, bytearray]
)
def test_no_other_function_can_be_called(tmp_path: Path, function: object) -> None:
    with pytest.raises(DataError):
        load(tmp_path, pickle.dumps(Evil(function, "x")))


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
    with pytest.raises(DataError, match="claims 4294967296 bytes"):
        load(tmp_path, grown[:3] + struct.pack("<Q", len(grown) - 11) + grown[11:])
    with pytest.raises(DataError, match="needs 36 bytes; it holds 28 bytes"):
        load(tmp_path, array.replace(b"K\x07\x85", b"K\x09\x85"))


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


def test_missing_files_folders_and_damage_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="does not exist"):
        read_pickle(tmp_path / "none.pkl")
    with pytest.raises(DataError, match="is a folder"):
        read_pickle(tmp_path)
    for content, message in (
        (b"", "is empty"),
        (b"hello", "not a readable pickle"),
        (pickle.dumps(np.zeros((100, 3)))[:-700], "not a readable pickle"),
    ):
        with pytest.raises(DataError, match=message):
            load(tmp_path, content)


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
