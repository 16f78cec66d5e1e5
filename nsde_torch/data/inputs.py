"""What the inputs can show: range, constant channels, and combinations that were never varied.

The numerical rank is that of the input matrix over all runs (singular values above 1e-5 of the largest, which
is well above float32 rounding). Directions below it are in the null space: coefficients along them are not
identifiable.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.raw import Finding, Report
from nsde_torch.errors import DataError

RELATIVE_RANK = 1e-5


@dataclass(frozen=True)
class InputRank:
    """Numerical rank of the inputs."""

    rank: int  # number of singular values above 1e-5 of the largest
    channels: int  # number of inputs
    singular_values: list[float]
    """Root-mean-square of the inputs along each direction, descending (units of the input)."""
    null_directions: list[list[float]]
    """Unit vectors along which the inputs are zero throughout, (channels - rank, channels)."""


def input_rank(inputs: Sequence[Array]) -> InputRank:
    """Numerical rank of the inputs (n_i, nu) of all runs together."""
    nu = inputs[0].shape[1]
    total = sum(len(u) for u in inputs)
    # R of a QR over pieces has the singular values of the whole without squaring them or holding it twice
    r: Array = np.zeros((0, nu))
    for u in inputs:
        for first in range(0, len(u), 65536):
            r = np.asarray(np.linalg.qr(np.concatenate([r, u[first : first + 65536]]), mode="r"))
    _, s, vt = np.linalg.svd(r, full_matrices=True)
    s = np.concatenate([s, np.zeros(nu - len(s))])
    rank = int((s > RELATIVE_RANK * s[0]).sum()) if s.any() else 0  # nor of a machine without inputs
    null = echelon(vt[rank:])
    null = null / np.linalg.norm(null, axis=1, keepdims=True).clip(1e-300) + 0.0
    return InputRank(rank, nu, (s / np.sqrt(max(total, 1))).tolist(), null.round(6).tolist())


def echelon(rows: Array) -> Array:
    """Rows (r, k) that span the same space with as many zeros as pivoting gives, none of them for no row."""
    rows = rows.copy()
    for i in range(len(rows)):
        row, column = np.unravel_index(np.argmax(np.abs(rows[i:])), rows[i:].shape)
        rows[[i, i + int(row)]] = rows[[i + int(row), i]]
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, column], rows[i])
    return rows


def check_inputs(inputs: Sequence[Array], names: Sequence[str], report: Report) -> InputRank:
    """Reports constant inputs and rank deficiency over all runs together."""
    low = np.min([u.min(axis=0) for u in inputs], axis=0)
    high = np.max([u.max(axis=0) for u in inputs], axis=0)
    constant = [(n, float(a)) for n, a, b in zip(names, low, high, strict=True) if a == b]
    if constant:
        shown = ", ".join(f"{n} = {a:.4g}" for n, a in constant)
        text = f"inputs that never change: {shown}; what they do cannot be learned"
        values = {"inputs": [n for n, _ in constant]}
        report(Finding("constant_input", "", len(constant), text, "reported", values))
    rank = input_rank(inputs)
    if rank.rank < rank.channels and len(constant) < rank.channels:
        terms = (
            (f"{c:+.2f} {n}" for c, n in zip(row, names, strict=True) if abs(c) > 0.005)
            for row in rank.null_directions
        )
        vectors = "; ".join(f"{' '.join(row)} = 0" for row in terms)
        text = (
            f"the {rank.channels} inputs span {rank.rank} dimensions; always zero: {vectors}. "
            "Coefficients of single inputs are not identifiable"
        )
        missing = rank.channels - rank.rank
        report(Finding("rank_deficient_inputs", "", missing, text, "reported", asdict(rank)))
    return rank


def check_range(inputs: Array, names: Sequence[str], where: str) -> None:
    """Refuses motor commands below -0.05 or above 1.05; the message guesses the unit."""
    for k, name in enumerate(names):
        low, high = float(np.nanmin(inputs[:, k])), float(np.nanmax(inputs[:, k]))
        if low < -0.05 or high > 1.05:
            guess = "write a share of full throttle"
            if low >= 800 and high <= 2300:
                guess = "this looks like pulse widths in microseconds: write (pwm - 1000) / 1000"
            elif high > 110:
                guess = "speeds of rotors and other units are read through a mapping, which `nsde inspect` proposes"
            elif 10 < high <= 110:
                guess = "this looks like percent: divide by 100"
            raise DataError(
                f"{where}: motor command {name!r} runs from {low:.4g} to {high:.4g}; expected 0 to 1; {guess}."
            )
