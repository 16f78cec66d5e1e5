"""What a diagnosis named, as plain values and as a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nsde_torch.diagnosis.result import Diagnosis


def parameters_of(found: Diagnosis) -> dict[str, Any]:
    """Value, 90 % interval and unit of the parameters found and declared, by name."""
    return {
        name: {"value": entry["value"], "interval_90": entry["interval_90"], "unit": entry["unit"]}
        for name, entry in {**found.content()["declared_parameters"], **found.parameters}.items()
    }


def words_of(added: Sequence[str], declared: str, verdict: str = "effect_found") -> list[str]:
    """A sentence that names what was found beside the declared physics."""
    if not added:
        return [f"Nothing was found missing in {declared}."]
    lead = " This is a lead: something else is missing too." if verdict == "unexplained" else ""
    return [f"Missing in {declared}: {', '.join(added)}.{lead}"]
