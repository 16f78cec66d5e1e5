"""Files of public sets: found below the folder that the user names, and read with errors that say what to do."""

import hashlib
import json
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.errors import CheckpointError, DataError
from nsde_torch.whole_files import write_whole

Say = Callable[[str, int, int], None]


class Work:
    """Where a run keeps its stages: in `stages/` of its folder; those of another key are refused.

    `say` is told stage, number done and number in all, `tell` sentences.
    """

    def __init__(self, folder: Path, key: str, *, say: Say, tell: Callable[[str], None]) -> None:
        self.folder, self.key, self.say, self.tell = folder, key, say, tell

    def stage(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The result of a stage: read where it is kept, made and kept where not."""
        path = self.folder / "stages" / f"{name}.json"
        if path.is_file():
            try:
                kept: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
                key, result = kept["key"], dict(kept["result"])
            except (ValueError, KeyError, TypeError) as error:
                raise CheckpointError(
                    f"{path} is damaged ({error}). Delete it, and the stage runs again."
                ) from None
            if key != self.key:
                raise CheckpointError(
                    f"{path} is of other files or settings than these. Name another `out_dir`, or delete the folder."
                )
            self.tell(f"kept from before: {name}")
            return result
        result = make()
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps({"key": self.key, "result": result}, indent=1))
        return result


def key_of(name: str, paths: Sequence[Path], settings: dict[str, Any]) -> str:
    """A hash of a set's files and of the settings, which stages depend on."""
    seen = hashlib.sha256(json.dumps([name, settings], sort_keys=True).encode())
    for path in paths:
        seen.update(path.name.encode())
        seen.update(path.read_bytes())
    return seen.hexdigest()[:16]


_POINTER = b"version https://git-lfs"


def found(folder: Path, wanted: Sequence[str], *, repository: str) -> list[Path]:
    """The files `wanted` (paths relative to the repository), by their places or by their names alone."""
    if not folder.is_dir():
        raise DataError(f"`data.path={folder}`: no such folder. Clone {repository} and name the checkout.")
    out = []
    for name in wanted:
        path, last = folder / name, Path(name).name
        if not path.is_file():
            same = sorted(folder.rglob(last))
            if not same:
                raise DataError(
                    f"`data.path={folder}` holds no {last}. Name a checkout of {repository}, where it is {name}."
                )
            if len(same) > 1:
                raise DataError(
                    f"`data.path={folder}` holds {last} {len(same)} times, none of them at {name}. "
                    "Name the folder of one."
                )
            path = same[0]
        with path.open("rb") as file:
            start = file.read(64)
        if not start:
            raise DataError(f"{path} is empty. Fetch it from {repository} again.")
        if start.startswith(_POINTER):
            raise DataError(
                f"{path} is a pointer of Git LFS and holds no data. Run `git lfs pull` in the checkout of {repository}."
            )
        out.append(path)
    return out


def matrices(path: Path, names: Sequence[str], *, what: str) -> dict[str, Array]:
    """Variables of a MATLAB file, each flattened to (n,)."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    damaged = (ValueError, TypeError, LookupError, OSError, NotImplementedError, zlib.error, MatReadError)
    try:
        content = loadmat(path)
    except damaged as error:
        raise DataError(f"{path} cannot be read as a MATLAB file ({error}). Fetch it again.") from None
    missing = [name for name in names if name not in content]
    if missing:
        holds = ", ".join(sorted(k for k in content if not k.startswith("_"))) or "nothing"
        raise DataError(
            f"{path} lacks {', '.join(missing)} and holds {holds}: it is not of {what}. Check the path."
        )
    return {name: np.asarray(content[name], dtype=np.float64).ravel() for name in names}


def table(path: Path, names: Sequence[str], *, what: str) -> dict[str, Array]:
    """Columns of a CSV file with a header row, each (n,); `nan` where a cell is empty."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise DataError(f"{path} is not a text file, as those of {what} are. Check the path.") from None
    header = [cell.strip() for cell in lines[0].split(",")]
    missing = [name for name in names if name not in header]
    if missing:
        raise DataError(
            f"{path} lacks the columns {', '.join(missing)}: it is not of {what}. Check the path."
        )
    at = [header.index(name) for name in names]
    rows = np.empty((len(lines) - 1, len(names)))
    for k, cells in enumerate(line.split(",") for line in lines[1:]):
        if len(cells) != len(header):
            raise DataError(
                f"{path}:{k + 2} has {len(cells)} cells and not {len(header)}: the file is cut off. Fetch it again."
            )
        try:
            rows[k] = [float(cells[i]) if cells[i].strip() else np.nan for i in at]
        except ValueError:
            raise DataError(f"{path}:{k + 2} holds a cell that is no number. Fetch the file again.") from None
    return dict(zip(names, rows.T, strict=True))


def long_enough(count: int, least: int, path: Path) -> None:
    """Refuse a file with fewer rows than the protocol needs (DataError): it was cut off."""
    if count < least:
        raise DataError(
            f"{path} has {count} rows, and the protocol needs {least}: it is cut off. Fetch it again."
        )


MOTORS = (0, 2, 3, 1)
"""Motors of the Crazyflies in the order of quad-x: front right, rear left, front left, rear right."""


def all_filled(rows: Array, path: Path) -> None:
    """Refuse a file with empty cells (DataError)."""
    if not np.isfinite(rows).all():
        raise DataError(f"{path} has empty cells. Fetch it again.")


def flight_states(rows: Array, path: Path) -> Array:
    """States (n, 13) of a multirotor with a quaternion of length 1; DataError where it is none."""
    x = rows.copy()
    length = np.linalg.norm(x[:, 6:10], axis=1, keepdims=True)
    if (np.abs(length - 1.0) > 0.1).any():
        raise DataError(
            f"{path}: qx, qy, qz, qw are no unit quaternion. Check that it is a file of this set."
        )
    x[:, 6:10] /= length
    return x
