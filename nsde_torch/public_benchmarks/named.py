"""What a diagnosis named, as plain values and as a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nsde_torch.api.diagnosing import diagnose
from nsde_torch.api.reading import Data
from nsde_torch.public_benchmarks.work import Say


def diagnosed(data: Data, *, say: Say, **options: Any) -> dict[str, Any]:
    """Diagnose runs, as plain values that a stage can keep.

    Args:
        data: The runs.
        say: Told stage, number done and number in all.
        options: Of `nsde_torch.diagnose`.

    Returns:
        `added` (names), `leads` (those of them that are provisional), `verdict`, `effects` (with values), `values` of
        the declared parameters, and `parameters` found and declared with value, 90 % interval and unit.
    """
    seen = diagnose(data, say=say, **options).finished()
    content = seen.content()
    declared = content["declared_parameters"]
    return {
        "added": list(seen.added),
        "leads": [entry["name"] for entry in content.get("findings", ()) if entry["lead"]],
        "verdict": seen.verdict,
        "effects": seen.effects,
        "values": {name: entry["value"] for name, entry in declared.items()},
        "parameters": {
            name: {key: entry[key] for key in ("value", "interval_90", "unit")}
            for name, entry in {**declared, **content["parameters"]}.items()
        },
    }


def words_of(added: Sequence[str], declared: str, verdict: str = "effect_found") -> list[str]:
    """A sentence that names what was found beside the declared physics."""
    if not added:
        return [f"Nothing was found missing in {declared}."]
    lead = " This is a lead: something else is missing too." if verdict == "unexplained" else ""
    return [f"Missing in {declared}: {', '.join(added)}.{lead}"]
