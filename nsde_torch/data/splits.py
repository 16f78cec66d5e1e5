"""Training and test runs: always whole runs, never one run (or one content) on both sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nsde_torch.data.run import DataSet, Run, resolve
from nsde_torch.errors import DataError


@dataclass(frozen=True)
class Split:
    """Runs for training and runs held out for the test."""

    train: tuple[Run, ...]
    test: tuple[Run, ...]


def split(
    dataset: DataSet, test: Sequence[int | str] | None = None, *, train: Sequence[int | str] | None = None
) -> Split:
    """Splits a data set by whole runs.

    Args:
        dataset: The data set.
        test: Runs to hold out, by index or name; None holds out the last run.
        train: Runs to train on; None takes all others.

    Returns:
        The runs of both sides, in the order of the data set.

    Raises:
        DataError: an unknown run, a run or an equal content on both sides, or an empty side.

    Example:
        >>> split(dataset, test=[1]).train  # doctest: +SKIP
    """
    runs = dataset.runs
    if isinstance(test, int | str):
        raise DataError(f"`test` must be a list of runs; got {test!r}. Write [{test!r}].")
    if len(runs) == 1 and test is None and train is None:
        raise DataError(
            f"the data set holds one run ({runs[0].name!r}), which cannot be on both sides. Record a second "
            "run, or set `test` to [] to train on it and test on nothing."
        )
    held = resolve(runs, [len(runs) - 1] if test is None else test)
    _refuse_repeats(held, runs, "test")
    if train is None:
        kept = [k for k in range(len(runs)) if k not in held]
    else:
        kept = resolve(runs, train)
        _refuse_repeats(kept, runs, "train")
    if not kept:
        names = ", ".join(run.name for run in runs)
        raise DataError(
            f"no run is left for training: all of the {len(runs)} runs ({names}) are held out in `test`. "
            "Hold out fewer."
        )
    both = sorted(set(held) & set(kept))
    if both:
        raise DataError(
            f"the runs {[runs[k].name for k in both]} are in both `train` and `test`; a test on training "
            "data says nothing. Remove them from one side."
        )
    seen: dict[str, str] = {}
    for k in kept:
        twin = seen.setdefault(runs[k].content_hash, runs[k].name)
        if twin != runs[k].name:
            raise DataError(
                f"the training runs {twin!r} and {runs[k].name!r} have the same content, which would count it twice "
                "and spoil the calibration across runs. Remove one."
            )
    for k in held:
        if twin := seen.get(runs[k].content_hash, ""):
            raise DataError(
                f"the test run {runs[k].name!r} has the same content as the training run {twin!r}; a test on "
                "training data says nothing. Hold out both, or remove one."
            )
    return Split(train=tuple(runs[k] for k in sorted(kept)), test=tuple(runs[k] for k in sorted(held)))


def _refuse_repeats(indices: Sequence[int], runs: Sequence[Run], side: str) -> None:
    twice = sorted({runs[k].name for k in indices if list(indices).count(k) > 1})
    if twice:
        raise DataError(f"`{side}` names the runs {twice} more than once.")
