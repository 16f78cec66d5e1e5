"""`nsde effects`: list the physical effects that a system or a plant can be given."""

from __future__ import annotations

import json
import os
import shutil
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

from ..hydra_command import Config, HydraCommand, Job
from ..keys import group, key
from ..own_modules import UNNAMED
from ..schemas import SystemConfig

if TYPE_CHECKING:
    from nsde_torch.effects import Effect

_GAP = "  "
_ANY = "coordinate"  # port of a law: that of the coordinate which it is on
_SMALLEST = 100  # characters below which the table is not squeezed


@dataclass
class EffectsConfig:
    format: str = key("text", "how they are listed", choices=("text", "json"))
    system: SystemConfig = group(SystemConfig, "only those that this machine can have")


COMMAND = HydraCommand(
    name="effects",
    schema=EffectsConfig,
    groups={"system": None},
    values={"system": {"name": UNNAMED}},
    examples=(
        ("system=quadrotor", "those that a quadrotor can have, and what a diagnosis tries of them"),
        ("--config-dir DIR system=mine", "of a machine of your own, DIR/system/mine.yaml"),
    ),
)


def run(config: Config, job: Job) -> None:
    sys.path.insert(0, os.getcwd())  # a system of the user's own, in a file there
    name = None if config.system.name == UNNAMED else config.system.name
    rows = catalogue(name)
    if config.format == "json":
        print(json.dumps({"effects": rows}, indent=1))
        return
    width = shutil.get_terminal_size((120, 24)).columns
    print(table(rows, max(width, _SMALLEST), systems=name is None))
    from nsde_torch.diagnosis.candidates import without_motion
    from nsde_torch.systems import make_system

    if lacks := "; ".join(filter(None, without_motion(make_system(name)))) if name else "":
        print(f"\n{lacks[0].upper()}{lacks[1:]}")
    print(
        "\nAdd some to the declared physics with system.effects=[NAME,...], to a simulated machine with\n"
        "plant.effects=[NAME,...]; `module:Class` names one of your own. Laws of one coordinate are named with it\n"
        "where a machine has several, coulomb_friction[q2], effects on one input of several with that:\n"
        "actuator_lag[tau2]."
    )


def catalogue(system: str | None = None) -> list[dict[str, Any]]:
    """What is known of every effect, or of those that a system (key of `SYSTEMS`, or `module:Class`) can have."""
    from nsde_torch.diagnosis.candidates import why_not
    from nsde_torch.effects import EFFECTS
    from nsde_torch.effects.law import split_name
    from nsde_torch.systems import SYSTEMS, make_system

    machine = None if system is None else make_system(system)
    chosen = EFFECTS if machine is None else machine.able_effects()
    able = {s: {split_name(name)[0] for name in cls.able_effects()} for s, cls in SYSTEMS.items()}
    rows = []
    for name, cls in chosen.items():
        fits = [s for s, effects in able.items() if name in effects] if system is None else [system]
        # why a diagnosis of the machine does not try an effect: empty where it does, None without a machine
        reason = None if machine is None else why_not(machine, name)
        rows.append({**_row(cls, fits), "no_candidate": reason})
    order = list(dict.fromkeys(tuple(row["systems"]) for row in rows))
    return sorted(rows, key=lambda row: order.index(tuple(row["systems"])))


def _row(cls: type[Effect], systems: Sequence[str]) -> dict[str, Any]:
    from nsde_torch.effects import Law

    parameters = []
    for name, spec in cls.PARAMETERS.items():
        width = len(spec.initial) if isinstance(spec.initial, tuple) else 1
        entry = {"name": name, "unit": spec.unit, "low": spec.low, "high": spec.high}
        parameters.append({**entry, "axes": "inputs" if spec.per_input else width, "help": spec.help})
    return {
        "name": cls.name,
        "port": _ANY if issubclass(cls, Law) and cls.law is cls and len(systems) != 1 else cls.port.value,
        "formula": cls.formula,
        "parameters": parameters,
        "memory_per_input": cls(n_inputs=1).n_memory,
        "exogenous": list(cls.exogenous),
        "systems": list(systems),
        "includes": list(cls.includes),
        "sentence": cls.sentence,
        "separate": cls.separate,
        "source": cls.source,
    }


def table(rows: Sequence[dict[str, Any]], width: int, *, systems: bool) -> str:
    """The catalogue as aligned tables, sources under the effects; with `systems`, headed by who they are for."""
    from nsde_torch.effects.by_run import RUN

    cells = [(row["name"], row["port"], row["formula"], _parameters(row)) for row in rows]
    fixed = [max(map(len, column)) for column in list(zip(*cells, strict=True))[:3]]
    fixed[2] = min(fixed[2], (width - sum(fixed[:2])) // 2)
    widths = [*fixed, width - sum(fixed) - len(_GAP) * len(fixed)]
    lines = _wrapped(("effect", "port", "formula", "parameters [unit]"), widths)
    lines.append(_GAP.join("-" * w for w in widths))
    heading = ""
    for row, cell in zip(rows, cells, strict=True):
        who = ", ".join(row["systems"])
        if systems and who != heading:
            heading = who
            lines += ["", f"for {who or 'machines of your own'}:"]
        lines += _wrapped(cell, widths)
        indent = " " * (fixed[0] + len(_GAP))
        said = [f"source: {row['source']}"]
        if row["no_candidate"]:
            said.insert(0, f"no candidate of a diagnosis of this machine: {row['no_candidate']}")
        elif RUN in row["exogenous"]:  # a diagnosis numbers the runs itself
            said.insert(0, "a candidate of a diagnosis of several runs in which something oscillates")
        elif row["exogenous"]:
            said.insert(0, f"a candidate of a diagnosis where the log has {', '.join(row['exogenous'])}")
        for one in said:
            lines += textwrap.wrap(one, width, initial_indent=indent, subsequent_indent=indent)
    return "\n".join(lines)


def _wrapped(cells: Sequence[str], widths: Sequence[int]) -> list[str]:
    columns = [textwrap.wrap(cell, w) or [""] for cell, w in zip(cells, widths, strict=True)]
    rows = zip_longest(*columns, fillvalue="")
    return [_GAP.join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows]


def _parameters(row: dict[str, Any]) -> str:
    shown = []
    for p in row["parameters"]:
        many = " per input" if p["axes"] == "inputs" else f" x {p['axes']}" if p["axes"] > 1 else ""
        shown.append(f"{p['name']}{many} [{p['unit']}]")
    text = ", ".join(shown)
    memory = row["memory_per_input"]
    if memory:
        text += f"; memory: {memory} state{'s' * (memory > 1)} per input"
    return text + (f"; reads {', '.join(row['exogenous'])}" if row["exogenous"] else "")
