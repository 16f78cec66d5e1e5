"""Declared physics fitted to runs by least squares, on the step of the data (see `nsde_torch.sysid`)."""

import torch

from nsde_torch.evaluation.report import between_ends, number, table
from nsde_torch.models.identified import IdentifiedModel, SysidSpec
from nsde_torch.recording.smoothing import as_applied
from nsde_torch.sysid.identify import identify_in_loop
from nsde_torch.sysid.result import Identification
from nsde_torch.training.prepare import fit_filter
from nsde_torch.training.task import Fitted, Progress, Task

_LEVEL = 0.95
_UNKNOWN = {True: "not shown by the data", False: "had not settled"}


def fit_sysid(task: Task) -> Fitted:
    """Fit by least squares: no gradient steps, no seed.

    A ConfigError refuses a system that declares no parameter, a DataError data in which nothing moves, a NonFiniteError
    physics that leaves the finite numbers.
    """
    spec = task.spec
    assert isinstance(spec, SysidSpec)
    model = IdentifiedModel(spec, generator=torch.Generator(), values=task.values)
    runs = as_applied(task.runs, model.system.nu) if spec.filter_reach else task.runs
    found = identify_in_loop(
        model.system,
        runs,
        clock=task.clock,
        method=spec.method,
        iterations=spec.max_iterations,
        instruments=task.instruments,
    )
    found.vector.write(model.system, found.values)
    model.clock_scale.fill_(task.clock)
    if model.filter is not None:
        fit_filter(model.filter, task.runs, runs, model.system.nu)
    steps = found.iterations
    progress = Progress(steps, steps, found.unexplained, stopped=found.converged)
    facts = {
        "loss": "least squares",
        "validation": {
            "score": found.unexplained,
            "unit": "share of the rates' rms that is left, each block of time without its own data",
        },
        "identification": found.as_dict(),
    }
    if found.loop is not None:
        facts["feedback"] = found.loop.as_dict()
    model = model.to(device=task.device, dtype=task.dtype).requires_grad_(False)
    said, details = summary(found), rates_table(found)
    return Fitted(model, progress, found.parameters, facts, said=said, details=details)


def summary(found: Identification) -> str:
    """What a person reads of an identification."""
    v = found.vector
    how = {"weak": "weak form", "differences": "finite differences of smoothed states"}[found.method]
    lines = [
        f"identified by {how}, {'linear' if found.linear else 'nonlinear'} in the parameters: {found.iterations} "
        f"iterations, {'settled' if found.converged else 'not settled'}; rank {found.shown.rank} of {len(v)}, "
        f"condition number {number(found.shown.condition)}; {found.unexplained:.0%} of the rates left unexplained"
    ]
    lines += [f"not shown by the data: {finding}" for finding in found.findings]
    lines += [f"warning: {finding}" for finding in found.warnings]
    lines += [f"note: {note}" for note in found.notes]
    lines += [f"feedback: {finding}" for finding in found.of_the_loop]
    rows = []
    for i, half in enumerate(found.half_widths(_LEVEL)):
        value, error = found.values[i], found.standard_errors[i]
        cells = (
            ["", "rejected" if found.converged and not found.believed else _UNKNOWN[found.converged]]
            if half != half
            else [number(error), between_ends((value - half, value + half))]
        )
        rows.append([v.labels[i], number(value, 0.0 if half != half else 2 * half), *cells, v.units[i]])
    head = ["declared parameter", "value", "standard error", f"{_LEVEL:.0%} interval", "unit"]
    return "\n".join([*lines, "", table(head, rows)])


def rates_table(found: Identification) -> str:
    """What the declared physics leaves of the rates."""
    channels = [
        [c.name, number(c.measured), number(c.residual), number(c.sensor), f"{c.r2:.1%}", c.unit]
        for c in found.channels
    ]
    width = f"rate, means over {number(found.width_s)} s"
    return table([width, "measured", "left", "by sensors", "explained", "unit"], channels)
