"""A planned experiment: what to do, its expected evidence, and what one would see."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import stdtrit

from nsde_torch.aligned import aligned
from nsde_torch.arrays import Array
from nsde_torch.design.limits import MARGIN, ExperimentLimits
from nsde_torch.design.members import Member
from nsde_torch.design.options import DesignOptions
from nsde_torch.design.paths import SIDE, UP, point_times
from nsde_torch.design.questions import SURE, Question
from nsde_torch.design.rehearsal import Rehearsed
from nsde_torch.errors import ConfigError
from nsde_torch.systems import System
from nsde_torch.texts import rendered
from nsde_torch.whole_files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESULT, PLAN, PICTURE = "design.json", "plan.csv", "design.png"
_OFTEN = 0.8  # share of the rehearsals that break a tie from which a plan is called reliable
_STATES = 4  # that are drawn
_POINTS = 600  # of each


def write_plan(file: Path, names: tuple[str, ...], rows: Array) -> None:
    """Write a plan as CSV: times and what is given from then on, (n, 1 + columns)."""
    head = ",".join(("t", *names))
    np.savetxt(file, rows, fmt="%.9g", delimiter=",", header=head, comments="", encoding="utf-8")


def read_design(folder: str | Path) -> dict[str, Any]:
    """Content of `design.json`; a ConfigError where the folder holds none."""
    file = Path(folder) / RESULT
    if not file.is_file():
        raise ConfigError(f"{folder} holds no {RESULT}; `nsde design` writes one.")
    content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return content


def report(content: Mapping[str, Any]) -> str:
    """What `nsde design` prints, from the content of `design.json`."""
    q, expected = content["question"], content["expected"]
    if q["kind"] == "tie":
        own = {"tie": True, "table": _table(content), "least": min(e["separated"] for e in expected)}
    else:
        asked, parameters = q["parameters"], expected[0]["parameters"].items()
        shown = {n: p for n, p in parameters if any(n == a or n.startswith(f"{a}[") for a in asked)}
        own = {"tie": False, "shown": shown}
    return rendered(__file__, "design.txt", **content, **own, often=_OFTEN)


def _table(content: Mapping[str, Any]) -> str:
    """Expected evidence of the plan and of usual inputs, where each member is true."""
    rows = [["", *(f"if {name} is true".rjust(24) for name in content["question"]["names"])]]
    for one in ({**content, "name": "designed"}, *content["baselines"]):
        nats = [e["nats"] for e in one["expected"]]
        said = (f"{n['mean']:.1f} ({n['low_90']:.1f} to {n['high_90']:.1f})" for n in nats)
        rows.append([one["name"], *said])
    return "\n".join(aligned(rows))


def picture(experiment: Experiment) -> Figure:
    """Inputs over time, states with their 90 % bands for each member, and the expected evidence of all plans."""
    from nsde_torch.plots.experiment import experiment_figure

    e, units = experiment, experiment.units
    t = e.dt * np.arange(len(e.plan.table) + 1, dtype=np.float64)
    some = np.unique(np.linspace(0, len(t) - 1, min(len(t), _POINTS)).round().astype(int))
    inputs = np.concatenate((e.plan.table, e.plan.table[-1:]))
    unit = {"yaw": "rad", **units}
    given = {f"{name} [{unit[name]}]": inputs[:, i] for name, i in e.given.items()}
    seen = {}
    for i in _telling(experiment):
        name = e.system.state_names[i]
        bands = [np.quantile(r.states[:, some, i], [0.05, 0.5, 0.95], axis=0) for r in e.plan.rehearsed]
        seen[f"{name} [{units[name]}]"] = [(low, middle, high) for low, middle, high in bands]
    q = e.question
    nats, title = None, f"An experiment to show {', '.join(q.parameters)}"
    if not q.parameters:
        nats = {p.name: [p.nats(i) for i in range(len(q.names))] for p in (e.plan, *e.baselines)}
        title = f"Which is true: {' or '.join(q.names)}?"
    return experiment_figure((t, given), (t[some], seen), q.names, nats, title=title)


def _telling(e: Experiment) -> list[int]:
    """States to draw: those in which members differ most beside what their parameters leave open."""
    spread = [r.states.std(0).mean(0) for r in e.plan.rehearsed]
    middle = [np.median(r.states, 0) for r in e.plan.rehearsed]
    apart = max((np.abs(a - b).max(0) for a in middle for b in middle), key=lambda d: float(d.sum()))
    order = np.argsort(-apart / np.maximum(np.mean(spread, 0), 1e-12))[:_STATES]
    return sorted(int(i) for i in order)


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
        names, units = (*s.input_names, *s.state_names), (*s.input_units, *s.state_units)
        return dict(zip(names, units, strict=True))

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
        return report(self.content())

    def save(self, folder: str | Path) -> Path:
        """Write `plan.csv`, `design.png` and last `design.json`, which says that all is there; returns the folder."""
        from nsde_torch.plots.style import save as save_figure

        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_plan(folder / PLAN, tuple(self.given), self.rows())
        save_figure(picture(self), folder / PICTURE)
        write_whole(folder / RESULT, json.dumps(self.content(), indent=1, allow_nan=False) + "\n")
        return folder

    def content(self) -> dict[str, Any]:
        """What `design.json` holds."""
        units = self.units
        use = np.max([r.use.max(0) for r in self.plan.rehearsed], axis=0)
        beyond, at = None, int(self.most_use.argmax())  # the state of which more would be most informative
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
