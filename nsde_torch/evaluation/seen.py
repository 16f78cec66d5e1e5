"""Which runs a model was trained on, by what is in them: names can be given twice and files be renamed.

A training writes two things of each of its runs into `metrics.json`:

- `train_hashes`: the hash of states and inputs; equal content under any name is found;
- `train_rows`: a sketch of the rows, the k smallest of the 64-bit hashes of all distinct state rows (bottom-k
  sampling, Cohen and Kaplan 2007). A part of the run, a longer recording that holds it, or the same recording read
  at another step shares about as large a share of the sketch as it has of the rows, whatever the inputs are called.

Not found: a part of less than about 5 % of a run (3 of 64 rows), or rows that interpolation has changed; a run of the
same name with another content is therefore reported too, as something to look at.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data import Run

_FEWEST, _MOST, _ROWS_EACH = 64, 512, 64
_ENOUGH = 3  # common rows: two runs may start at the same state by design

WHOLE, PART, BY_NAME, NAMESAKE, HELD_OUT = "whole", "part", "by name", "same name", ""


def row_sketch(run: Run) -> str:
    """The smallest hashes of the distinct state rows of a run, as hexadecimal words: one per 64 rows, 64 to 512."""
    count = min(max(_FEWEST, len(run) // _ROWS_EACH), _MOST)
    return " ".join(f"{value:016x}" for value in _row_hashes(run)[:count].tolist())


def _row_hashes(run: Run) -> NDArray[np.uint64]:
    """Distinct 64-bit hashes of the rows (float32 bits of the states), ascending."""
    words = (np.asarray(run.x, dtype=np.float32) + np.float32(0)).view(np.uint32)  # + 0 makes -0 and 0 one
    state = np.full(len(words), 0x9E3779B97F4A7C15, dtype=np.uint64)
    for column in words.T:
        state = _mixed(state ^ column.astype(np.uint64))
    return np.unique(state)


def _mixed(z: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The finaliser of splitmix64 after its increment; wraps around, as unsigned numbers do."""
    z = z + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def record(runs: Iterable[Run]) -> dict[str, Any]:
    """What a training writes of its runs: `train_hashes` and `train_rows`, by name."""
    runs = list(runs)
    return {
        "train_hashes": {run.name: run.content_hash for run in runs},
        "train_rows": {run.name: row_sketch(run) for run in runs},
    }


@dataclass(frozen=True)
class SeenRuns:
    """The runs that a model was trained on."""

    names: Sequence[str]  # their names
    hashes: Mapping[str, str] | None  # content hash by name; None where the training did not write them
    rows: Mapping[str, str]  # sketch of the rows by name

    @classmethod
    def of(cls, metrics: Mapping[str, Any]) -> "SeenRuns":
        hashes = metrics.get("train_hashes")
        return cls(list(metrics.get("train_runs", ())), hashes, metrics.get("train_rows") or {})

    def match(self, run: Run) -> str:
        """How a run relates to those trained on.

        Returns:
            "whole": the same content. "part": rows in common. "by name": the name of a training run, where the training
            wrote nothing else. "same name": only the name in common. "": none of these.
        """
        if self.hashes is None:
            return BY_NAME if run.name in self.names else HELD_OUT
        if run.content_hash in self.hashes.values():
            return WHOLE
        own = _row_hashes(run)
        for sketch in self.rows.values():
            wanted = np.array([int(word, 16) for word in sketch.split()], dtype=np.uint64)
            if len(wanted) and np.isin(wanted, own).sum() >= min(_ENOUGH, len(wanted)):
                return PART
        return NAMESAKE if run.name in self.names else HELD_OUT


def trained_on(match: str) -> bool:
    """Whether a match of `SeenRuns.match` means that the model has seen the run, or must be taken to have."""
    return match in (WHOLE, PART, BY_NAME)
