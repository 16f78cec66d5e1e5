"""The picture of a flexible model: what it adds to the row of a port, over the one or two variables that tell most."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.ceiling import Ceiling
from nsde_torch.diagnosis.flexible_part import Foretold, Part
from nsde_torch.diagnosis.group_selection import weighted
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.trust import FAR, distance_from_data
from nsde_torch.diagnosis.views import variable_units
from nsde_torch.inference.smooth import functions
from nsde_torch.plots.flexible import Surface, flexible_surface

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_GRID = {1: 200, 2: 60}  # points along each axis


def flexible_picture(outcome: Outcome, found: Ceiling, units: dict[str, str]) -> Figure | None:
    """The picture; None where nothing is left, or what is left is of no variable that can be an axis.

    Args:
        outcome: What was concluded.
        found: What a flexible model could win.
        units: Unit of each row.
    """
    if not found.more or found.model is None:
        return None
    plain = [t for t in found.telling if t.variable in outcome.variables.columns]
    if not plain:
        return None
    row = plain[0].row
    names = tuple(t.variable for t in plain if t.row == row)[:2]
    part, foretold = next((p, f) for p, f in found.model.parts if row in p.pushes)
    columns = {name: outcome.variables.columns[name] for name in names}
    axes = [np.linspace(float(v.min()), float(v.max()), _GRID[len(names)]) for v in columns.values()]
    mesh = np.meshgrid(*axes)
    places = {name: m.reshape(-1) for name, m in zip(names, mesh, strict=True)}
    mean, error = _added(part, foretold, row, places)
    data = np.stack(list(columns.values()), 1)
    eta = distance_from_data(data, np.stack(list(places.values()), 1))
    of = variable_units(outcome.final.regression.vector.system)
    surface = Surface(
        row,
        units.get(row, ""),
        tuple((name, of.get(name, "")) for name in names),
        tuple(axes),
        mean.reshape(mesh[0].shape),
        error.reshape(mesh[0].shape),
        (eta > FAR).reshape(mesh[0].shape),
        data,
    )
    beside = "effects" if outcome.found else "the declared physics"
    return flexible_surface(surface, title=f"What a flexible model adds to {row} beside {beside}")


def _added(part: Part, foretold: Foretold, row: str, places: dict[str, Array]) -> tuple[Array, Array]:
    """What the model of all runs adds to a row at places (n,), as a function of their variables, and its errors."""
    often = [
        k for k in foretold.used if 2 * sum(k in fold for fold in foretold.chosen) >= len(foretold.chosen)
    ]
    members = part.members(often)
    found = weighted(part.products(foretold.noises, often), members, range(len(often)))
    count = len(next(iter(places.values())))
    values = np.zeros((count, len(found.mean)))
    for at, k in zip(members, often, strict=True):
        term = part.terms[k]
        of = term.group.variables
        if term.row == row and term.group.kind != "past" and set(of) <= set(places):
            values[:, at] = functions(of, term.group.kind, places, part.scaled)[:, : len(at)]
    live = values[:, found.at]
    error = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", live, found.covariance, live), 0.0))
    return values @ found.mean, error
