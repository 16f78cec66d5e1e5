"""The data files that the authors of the neural-SDE paper published; the kinds are recognised by their shapes.

    hexacopter, iris      {"train": [(x, u), ...], "test": ...}   x (n, 13) ENU/FLU, u (n, 6 or 4), 100 Hz
    cartpole              [(y, u), ...]   y (n, 5) = x, x_dot, sin, cos, theta_dot; u (n - 1, 1) times 25 N, 50 Hz
    mass_spring_damper    [(y, u), ...]   y (n, 2) = q, q_dot; u (n - 1, 1) zeros, 100 Hz

None of the files has a clock: rows are taken to be one nominal step apart, and the kinematic checks say how true that
is. The `test` entry of the multirotor files repeats a training flight, so that it is no further run.
"""

import pickle
import pickletools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.places import log_place
from nsde_torch.data.raw import RawRun
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import DataError

CARTPOLE_FORCE = 25.0  # newtons for one unit of the published cartpole input

# columns of y and u in the file -> what the file is, and its nominal step [s]
_KINDS = {
    (13, 6): ("hexacopter flights", 0.01),
    (13, 4): ("quadrotor (iris) flights", 0.01),
    (5, 1): ("cartpole episodes", 0.02),
    (2, 1): ("mass-spring-damper trajectories", 0.01),
}


def _pairs(content: object, where: str) -> list[tuple[Array, Array]]:
    """The (states, inputs) pairs of a file, checked; entries that repeat an earlier one are left out."""
    groups: list[object] = [content]
    if isinstance(content, dict):
        groups = [content[k] for k in ("train", "test") if k in content]
        if not groups:
            raise DataError(
                f"{where}: expected the keys 'train' and 'test'; got {sorted(map(str, content))}."
            )
    pairs: list[tuple[Array, Array]] = []
    for group in groups:
        if not isinstance(group, list | tuple):
            raise DataError(
                f"{where}: expected a list of (states, inputs) pairs; got {type(group).__name__}."
            )
        for entry in group:
            if not (isinstance(entry, list | tuple) and len(entry) == 2):
                raise DataError(
                    f"{where}: expected (states, inputs) pairs; entry {len(pairs)} is a "
                    f"{type(entry).__name__}."
                )
            x, u = (np.asarray(part, dtype=np.float64) for part in entry)
            if x.ndim != 2 or u.ndim != 2 or len(x) - len(u) not in (0, 1):
                raise DataError(
                    f"{where}: entry {len(pairs)} has shapes {x.shape} and {u.shape}; expected (n, states) "
                    "and (n or n - 1, inputs)."
                )
            if not any(np.array_equal(x, a) and np.array_equal(u, b) for a, b in pairs):
                pairs.append((x, u))
    if not pairs:
        raise DataError(f"{where} holds no runs.")
    shapes = {(x.shape[1], u.shape[1]) for x, u in pairs}
    if len(shapes) > 1:
        raise DataError(f"{where} mixes runs of different widths (states, inputs): {sorted(shapes)}.")
    return pairs


def read_published(system: SystemInfo, *, path: str | Path, dt: float | None = None) -> list[RawRun]:
    """Runs of one of the authors' files, which the system must fit, on a step [s] or the published rate of their kind.

    A DataError refuses a file that is unreadable, of another system or of no known kind.
    """
    path = Path(path)
    pairs = _pairs(read_pickle(path), str(path))
    shape = pairs[0][0].shape[1], pairs[0][1].shape[1]
    if shape not in _KINDS:
        known = "; ".join(f"{what}: {k[0]} states, {k[1]} inputs" for k, (what, _) in _KINDS.items())
        raise DataError(
            f"{path}: {shape[0]} state and {shape[1]} input columns belong to no published file ({known}). "
            "Write other data as CSV and read it with kind `csv`."
        )
    what, nominal = _KINDS[shape]
    nx, nu = len(system.state_names), len(system.input_names)
    cartpole = shape == (5, 1)
    if (4 if cartpole else shape[0], shape[1]) != (nx, nu) or system.exogenous:
        reason = (
            f"reads the exogenous channels {system.exogenous}"
            if system.exogenous
            else f"has {nx} states, {nu} inputs"
        )
        raise DataError(
            f"{path} holds {what} ({shape[0]} state and {shape[1]} input columns); the system "
            f"{system.name!r} {reason}. Choose the file's own system."
        )
    step = nominal if dt is None else float(dt)
    runs = []
    digits = len(str(len(pairs) - 1))
    before = 0  # rows of the runs before: they were recorded one after another, and a battery remembers
    for k, (y, u) in enumerate(pairs):
        t = step * np.arange(before, before + len(y), dtype=np.float64)
        before += len(y)
        name = f"{path.stem}_{k:0{digits}d}"
        if cartpole:  # theta unwrapped, 0 upright
            theta = np.unwrap(np.arctan2(y[:, 2], y[:, 3]))
            y, u = np.stack([y[:, 0], y[:, 1], theta, y[:, 4]], axis=1), CARTPOLE_FORCE * u
        runs.append(RawRun(name, t, y, u, source=path.name))
    return runs


# Reads a pickle that holds NumPy arrays and plain containers, and nothing else.
#
# A pickle is a program: a `GLOBAL` names any importable object and a `REDUCE` calls it. Python's own documentation
# ("Restricting Globals") says to override `Unpickler.find_class`. Here that method knows the few names by which NumPy 1
# and 2 rebuild arrays, scalars and dtypes, resolves them to functions of this file (never by import), and refuses all
# others by name before anything is called. Opcodes are read once beforehand: Python's unpickler makes its memo as long
# as the largest index that is put into it (`LONG_BINPUT`), so that eight bytes may take 64 GiB.


_PLAIN = (str, int, float, bool, bytes, type(None), np.ndarray, np.generic)
MAX_ITEMS = 1_000_000
"""Most entries that the containers of a pickle may hold together (shared references count each time)."""


class _RefusedError(ValueError):
    """What a pickle holds and must not, in words."""


class _Dtype:
    """Stands for a dtype while the pickle is read; only plain numbers, and only the byte order can be set."""

    def __init__(self, name: object, *_: object) -> None:
        self.dtype = np.dtype(str(name)[:16])
        if self.dtype.kind not in "biuf" or self.dtype.subdtype is not None:
            raise _RefusedError(
                f"the pickle holds values of dtype {name!r}; only plain numbers (bool, int, float) "
                "are admitted. Save the data as float arrays."
            )

    def __setstate__(self, state: Sequence[Any]) -> None:
        if any(part is not None for part in state[2:5]):
            raise _RefusedError("the pickle holds a structured dtype; only plain numbers are admitted.")
        self.dtype = self.dtype.newbyteorder(state[1])


def _array(data: Any, kind: Any, shape: Any, order: object) -> np.ndarray[Any, Any]:
    """An array over its bytes, which takes no memory, whatever the shape claims."""
    return np.frombuffer(data, kind.dtype).reshape(shape, order="F" if order == "F" else "C")


class _Array:
    """Stands for an array while the pickle is read; NumPy never sees an unchecked state."""

    array: np.ndarray[Any, Any] | None = None

    def __init__(
        self, *_: object
    ) -> None:  # NumPy always writes ndarray, (0,), b"b"; the state brings the rest
        pass

    def __setstate__(self, state: Sequence[Any]) -> None:
        _, shape, dtype, fortran, data = state
        self.array = _array(data, dtype, shape, "F" if fortran else "C")


class _Unpickler(pickle.Unpickler):
    """`find_class` is the only door of a pickle to code; it opens for the names below alone."""

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)

        # functions of this reading alone: what a pickle does to one of them is gone with it
        def encode(text: Any, encoding: object) -> bytes:
            if encoding != "latin1":  # protocols 0 to 2 write bytes as text in latin1
                raise _RefusedError(f"the pickle asks for the text encoding {encoding!r}.")
            return bytes(text.encode("latin1"))

        self._admitted: dict[tuple[str, str], Callable[..., object] | str] = {
            (
                "numpy",
                "ndarray",
            ): "numpy.ndarray",  # named as the first argument of _reconstruct, never called
            ("numpy", "dtype"): lambda *given: _Dtype(*given),
            ("_codecs", "encode"): encode,
            ("__builtin__", "bytes"): lambda: b"",  # how protocols 0 to 2 write empty bytes
        }
        for core in ("numpy.core", "numpy._core"):
            self._admitted[f"{core}.multiarray", "_reconstruct"] = lambda *given: _Array(*given)
            self._admitted[f"{core}.multiarray", "scalar"] = lambda kind, data: _array(data, kind, 1, "C")[0]
            self._admitted[f"{core}.numeric", "_frombuffer"] = lambda *given: _array(*given)

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._admitted:
            raise _RefusedError(
                f"the pickle asks for `{module}.{name}`, which is refused: only NumPy arrays and plain lists, tuples, "
                "dicts, numbers and strings are admitted. Save the data as such, or as CSV."
            )
        return self._admitted[module, name]

    def persistent_load(self, pid: object) -> Any:
        raise _RefusedError(f"the pickle refers to an object outside itself ({pid!r}), which is refused.")


def _unwrapped(value: object, left: Iterator[int], depth: int = 0) -> object:
    """A value with arrays in the place of their stand-ins; refuses what is not plain data, or more than is left."""
    if depth > 32 or next(left, None) is None:
        raise _RefusedError(
            f"the pickle nests containers more than 32 deep or holds more than {MAX_ITEMS} entries."
        )
    if isinstance(value, _Array):
        value = value.array
    if isinstance(value, list | tuple):
        return type(value)(_unwrapped(v, left, depth + 1) for v in value)
    if isinstance(value, dict):
        return {_unwrapped(k, left, depth + 1): _unwrapped(v, left, depth + 1) for k, v in value.items()}
    if not isinstance(value, _PLAIN):
        raise _RefusedError(
            f"the pickle holds a {type(value).__name__}, which is refused: only NumPy arrays and plain lists, "
            "tuples, dicts, numbers and strings are admitted."
        )
    return value


def _check_memo(file: BinaryIO) -> None:
    """Refuse a pickle with an index into the memo that is larger than the number of opcodes before it."""
    for count, (opcode, number, _) in enumerate(pickletools.genops(file)):
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and not 0 <= int(number or 0) <= count:
            raise _RefusedError(
                f"the pickle's opcode {count} puts a value at index {number} of the memo, which no writer "
                "does. It is damaged, or made to fill the memory: copy it again, or save the data as CSV."
            )


def read_pickle(path: str | Path) -> object:
    """Contents of a pickle of NumPy arrays and plain containers; nothing in the file is executed.

    These are lists, tuples, dicts, strings, numbers, None and NumPy arrays of bool, int or float. A DataError where the
    file is missing, not a pickle, cut short, or names anything else (the name is in the message).
    """
    path = log_place(path, "a pickle file (.pkl)")
    if path.is_dir():
        raise DataError(f"`path`: {path} is a folder; expected a pickle file (.pkl).")
    try:
        with path.open("rb") as file:
            _check_memo(file)
            file.seek(0)
            return _unwrapped(_Unpickler(file).load(), iter(range(MAX_ITEMS)))
    except _RefusedError as error:
        raise DataError(f"{path}: {error}") from error
    except Exception as error:  # damaged opcodes raise nearly anything, also from inside NumPy
        raise DataError(
            f"{path} is not a readable pickle ({type(error).__name__}: {error}). It may be cut short or of "
            "another format; copy it again."
        ) from error
