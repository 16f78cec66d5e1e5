"""What inputs that move between rows of the log may do to channels, and to estimates of parameters.

A controller with sensors and a clock of its own may move its inputs between rows of the log, by half of what they move
from row to row, always to the same side of what was logged. Within a row a loop is as good as linear: what it does is a
linear function of the states and of the inputs of neighbouring rows, and acts through the machine's own equations. An
estimate is bent as far as it leans along these: a gain or a damping does, a product of two states does not.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.signals import Direction, basis_of, directions, input_slopes, row_weights

Array = NDArray[np.float64]

_NEIGHBOURS = (-2, -1, 0, 1, 2)  # rows of the log whose inputs may have acted


def lengths(regression: Regression, ways: Sequence[Direction]) -> dict[str, float]:
    """What inputs do in whitened rows, times half of what they move from row to row over what they move at all."""
    physics, known = regression.physics, [*regression.rows]
    u = np.asarray(physics.steps.u[:, : physics.vector.system.nu])
    later = np.ones(len(u), dtype=bool)
    later[[b - 1 for _, b in regression.single.edges]] = False
    at = np.flatnonzero(later)
    out: dict[str, float] = {}
    for way in ways:
        v = u @ way.weights
        share = 0.5 * float((v[at + 1] - v[at]).std() / max(float(v.std()), 1e-300))
        for channel, slope in zip(way.channels, way.slopes, strict=True):
            acts = (
                slope * regression.single.summed((v - v.mean())[:, None], regression.box) * physics.steps.dt
            )
            white = regression.whitened(regression.noises[known.index(channel)], acts)
            name = physics.names[channel]
            out[name] = float(np.hypot(out.get(name, 0.0), share * np.linalg.norm(white)))
    return out


def leaning(regression: Regression) -> Array:
    """How far the estimate of each parameter leans along what inputs may do between rows, 0 to 1 (channels, k).

    The share, as a length, of what weighs the rows of a channel in the estimate that lies along what inputs do that are
    linear functions of the states and of the inputs of neighbouring rows.
    """
    acts = _neighbours(regression)
    out = np.zeros((len(regression.rows), len(regression.vector)))
    for i, weighs in enumerate(row_weights(regression)):
        size = np.linalg.norm(weighs, axis=0)
        along = basis_of(regression.whitened(regression.noises[i], acts[:, i]))
        out[i] = np.linalg.norm(along.T @ weighs, axis=0) / np.where(size > 0, size, np.inf)
    return out


def _neighbours(regression: Regression) -> Array:
    """What inputs change in each box that are those of neighbouring rows, or a state (M, channels, columns)."""
    system, s = regression.physics.vector.system, regression.physics.steps
    x, u = s.x0[:, : system.nx].numpy(), s.u[:, : system.nu].numpy()
    size = 1e-3 * max(float(np.abs(u).max()), 1e-3)
    columns = []
    for way in directions(regression):
        slope = input_slopes(regression, way.weights, size, torch.arange(len(s)))
        v = u @ way.weights
        v = v - v.mean()
        columns += [slope * regression.single.shifted(v, by)[:, None] for by in _NEIGHBOURS]
        columns += [slope * own[:, None] for own in (x - x.mean(0)).T]
    summed = [regression.single.summed(column, regression.box) * s.dt for column in columns]
    return np.stack(summed, 2) if summed else np.zeros((len(regression.series), len(regression.rows), 0))
