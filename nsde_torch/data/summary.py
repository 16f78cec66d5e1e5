"""The data summary: what is in a data set, what was found in it and what was done, for people and as JSON."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from nsde_torch.aligned import aligned
from nsde_torch.arrays import Array
from nsde_torch.data.inputs import InputRank
from nsde_torch.data.kinematics import Slope, pool
from nsde_torch.data.quaternion import euler_zyx
from nsde_torch.data.raw import Finding
from nsde_torch.data.run import DataSet, Run, fingerprint
from nsde_torch.data.system_info import SystemInfo, moving_columns

_FIGURES = ("minimum", "q05", "median", "q95", "maximum")  # of a channel, over all segments
# of the flight envelope of a multirotor (the supplement's Figure 15): the first and the last word of its keys, what
# people read, and digits. Roll, pitch and yaw are magnitudes; the heading is relative to the mean yaw of each run
_ENVELOPE = (
    ("speed", "m_per_s", "speed [m/s]", 2),
    ("roll", "deg", "|roll| [deg]", 1),
    ("pitch", "deg", "|pitch| [deg]", 1),
    ("yaw", "deg", "|yaw| [deg]", 1),
    ("heading", "deg", "|yaw - mean| [deg]", 1),
)


@dataclass(frozen=True)
class DataSummary:
    """Summary of a data set; `as_dict` for JSON, `str` for people."""

    kind: str  # reader
    system: str  # name of the system
    dt: float  # step [s]
    clock_scale: float  # physical seconds for each logged second that the models use
    runs: tuple[Mapping[str, Any], ...]  # name, rows, duration_s (inside segments) and segments of each run
    channels: tuple[Mapping[str, Any], ...]  # name, unit and figures of each state, input and further channel
    envelope: Mapping[str, float] | None  # 95 % quantiles and maxima of a multirotor's flight, otherwise None
    input_rank: InputRank  # numerical rank of the inputs
    slopes: tuple[Slope, ...]  # measured clock slopes, axis by axis
    findings: tuple[Finding, ...]  # what was found and done

    @property
    def duration(self) -> float:
        """Recorded time inside segments [s]."""
        return float(sum(run["duration_s"] for run in self.runs))

    def as_dict(self) -> dict[str, Any]:
        """Plain containers for JSON; units in the keys or beside the figures."""
        pooled = pool(self.slopes)
        return {
            "kind": self.kind,
            "system": self.system,
            "dt_s": self.dt,
            "rate_hz": 1.0 / self.dt,
            "duration_s": self.duration,
            "rows": sum(run["rows"] for run in self.runs),
            "clock_scale": self.clock_scale,
            "clock_measured": {
                "scale": pooled.value if self.slopes else None,
                "standard_error": pooled.error if self.slopes else None,
                "spread": pooled.spread,
                "axes": [asdict(s) for s in self.slopes],
            },
            "runs": list(self.runs),
            "channels": list(self.channels),
            "envelope": self.envelope,
            "input_rank": asdict(self.input_rank),
            "findings": [finding.as_dict() for finding in self.findings],
        }

    def to_json(self) -> str:
        """The summary as a JSON text."""
        return json.dumps(self.as_dict(), indent=1)

    @property
    def short(self) -> str:
        """What is in the data set in a line, and what was found in it."""
        return "\n".join([self._head, *(f"  {text}" for text in _grouped(self.findings))])

    @property
    def _head(self) -> str:
        return (
            f"data: {self.kind}, {self.system}, {len(self.runs)} runs, {self.duration:.1f} s at "
            f"{1 / self.dt:.4g} Hz, clock scale {self.clock_scale:.4f}"
        )

    def __str__(self) -> str:
        lines = [self._head]
        table: list[tuple[str, ...]] = [("run", "rows", "seconds", "segments")]
        shown = self.runs if len(self.runs) <= 12 else self.runs[:10]
        for run in shown:
            parts = " ".join(f"{a}-{b}" for a, b in run["segments"][:3]) + " ..." * (len(run["segments"]) > 3)
            table.append((run["name"], str(run["rows"]), f"{run['duration_s']:.2f}", parts))
        lines += [f"  {row}" for row in aligned(table)]
        if len(shown) < len(self.runs):
            lines.append(f"  ... and {len(self.runs) - len(shown)} runs more")
        table = [("channel", "unit", "min", "5 %", "median", "95 %", "max")]
        table += [(c["name"], c["unit"], *(f"{c[k]:.4g}" for k in _FIGURES)) for c in self.channels]
        lines += [f"  {row}" for row in aligned(table)]
        e = self.envelope
        if e is not None:
            table = [("envelope", "95 %", "max")]
            for key, unit, words, digits in _ENVELOPE:
                ends = (e[f"{key}_{end}_{unit}"] for end in ("q95", "max"))
                table.append((words, *(f"{value:.{digits}f}" for value in ends)))
            lines += [f"  {row}" for row in aligned(table)]
        if self.input_rank.channels:
            lines.append(f"inputs span {self.input_rank.rank} of {self.input_rank.channels} dimensions")
        if self.findings:
            lines.append("found:")
            lines += [f"  {text}" for text in _grouped(self.findings)]
        else:
            lines.append("found: nothing amiss")
        return "\n".join(lines)


def _grouped(findings: Sequence[Finding]) -> list[str]:
    """One line a finding; a kind that many runs share is reported once, with the first run as the example."""
    out = []
    for kind in dict.fromkeys(f.kind for f in findings):
        same = [f for f in findings if f.kind == kind]
        out += [str(f) for f in same[:3]]
        if len(same) > 3:
            out.append(f"... {kind} in {len(same) - 3} runs more, {sum(f.count for f in same)} in all")
    return out


def _inside(run: Run, column: Array) -> Array:
    """Rows of all segments of a run."""
    return np.concatenate([column[a:b] for a, b in run.segments])


def _channel(name: str, unit: str, parts: Sequence[Array]) -> dict[str, Any]:
    figures = np.quantile(np.concatenate(parts), [0.0, 0.05, 0.5, 0.95, 1.0]).tolist()
    return {"name": name, "unit": unit, **dict(zip(_FIGURES, figures, strict=True))}


def envelope(runs: Sequence[Run], system: SystemInfo) -> dict[str, float] | None:
    """Flight envelope of a multirotor; None for a system without position, velocity and attitude."""
    columns = moving_columns(system)
    if columns is None:
        return None
    parts = []
    for run in runs:
        roll, pitch, yaw = euler_zyx(_inside(run, run.x[:, system.quaternion])).T
        speed = np.linalg.norm(_inside(run, run.x[:, columns[0]]), axis=1)
        mean = np.arctan2(np.sin(yaw).mean(), np.cos(yaw).mean())
        heading = np.arctan2(np.sin(yaw - mean), np.cos(yaw - mean))
        parts.append(np.stack([speed, *np.degrees(np.abs([roll, pitch, yaw, heading]))]))
    values = np.concatenate(parts, axis=1)
    ends = {"q95": np.quantile(values, 0.95, axis=1).tolist(), "max": values.max(axis=1).tolist()}
    rows = enumerate(_ENVELOPE)
    return {f"{key}_{end}_{unit}": ends[end][k] for k, (key, unit, *_) in rows for end in ends}


def data_set_of(
    runs: Sequence[Run],
    system: SystemInfo,
    *,
    kind: str,
    dt: float,
    clock_scale: float,
    slopes: Sequence[Slope],
    rank: InputRank,
    findings: Sequence[Finding],
) -> DataSet:
    """A data set of checked runs, with their figures and what the checks found."""
    states = enumerate(zip(system.state_names, system.state_units, strict=True))
    inputs = enumerate(zip(system.input_names, system.input_units, strict=True))
    others = dict.fromkeys(name for run in runs for name in run.extra)
    channels = [
        *(_channel(*names, [_inside(run, run.x[:, k]) for run in runs]) for k, names in states),
        *(_channel(*names, [_inside(run, run.u[:, k]) for run in runs]) for k, names in inputs),
        *(_channel(n, "", [_inside(run, run.extra[n]) for run in runs if n in run.extra]) for n in others),
    ]
    summary = DataSummary(
        kind=kind,
        system=system.name,
        dt=dt,
        clock_scale=clock_scale,
        runs=tuple(
            {
                "name": run.name,
                "rows": len(run),
                "duration_s": run.duration,
                "segments": [list(s) for s in run.segments],
            }
            for run in runs
        ),
        channels=tuple(channels),
        envelope=envelope(runs, system),
        input_rank=rank,
        slopes=tuple(slopes),
        findings=tuple(findings),
    )
    return DataSet(
        system_name=system.name,
        runs=runs,
        dt=dt,
        clock_scale=clock_scale,
        summary=summary,
        fingerprint=fingerprint(runs, system_name=system.name, dt=dt, clock_scale=clock_scale),
        state_names=tuple(system.state_names),
        input_names=(*system.input_names, *system.exogenous),
        kind=kind,
    )
