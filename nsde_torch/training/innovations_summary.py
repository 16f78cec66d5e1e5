"""What a person reads of a training by innovations."""

from typing import Any

from nsde_torch.evaluation.report import number
from nsde_torch.innovations.actuators import Identified
from nsde_torch.innovations.networks import Learned
from nsde_torch.sysid.result import Identification


def summary(
    found: Identified | None,
    known: Identification | None,
    networks: dict[str, dict[str, Any]],
    learned: Learned | None,
) -> str:
    """What a person reads of the fit."""
    lines = []
    if found is not None:
        r = found.regression
        lines.append(
            f"fitted: declared physics by prediction errors ({r.iterations} iterations, "
            f"{'settled' if r.converged else 'not settled'})"
        )
        if found.learned:
            lines.append(
                f"learned: inputs act late, as by {found.learned} ({number(found.evidence)} nats); it is not declared, "
                "model.learn_lag=false leaves it out"
            )
    for port, n in networks.items():
        error = n["standard_error"]
        size = (
            "one block of time"
            if error is None
            else f"{n['nats']:+.1f} +- {error:.1f} nats on blocks left out"
        )
        lines.append(f"network on {port}: {size}: " + _what(n, learned))
    lines += [f"warning: {sentence}" for sentence in (known.warnings if known else ())]
    lines += [f"feedback: {sentence}" for sentence in (known.of_the_loop if known else ())]
    return "\n".join(lines)


def _what(network: dict[str, Any], learned: Learned | None) -> str:
    """What a network depends on; of one that was trained by gradients, its steps."""
    if not network["kept"]:
        return "none"
    seen = network.get("variables")
    return "of " + ", ".join(seen) if seen else f"{learned.steps if learned else 0} steps"
