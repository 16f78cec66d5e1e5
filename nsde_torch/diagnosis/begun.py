"""A diagnosis that another one goes on from: what it had selected, of the same data and the same declared model."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nsde_torch.data import DataSet
from nsde_torch.diagnosis.candidates import joined
from nsde_torch.diagnosis.files import EFFECTS, RESULT
from nsde_torch.effects import effect_class
from nsde_torch.effects import files as effects_files
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.errors import CheckpointError, ConfigError, DataError
from nsde_torch.models.identified import SysidSpec
from nsde_torch.systems import System


@dataclass(frozen=True)
class Begun:
    """What an earlier diagnosis had selected. Laws beyond the catalogue are none of it: they are looked for anew."""

    effects: Mapping[str, dict[str, Any]]  # effects with values, in the order in which they were selected
    nats: Mapping[str, float]  # log likelihood that each brought [nats]

    def beside(self, system: System) -> System:
        """A system with the effects."""
        for name, values in self.effects.items():
            system = joined(system, name, values)
        return system


def declared_model(spec: SysidSpec) -> dict[str, Any]:
    """What must be the same for a diagnosis to go on, for JSON."""
    return {
        "system": spec.system,
        "effects": list(spec.effects),
        "declared": None if spec.declared is None else list(spec.declared),
        "options": dict(spec.system_options),
    }


def read_begun(folder: str | Path, data: DataSet, runs: Sequence[str], spec: SysidSpec) -> Begun:
    """What the diagnosis of a folder had selected.

    Args:
        folder: With `diagnosis.json` and `effects.yaml`.
        data: The data set of now.
        runs: Names of its runs that are looked at.
        spec: The declared model of now.

    Raises:
        CheckpointError: there is no diagnosis, or one that came to its end.
        ConfigError: of another declared model.
        DataError: of other data.
    """
    folder, what = Path(folder), f"`resume={folder}`"
    try:
        content = json.loads((folder / RESULT).read_text(encoding="utf-8"))
        of, had, nats = content["so_far"], content["data"], content["findings"]
    except OSError:
        raise CheckpointError(
            f"{what}: there is no diagnosis to go on with (no {folder / RESULT})."
        ) from None
    except (KeyError, ValueError, TypeError):
        raise CheckpointError(
            f"{what}: there is nothing to go on with: {folder / RESULT} is no diagnosis, or one that came to its end."
        ) from None
    declared = json.loads(json.dumps(declared_model(spec)))
    for key, before in of["declared"].items():
        if before != declared[key]:
            raise ConfigError(
                f"{what} diagnosed another declared model: its {key} was {before!r}, and is {declared[key]!r} now."
            )
    now = {"kind": data.kind, "dt_s": data.dt, "runs": list(runs), "fingerprint": data.fingerprint}
    for key, value in now.items():
        if had[key] != value:
            raise DataError(f"{what} looked at other data: {key} was {had[key]!r}, and is {value!r} now.")
    effects = effects_files.read(folder / EFFECTS, "resume")[1]
    return Begun(
        {str(effect_class(name).name): values for name, values in effects.items() if not is_law(name)},
        {f["name"]: f["evidence_nats"] for f in nats if f["kind"] == "effect"},
    )
