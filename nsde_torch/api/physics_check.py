"""Whether the declared physics, roughly fitted, speaks for another reading of the columns: signs, orders, numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from nsde_torch.api.reading import read
from nsde_torch.data.mapping.checks import SUSPECT, LogCheck
from nsde_torch.data.mapping.numbering import NUMBERINGS, order
from nsde_torch.data.raw import RawRun
from nsde_torch.data.run import Run
from nsde_torch.data.system_info import changed
from nsde_torch.errors import NsdeError
from nsde_torch.sysid.readings import better_readings, motor_orders
from nsde_torch.sysid.rough import rough_fit
from nsde_torch.systems.base import System
from nsde_torch.systems.multirotor import Multirotor
from nsde_torch.threads import one_thread

_NAME = "signs of the physics"
_DOUBTS = ("constant_state", "same_runs")
"""Findings of reading that are mended before anything is trained."""
REFUSED = "mend what reading refuses (`checks` above)"
"""The remedy of a check that is a refusal."""


@dataclass
class PhysicsFound:
    """What the physics says.

    Args:
        checks: In words.
        notes: What was assumed or found.
        numbering: Whose numbers the motors have, where the physics speaks for another than was assumed.
    """

    checks: list[LogCheck] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    numbering: str | None = None


@one_thread()
def check_physics(
    machine: System,
    runs: Sequence[RawRun],
    *,
    numbering: str | None = None,
    fixed: bool = False,
    fits: bool = True,
) -> PhysicsFound:
    """Read runs with all checks, fit the declared physics to means over 0.15 s, and look for better readings.

    Args:
        machine: The machine.
        runs: In its units, axes and order.
        numbering: Whose numbers the motors are taken to have, where others are to be tried; None: they are said.
        fixed: Whether a user said so: another is told then, and not taken.
        fits: Whether the physics is fitted.
    """
    out = PhysicsFound()
    try:
        data = read(list(runs), system=changed(machine), state_smoothing="restore" if fits else "keep")
    except NsdeError as error:
        out.checks.append(LogCheck("checks of all data", False, str(error), REFUSED))
        return out
    said = (SUSPECT, "log")  # by a check, and by the notes of the log
    for one in data.summary.findings:
        if one.kind in _DOUBTS:
            out.checks.append(LogCheck("what moves, and when", None, f"{one.message}.", one.message))
        elif one.kind not in said:
            out.notes.append(f"reading finds: {one}")
    if not fits:
        return out
    clock, found = data.clock_scale, list(data.runs)
    if numbering is not None and isinstance(machine, Multirotor):
        found = _numbered(machine, found, clock, numbering, fixed, out)
        if out.checks:
            return out
    rough = rough_fit(machine, found, clock)
    if rough is None:
        text = "the log is too short, or says too little, to fit the physics roughly."
        out.checks.append(LogCheck(_NAME, None, text, "record longer runs in which the machine moves"))
        return out
    better = better_readings(machine, found, clock, rough)
    if better is not None:
        out.checks.append(LogCheck(_NAME, False, f"{better.sentence}: {better.remedy}.", better.remedy))
    else:
        text = "no other sign, order of the inputs or axes in which the declared physics leaves much less."
        out.checks.append(LogCheck(_NAME, True, text))
    return out


def _numbered(
    machine: Multirotor, runs: list[Run], clock: float, assumed: str, fixed: bool, out: PhysicsFound
) -> list[Run]:
    """The runs with the motors numbered as their moments say, where they say it surely."""
    motors = machine.nu
    back = np.argsort(order(assumed, motors))
    places: dict[tuple[int, ...], str] = {}
    for name, frames in NUMBERINGS.items():
        if motors in frames:
            places.setdefault(tuple(back[list(order(name, motors))].tolist()), name)
    ranked = motor_orders(machine, runs, clock, list(places))
    if not ranked:
        return runs
    best = ranked[0]
    first, rival = places[best.places], next(o for o in ranked if o.places != best.places)
    same = best.places == tuple(range(motors))
    told = f"{best.nats - rival.nats:.0f} nats likelier than with {places[rival.places]}"
    if not best.surely_better(rival):
        out.notes.append(
            f"moments of motors numbered as in {first} are no more than {told}: check the numbers"
        )
        return runs
    if fixed and not same:
        now = next(o for o in ranked if o.places == tuple(range(motors)))
        text = f"moments of motors numbered as in {first} are {best.nats - now.nats:.0f} nats likelier."
        remedy = f"write `numbering: {first}` in the entry of the motors"
        out.checks.append(LogCheck("numbering of the motors", False, text, remedy))
        return runs
    out.notes.append(f"motors are numbered as in {first}: their moments are {told}")
    if same:
        return runs
    out.numbering = first
    return [_reordered(run, list(best.places)) for run in runs]


def _reordered(run: Run, places: list[int]) -> Run:
    u = np.array(run.u)
    u[:, : len(places)] = u[:, places]
    return replace(run, u=u)
