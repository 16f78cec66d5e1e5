"""What `diagnosis.json` says of laws beyond the catalogue: values, LaTeX, text for SymPy, and what they look like."""

from __future__ import annotations

from typing import Any

from nsde_torch.diagnosis.fitted import effect_of
from nsde_torch.diagnosis.outcome import Found, Outcome
from nsde_torch.effects.expression import Expression
from nsde_torch.effects.expression_forms import latex, sympy_text, valued
from nsde_torch.effects.expression_grammar import Call, Node, Power, Variable, Written, nodes
from nsde_torch.systems import System


def law(outcome: Outcome, f: Found) -> dict[str, Any]:
    """Keys of a finding that only a law has; nothing for an effect of the catalogue."""
    effect = effect_of(outcome.system, f.name)
    if not isinstance(effect, Expression):
        return {}
    values = {name: float(value) for name, (value, _) in effect.declared_parameters().items()}
    return {
        "verified": not f.provisional,
        "law": valued(effect.law, values),
        "unit": effect.unit,
        "latex": latex(effect.law, values),
        "sympy": sympy_text(effect.law, values),
        "looks_like": looks_like(effect.law, values, outcome.declared_system),
    }


def looks_like(written: Written, values: dict[str, float], system: System) -> str | None:
    """What a law of one term may be, by the kinds of its variables; None where nothing can be said.

    Args:
        written: The law.
        values: Its coefficients.
        system: The machine, which knows positions from velocities.
    """
    if len(written.right.parts) != 1:
        return None
    every = list(nodes(written.right))
    names = {n.name for n in every if isinstance(n, Variable) and not n.logged}
    positions = {p for p, _, _ in system.position_derivatives}
    speeds = {v for _, v, _ in system.position_derivatives} | {
        name
        for name, unit in zip(system.feature_names, system.feature_units, strict=True)
        if unit in ("m/s", "rad/s")
    }
    if names & set(system.input_names) and names & positions:
        return "a gain of the input that depends on the place"
    if names and names <= positions:
        return _of_place(every, names, written.sizes, values)
    if len(names) > 1 and names <= speeds:
        return "a coupling of motions, as Coriolis and gyroscopic forces are, or drag across the motion"
    if len(names & speeds) == 1 and names <= positions | speeds and names & positions:
        return "friction that depends on the place" if _powers(every, names & speeds) == {1} else None
    return None


def _of_place(
    every: list[Node], names: set[str], sizes: tuple[str, ...], values: dict[str, float]
) -> str | None:
    """What a force that depends on places alone may be."""
    if len(names) > 1:
        return "a spring between coordinates"
    hinge = next((n for n in every if isinstance(n, Call) and n.function in ("max", "min")), None)
    if hinge is None:
        return None if any(isinstance(n, Call) for n in every) else "a spring that is not straight"
    outward = 1.0 if hinge.function == "max" else -1.0
    # of a bare hinge: max(q - k, 0) is positive, min(q - k, 0) negative, and a spring pushes against either
    pushes_back = values[sizes[0]] < 0
    where = "above" if outward > 0 else "below"
    return f"a stop or a spring that is met {where} that place" if pushes_back else None


def _powers(every: list[Node], names: set[str]) -> set[int]:
    """Powers in which variables stand."""
    raised = {n.base.name: n.power for n in every if isinstance(n, Power) and isinstance(n.base, Variable)}
    return {raised.get(name, 1) for name in names}
