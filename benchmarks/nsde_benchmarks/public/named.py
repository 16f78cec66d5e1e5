"""What a diagnosis named, as plain values and as a sentence."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from nsde_torch.api.diagnosing import diagnose
from nsde_torch.api.reading import Data

from .files import Say

Rung = Mapping[str, Any]
"""What a fit made: `effects`, `values`, and its error on what was held out."""


Tried = Callable[[tuple[str, ...], Mapping[str, Any]], Rung]


def ladder(
    tried: Tried, names: Iterable[str], *, first: Mapping[str, Any], error: str, gain: float
) -> list[Rung]:
    """Fits without any term and with one more in each, the best first."""
    rungs = [tried((), first)]
    while True:
        last = rungs[-1]
        taken = tuple(last["effects"])
        more = [tried((*taken, name), last["values"]) for name in names if name not in taken]
        best = min(more, key=lambda made: float(made[error]), default=None)
        if best is None or best[error] > (1.0 - gain) * last[error]:
            return rungs
        rungs.append(best)


def diagnosed(data: Data, *, say: Say, **options: Any) -> dict[str, Any]:
    """Diagnose runs, as plain values that a stage can keep."""
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
    lead = " This is provisional: something else is missing too." if verdict == "unexplained" else ""
    return [f"Missing in {declared}: {', '.join(added)}.{lead}"]
