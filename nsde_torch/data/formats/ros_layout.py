"""Messages of ROS to columns, many at a time.

A message's layout follows from its type, and from the lengths of its strings and sequences: it is worked out once for
each combination of lengths, and all messages that share it are read as one array. CDR aligns numbers to their size
(at most 8 bytes, counted after the four bytes that say the byte order); ROS 1 does not align.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.arrays import Array

Fields = Mapping[str, Sequence[tuple[str, tuple[int, Any]]]]
"""Types by name: names of their fields, and of each the kind and what it is of, as rosbags has them."""

BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""Kinds of a field: a number or string, a message, so many of something, any number of something."""
_NUMBERS = {
    "bool": "u1", "byte": "u1", "char": "u1", "octet": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_LONGEST = 64  # elements of an array that become columns
_DEEPEST = 16
_TOGETHER = 20_000  # messages that are read at a time
_LARGEST = 1 << 20  # bytes of a message: images and clouds are no signals


class UnsupportedMessageError(ValueError):
    """A message whose layout cannot be worked out; the topic is left out."""


@dataclass
class _Layout:
    columns: dict[str, tuple[int, str]] = field(default_factory=dict)
    lengths: list[tuple[int, int]] = field(default_factory=list)


class _Walk:
    """One message, read for its layout."""

    def __init__(self, raw: bytes, types: Fields, *, aligned: bool) -> None:
        self.raw, self.types, self.aligned = raw, types, aligned
        self.order = "<"
        self.start = 0
        if aligned:
            if len(raw) < 4 or raw[0] or raw[1] > 1:
                raise UnsupportedMessageError("an encoding other than plain CDR")
            self.order = "<" if raw[1] == 1 else ">"
            self.start = 4
        self.at = self.start
        self.out = _Layout()

    def message(self, kind: str, before: str = "", depth: int = 0) -> _Layout:
        if depth > _DEEPEST or kind not in self.types:
            raise UnsupportedMessageError(f"the type {kind} is not defined in the log")
        for name, what in self.types[kind]:
            self.one(what, before + name, depth)
        return self.out

    def one(self, what: tuple[int, Any], name: str, depth: int) -> None:
        kind, of = int(what[0]), what[1]
        if kind == BASE:
            self.base(of[0] if isinstance(of, tuple) else of, name)
        elif kind == NAME:
            self.message(of, f"{name}.", depth + 1)
        else:
            inner, count = of
            count = self.length() if kind == SEQUENCE else int(count)
            self.many(inner, count, name, depth)

    def many(self, inner: tuple[int, Any], count: int, name: str, depth: int) -> None:
        base = inner[1][0] if isinstance(inner[1], tuple) else inner[1]
        if int(inner[0]) == BASE and base in _NUMBERS:
            size = np.dtype(_NUMBERS[base]).itemsize
            self.align(size) if count else None
            if count <= _LONGEST:
                for k in range(count):
                    self.out.columns[f"{name}[{k}]"] = (self.at + k * size, self.order + _NUMBERS[base])
            self.move(size * count)
            return
        if count > _LARGEST:
            raise UnsupportedMessageError("a sequence that is longer than the message")
        for k in range(count):
            self.one(inner, f"{name}[{k}]", depth + 1)

    def base(self, kind: str, name: str) -> None:
        if kind in ("string", "wstring"):
            count = self.length()
            self.move(count)
        elif kind in ("time", "duration"):
            for part in ("sec", "nanosec"):
                self.number("uint32" if part == "nanosec" else "int32", f"{name}.{part}")
        else:
            self.number(kind, name)

    def number(self, kind: str, name: str) -> None:
        if kind not in _NUMBERS:
            raise UnsupportedMessageError(f"numbers of the type {kind}")
        size = np.dtype(_NUMBERS[kind]).itemsize
        self.align(size)
        self.out.columns[name] = (self.at, self.order + _NUMBERS[kind])
        self.move(size)

    def length(self) -> int:
        self.align(4)
        if self.at + 4 > len(self.raw):
            raise UnsupportedMessageError("a message that is cut short")
        value = int(struct.unpack_from(f"{self.order}I", self.raw, self.at)[0])
        self.out.lengths.append((self.at, value))
        self.move(4)
        return value

    def align(self, size: int) -> None:
        if self.aligned:
            self.at += -(self.at - self.start) % size

    def move(self, size: int) -> None:
        self.at += size
        if self.at > len(self.raw):
            raise UnsupportedMessageError("a message that is cut short")


def columns_of(
    messages: Sequence[bytes], kind: str, types: Fields, *, aligned: bool, wanted: Callable[[str], bool]
) -> tuple[dict[str, Array], int]:
    """Numbers of messages of one type, a column for each; what a message lacks is nan there.

    Args:
        messages: As they are in the log.
        kind: Name of their type.
        types: The types that the log defines.
        aligned: Whether they are CDR (ROS 2), else ROS 1.
        wanted: Whether a column is to be read, by its name.

    Returns:
        The columns, each (n,), and how many messages could not be read.

    Raises:
        UnsupportedMessageError: none could be read.
    """
    left = np.arange(len(messages))
    sizes = np.array([len(m) for m in messages])
    out: dict[str, Array] = {}
    bad = 0
    why = "no messages"
    layouts = 0
    while len(left):
        first = messages[left[0]]
        same = left[sizes[left] == len(first)]
        if len(first) > _LARGEST or layouts > 1000:
            raise UnsupportedMessageError("messages of many layouts, or large ones")
        layouts += 1
        try:
            layout = _Walk(first, types, aligned=aligned).message(kind)
        except (UnsupportedMessageError, struct.error, RecursionError) as error:
            why = str(error)
            bad += 1
            left = left[1:]
            if bad > 100 and not out:
                break
            continue
        order = ">" if aligned and first[1] == 0 else "<"
        read = [same[:0]]
        for start in range(0, len(same), _TOGETHER):
            rows = same[start : start + _TOGETHER]
            table = np.frombuffer(b"".join(messages[k] for k in rows), dtype=np.uint8)
            table = table.reshape(len(rows), len(first))
            fits = (table[:, :2] == np.frombuffer(first[:2], dtype=np.uint8)).all(axis=1) | (not aligned)
            for at, value in layout.lengths:
                fits &= _at(table, at, f"{order}u4") == value
            if not fits.all():
                rows, table = rows[fits], table[fits]
            read.append(rows)
            for name, (at, number) in layout.columns.items():
                if not wanted(name):
                    continue
                if name not in out:
                    out[name] = np.full(len(messages), np.nan)
                out[name][rows] = _at(table, at, number)
        left = np.setdiff1d(left, np.concatenate(read), assume_unique=True)
    if not out:
        raise UnsupportedMessageError(why)
    return out, bad


def _at(table: NDArray[np.uint8], at: int, number: str) -> NDArray[Any]:
    kind = np.dtype(number)
    return np.ascontiguousarray(table[:, at : at + kind.itemsize]).view(kind)[:, 0]
