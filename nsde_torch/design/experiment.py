"""A planned experiment: what to do, what it is expected to tell, and what one would see."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from nsde_torch.arrays import Array
from nsde_torch.design.limits import MARGIN, ExperimentLimits
from nsde_torch.design.members import Member
from nsde_torch.design.options import DesignOptions
from nsde_torch.design.paths import SIDE, UP, point_times
from nsde_torch.design.questions import SURE, Question
from nsde_torch.design.rehearsal import Rehearsed
from nsde_torch.systems import System

LEVELS = (90, 99)
"""Levels of the intervals of expected evidence [%]; outside of the last one, evidence is not what was expected."""


@dataclass(frozen=True)
class PlannedRun:
    """An experiment that was judged, with its rehearsals."""

    name: str
    table: Array  # its rows (N, m)
    words: tuple[str, ...]  # what a person reads of it
    worth: float  # what it is worth without noise (see `proposals`)
    rehearsed: tuple[Rehearsed, ...] = ()  # with each member true; none yet where it was only judged

    @property
    def count(self) -> int:
        """Number of its rehearsals with each member true."""
        return len(self.rehearsed[0].evidence)

    def nats(self, truth: int) -> dict[str, float]:
        """Expected evidence where a member is true: mean, and where that of one experiment lies [nats].

        Prediction intervals of one more normal number after those of the rehearsals (Student): the 5 % quantile of a
        dozen rehearsals is not what the next one stays above in 95 % of cases.
        """
        e = self.rehearsed[truth].evidence
        mean, spread = float(e.mean()), float(e.std(ddof=1)) * (1 + 1 / len(e)) ** 0.5
        out = {"mean": mean}
        for level in LEVELS:
            half = float(stdtrit(len(e) - 1, 0.5 + level / 200)) * spread
            out |= {f"low_{level}": mean - half, f"high_{level}": mean + half}
        return out


@dataclass(frozen=True)
class Experiment:
    """A planned experiment."""

    system: System  # declared system
    question: Question  # what it is asked
    members: tuple[Member, ...]  # what may be true, fitted
    plan: PlannedRun  # what to do
    baselines: tuple[PlannedRun, ...]
    """Usual experiments of the same length and limits, the best size of each."""
    limits: ExperimentLimits  # limits
    start: Array  # first state (nx,)
    dt: float  # step of the log [s]
    hertz: tuple[float, float] | None  # lowest and highest frequency of the inputs [Hz]; None of flights
    options: DesignOptions  # settings
    seconds: float  # time that it took
    most: float  # the most that an experiment was worth that was tried, within the limits or beyond
    most_use: Array  # largest share of each state's range that this one takes (nx,)

    @property
    def units(self) -> dict[str, str]:
        """Units of inputs and states."""
        s = self.system
        return {
            **dict(zip(s.input_names, s.input_units, strict=True)),
            **dict(zip(s.state_names, s.state_units, strict=True)),
        }

    @property
    def given(self) -> dict[str, int]:
        """What the plan gives, with its columns of the table: inputs, or a place and heading to fly to."""
        if self.hertz is not None:
            return {name: i for i, name in enumerate(self.system.input_names)}
        return {"p_x": 0, "p_y": 1, "p_z": 2, "yaw": 9}

    def rows(self) -> Array:
        """Rows of `plan.csv` (n, 1 + columns): inputs from step to step, or the points of a path."""
        table, steps = self.plan.table[:, list(self.given.values())], len(self.plan.table)
        if self.hertz is not None:
            return np.column_stack((self.dt * np.arange(steps + 1), np.concatenate((table, table[-1:]))))
        times = point_times(steps * self.dt)
        at = np.minimum((times / self.dt).round().astype(int), steps - 1)
        return np.column_stack((times, table[at]))

    @property
    def report(self) -> str:
        """The plan in words, as `nsde design` prints it."""
        from nsde_torch.design.files import lines

        return "\n".join(lines(self.content()))

    def save(self, folder: str | Path) -> Path:
        """Write `design.json`, `plan.csv` and `design.png`; returns the folder."""
        from nsde_torch.design.files import save

        return save(self, folder)

    def content(self) -> dict[str, Any]:
        """What `design.json` holds."""
        units = self.units
        use = np.max([r.use.max(0) for r in self.plan.rehearsed], axis=0)
        beyond, at = None, int(self.most_use.argmax())  # the state of which more would tell most
        if not self.question.parameters and self.most > self.plan.worth and self.most_use[at] > 1.0 - MARGIN:
            share = float(self.most_use[at])
            beyond = {"limit": self.system.state_names[at], "share": share, "worth_nats": self.most}
        return {
            "schema": "nsde_torch.design/1",
            "system": self.system.name,
            "question": self.question.content(),
            "plan": {
                "file": "plan.csv",
                "columns": ["t", *self.given],
                "units": {"t": "s", "yaw": "rad", **units} if self.hertz is None else {"t": "s", **units},
                "duration_s": len(self.plan.table) * self.dt,
                "dt_s": self.dt,
                "start": dict(zip(self.system.state_names, self.start.tolist(), strict=True)),
                "hertz": None if self.hertz is None else list(self.hertz),
                "words": list(self.plan.words),
                "largest_share_of_limits": {
                    n: float(v) for n, v in zip(self.system.state_names, use, strict=True) if v > 0
                },
            },
            "limits": self.limits.content(units),
            "path_limits": None
            if self.hertz is not None
            else {
                "acceleration_sideways": SIDE,
                "largest_sideways": float(np.linalg.norm(self.plan.table[:, 6:8], axis=1).max()),
                "acceleration_up": UP,
                "largest_up": float(np.abs(self.plan.table[:, 8]).max()),
                "unit": "m/s2",
            },
            "expected": self._expected(self.plan),
            "baselines": [
                {"name": b.name, "rehearsals": b.count, "expected": self._expected(b)} for b in self.baselines
            ],
            "beyond_limits": beyond,
            "sure_nats": SURE,
            "rehearsals": self.plan.count,
            "seed": self.options.seed,
            "seconds": self.seconds,
        }

    def _expected(self, plan: PlannedRun) -> list[dict[str, Any]]:
        out: list[dict[str, Any]] = []
        for truth, (member, rehearsed) in enumerate(zip(self.members, plan.rehearsed, strict=True)):
            v, now = member.vector, np.sqrt(np.diag(member.covariance))
            fine = rehearsed.errors[np.isfinite(rehearsed.errors).all(1)]
            then = np.median(fine, axis=0).tolist() if len(fine) else [None] * len(now)
            one: dict[str, Any] = {
                "if_true": self.question.names[truth],
                "log_likelihood_now": member.nats,
                "parameters": {
                    label: {
                        "value": float(member.theta[i]),
                        "standard_error": float(now[i]),
                        "expected_standard_error": then[i],
                        "unit": v.units[i],
                    }
                    for i, label in enumerate(v.labels)
                },
            }
            if not self.question.parameters:  # and the share of the rehearsals that break the tie
                one |= {"nats": plan.nats(truth), "separated": float((rehearsed.evidence > SURE).mean())}
            out.append(one)
        return out
