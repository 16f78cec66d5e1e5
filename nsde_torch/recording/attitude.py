"""Quaternions of a run: unit norm and one continuous sign."""

from __future__ import annotations

import numpy as np

from nsde_torch.data.findings import Finding, Report
from nsde_torch.data.quaternion import continuous_signs
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import DataError

ROUNDING = 1e-4
"""Departure from unit norm that rounding explains (four decimals); renormalised without a word."""
MAX_NORM_ERROR = 0.05
"""Departure from unit norm above which the columns cannot be a unit quaternion; refused."""


def check_norms(run: RawRun, columns: slice, names: tuple[str, ...], report: Report) -> None:
    """Renormalises small departures of the norm from 1 and reports them.

    Raises:
        DataError: a norm is off by more than 0.05; the message names the first row and a likely cause.
    """
    q = run.x[:, columns]
    norm = np.linalg.norm(q, axis=1)
    error = np.abs(norm - 1.0)
    worst = float(np.nanmax(error)) if np.isfinite(norm).any() else 0.0
    if worst > MAX_NORM_ERROR:
        row = int(np.flatnonzero(error > MAX_NORM_ERROR)[0])
        cause = (
            "the columns hold degrees or another quantity" if np.nanmax(np.abs(q)) > 2 else "rows are damaged"
        )
        raise DataError(
            f"{run.where(row)}: the quaternion {names[columns]} = {np.round(q[row], 4).tolist()} has the "
            f"norm {norm[row]:.4g}; expected 1 (w x y z, body to world). Perhaps {cause}: write unit "
            "quaternions, or `nan` where there is none."
        )
    if worst > 1e-6:  # float32 rounding stays as it is
        run.x = run.x.copy()
        run.x[:, columns] = q / norm[:, None]
    count = int((error > ROUNDING).sum())
    if count:
        report(
            Finding(
                "quaternion_norm",
                run.name,
                count,
                f"{count} quaternions off unit norm by up to {worst:.2g}",
                "normalised",
                {"worst": worst},
            )
        )


def check_signs(run: RawRun, columns: slice, report: Report) -> None:
    """Undoes jumps between q and -q, which are one attitude but not one number to interpolate or learn."""
    known = np.isfinite(run.x[:, columns]).all(axis=1)
    q, flips = continuous_signs(run.x[known, columns])
    if flips:
        run.x = run.x.copy()
        run.x[known, columns] = q
        report(Finding("sign_flip", run.name, flips, f"{flips} sign flips of the quaternion", "unwrapped"))


def back_to_sphere(run: RawRun, columns: slice) -> None:
    """Unit norm again after holes were filled linearly, channel by channel."""
    norm = np.linalg.norm(run.x[:, columns], axis=1)
    off = np.abs(norm - 1.0) > 1e-6
    if off.any():
        run.x = run.x.copy()
        run.x[off, columns] /= norm[off, None]
