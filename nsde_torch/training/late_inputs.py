"""A lag or a delay of the inputs that declared physics lacks, found by the innovations and learned with the rest.

A network of the state cannot hold what an actuator remembers: in a closed loop it would learn the controller instead.
So where the declared effects carry no memory of the inputs, each law of the catalogue that does is fitted beside the
declared parameters, and the likeliest is taken if the log likelihood of the innovations rises by more than `EVIDENCE`
and its time is not nothing by two half-widths of its interval. It is reported as learned; to have it as declared
physics, name it in system.effects.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from nsde_torch.data import Run
from nsde_torch.effects import Effect, Port
from nsde_torch.errors import NsdeError
from nsde_torch.models.neural_sde import SDESpec
from nsde_torch.sysid.identify import Settled, identification, regression_of, settled
from nsde_torch.sysid.regression import ITERATIONS, Regression

LAWS = ("motor_lag", "actuator_lag", "input_delay")
"""Effects of the catalogue with which inputs act late, one time each."""
EVIDENCE = 10.0
"""Log likelihood that a law must win [nats]; 10 nats for one parameter happen by chance once in 100,000 data sets."""


@dataclass(frozen=True)
class Identified:
    """Declared physics as it was identified."""

    spec: SDESpec  # specification with the law that was learned, if any
    settled: Settled  # the regression at its optimum, and its runs
    learned: str = ""  # name of the law; empty for none
    evidence: float = 0.0  # log likelihood that it won [nats]
    method: str = "weak"  # of the identification

    @property
    def regression(self) -> Regression:
        """The regression at its optimum."""
        return self.settled.regression


def identified(
    spec: SDESpec, runs: Sequence[Run], *, clock: float, values: Mapping[str, Any], method: str = "weak"
) -> Identified:
    """Identify declared physics, with a lag or a delay of the inputs where the data show one.

    Of runs with inputs as they acted, from initial `values`. A law is looked for with the method "weak" alone, whose
    innovations are white.

    Raises:
        ConfigError, DataError, NonFiniteError: there is no parameter, nothing moves, or the physics diverges.
    """
    system = spec.make_system(values)
    base = settled(system, runs, clock=clock, method=method, width=None, iterations=ITERATIONS)
    remembers = any(isinstance(e, Effect) and e.port is Port.INPUT and e.n_memory for e in system.effects)
    found = Identified(spec, base, method=method)
    if not spec.learn_lag or remembers or method != "weak":
        return found
    rows = len(base.regression.series)  # a memory takes some rows for itself
    before = sum(noise.likelihood(rows) for noise in base.regression.noises)
    for name in LAWS:
        wider = replace(spec, effects=(*spec.effects, name))
        try:
            machine = wider.make_system(values)
            base.regression.vector.write(machine, base.regression.theta)
            regression = regression_of(machine, base.runs, clock=clock)
            regression.run(ITERATIONS)
            won = sum(noise.likelihood(rows) for noise in regression.noises) - before
            if won > max(EVIDENCE, found.evidence) and _shown(regression, name):
                found = Identified(wider, replace(base, regression=regression), name, won)
        except NsdeError:
            continue  # a law that does not fit the system, or cannot be followed at this step
    return found


def _shown(regression: Regression, law: str) -> bool:
    """Whether the times of a law are surely more than nothing."""
    sure = identification(regression, "weak").parameters()
    return all(
        half is not None and value > 2.0 * half
        for key, p in sure.items()
        if key.startswith(f"{law}.")
        for value, half in zip(p["value"], p["half_width_90"], strict=True)  # type: ignore[call-overload]
    )
