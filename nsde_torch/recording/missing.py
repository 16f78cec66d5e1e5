"""Missing values (`nan`): short holes are filled, longer ones cut the run."""

from __future__ import annotations

import numpy as np

from nsde_torch.data.findings import Finding, Report
from nsde_torch.data.raw import RawRun, holes
from nsde_torch.errors import DataError


def fill(run: RawRun, *, gap: float, report: Report) -> None:
    """Fills holes between rows at most `gap` seconds apart (states linear, inputs held); drops other rows.

    Dropped rows leave a step in time longer than `gap`, at which the run is then cut. Slow further channels,
    such as a battery voltage logged at 1 Hz, are interpolated over any hole.

    Raises:
        DataError: a column has no value at all, or no two rows are complete.
    """
    bad_x, bad_u = np.isnan(run.x), np.isnan(run.u)
    for name, bad, data in (("state", bad_x, run.x), ("input", bad_u, run.u)):
        empty = np.flatnonzero(bad.all(axis=0)) if len(data) else np.array([], dtype=int)
        if len(empty):
            raise DataError(
                f"{run.source or 'run'} {run.name!r}: {name} column {int(empty[0])} has no value in any row; "
                "record the channel, or leave the run out."
            )
    for name, channel in list(run.extra.items()):
        bad = np.isnan(channel)
        if bad.all():
            run.extra = {k: v for k, v in run.extra.items() if k != name}
            report(
                Finding("empty_channel", run.name, len(channel), f"channel {name!r} has no value", "dropped")
            )
        elif bad.any():
            channel = channel.copy()
            channel[bad] = np.interp(run.t[bad], run.t[~bad], channel[~bad])
            run.extra = {**run.extra, name: channel}
            share = float(bad.mean())
            report(
                Finding(
                    "missing_channel",
                    run.name,
                    int(bad.sum()),
                    f"channel {name!r} is missing in {share:.1%} of the rows",
                    "interpolated",
                )
            )
    row_bad = bad_x.any(axis=1) | bad_u.any(axis=1)
    if not row_bad.any():
        return
    n = len(run.t)
    drop = np.zeros(n, dtype=bool)
    filled = 0
    for a, b in holes(np.asarray(row_bad)):
        if a == 0 or b == n or run.t[b] - run.t[a - 1] > gap:
            drop[a:b] = True
        else:
            filled += b - a
    if filled:
        good = ~row_bad
        some = row_bad & ~drop
        run.x, run.u = run.x.copy(), run.u.copy()
        for k in range(run.x.shape[1]):
            mend = some & bad_x[:, k]
            if mend.any():
                run.x[mend, k] = np.interp(run.t[mend], run.t[good], run.x[good, k])
        last_good = np.maximum.accumulate(np.where(good, np.arange(n), 0))
        for k in range(run.u.shape[1]):
            mend = some & bad_u[:, k]
            run.u[mend, k] = run.u[last_good[mend], k]
        report(
            Finding(
                "missing_values",
                run.name,
                filled,
                f"{filled} rows with missing values in holes up to {gap:.3g} s",
                "interpolated",
            )
        )
    if drop.any():
        count = int(drop.sum())
        report(
            Finding(
                "missing_rows",
                run.name,
                count,
                f"{count} rows with missing values at the ends or in holes longer than {gap:.3g} s",
                "dropped",
            )
        )
        run.rows(~drop)
    if len(run.t) < 2:
        raise DataError(
            f"{run.source or 'run'} {run.name!r}: fewer than two rows have all states and inputs. Resample "
            "the channels onto one clock before writing them, one row a sample."
        )
