"""The data files that the authors of the neural-SDE paper published; the kinds are recognised by their shapes.

    hexacopter, iris      {"train": [(x, u), ...], "test": ...}   x (n, 13) ENU/FLU, u (n, 6 or 4), 100 Hz
    cartpole              [(y, u), ...]   y (n, 5) = x, x_dot, sin, cos, theta_dot; u (n - 1, 1) times 25 N, 50 Hz
    mass_spring_damper    [(y, u), ...]   y (n, 2) = q, q_dot; u (n - 1, 1) zeros, 100 Hz

None of the files has a clock: rows are taken to be one nominal step apart, and the kinematic checks say how true that
is. The `test` entry of the multirotor files repeats a training flight, so that it is no further run.
"""

from pathlib import Path

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.raw import RawRun
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.data.unpickler import read_pickle
from nsde_torch.errors import DataError

CARTPOLE_FORCE = 25.0  # newtons for one unit of the published cartpole input

# columns of y and u in the file -> what the file is, and its nominal step [s]
_KINDS = {
    (13, 6): ("hexacopter flights", 0.01),
    (13, 4): ("quadrotor (iris) flights", 0.01),
    (5, 1): ("cartpole episodes", 0.02),
    (2, 1): ("mass-spring-damper trajectories", 0.01),
}


def _pairs(content: object, where: str) -> list[tuple[Array, Array]]:
    """The (states, inputs) pairs of a file, checked; entries that repeat an earlier one are left out."""
    if isinstance(content, dict):
        groups = [content[k] for k in ("train", "test") if k in content]
        if not groups:
            raise DataError(
                f"{where}: expected the keys 'train' and 'test'; got {sorted(map(str, content))}."
            )
    else:
        groups = [content]
    pairs: list[tuple[Array, Array]] = []
    for group in groups:
        if not isinstance(group, list | tuple):
            raise DataError(
                f"{where}: expected a list of (states, inputs) pairs; got {type(group).__name__}."
            )
        for entry in group:
            if not (isinstance(entry, list | tuple) and len(entry) == 2):
                raise DataError(
                    f"{where}: expected (states, inputs) pairs; entry {len(pairs)} is a "
                    f"{type(entry).__name__}."
                )
            x, u = (np.asarray(part, dtype=np.float64) for part in entry)
            if x.ndim != 2 or u.ndim != 2 or len(x) - len(u) not in (0, 1):
                raise DataError(
                    f"{where}: entry {len(pairs)} has shapes {x.shape} and {u.shape}; expected (n, states) "
                    "and (n or n - 1, inputs)."
                )
            if not any(np.array_equal(x, a) and np.array_equal(u, b) for a, b in pairs):
                pairs.append((x, u))
    if not pairs:
        raise DataError(f"{where} holds no runs.")
    shapes = {(x.shape[1], u.shape[1]) for x, u in pairs}
    if len(shapes) > 1:
        raise DataError(f"{where} mixes runs of different widths (states, inputs): {sorted(shapes)}.")
    return pairs


def read_published(system: SystemInfo, *, path: str | Path, dt: float | None = None) -> list[RawRun]:
    """Runs of one of the authors' files, which the system must fit, on a step [s] or the published rate of their kind.

    A DataError refuses a file that is unreadable, of another system or of no known kind.
    """
    path = Path(path)
    pairs = _pairs(read_pickle(path), str(path))
    shape = pairs[0][0].shape[1], pairs[0][1].shape[1]
    if shape not in _KINDS:
        known = "; ".join(f"{what}: {k[0]} states, {k[1]} inputs" for k, (what, _) in _KINDS.items())
        raise DataError(
            f"{path}: {shape[0]} state and {shape[1]} input columns belong to no published file ({known}). "
            "Write other data as CSV and read it with kind `csv`."
        )
    what, nominal = _KINDS[shape]
    nx, nu = len(system.state_names), len(system.input_names)
    cartpole = shape == (5, 1)
    if (4 if cartpole else shape[0], shape[1]) != (nx, nu) or system.exogenous:
        reason = (
            f"reads the exogenous channels {system.exogenous}"
            if system.exogenous
            else f"has {nx} states, {nu} inputs"
        )
        raise DataError(
            f"{path} holds {what} ({shape[0]} state and {shape[1]} input columns); the system "
            f"{system.name!r} {reason}. Choose the file's own system."
        )
    step = nominal if dt is None else float(dt)
    runs = []
    digits = len(str(len(pairs) - 1))
    before = 0  # rows of the runs before: they were recorded one after another, and a battery remembers
    for k, (y, u) in enumerate(pairs):
        t = step * np.arange(before, before + len(y), dtype=np.float64)
        before += len(y)
        name = f"{path.stem}_{k:0{digits}d}"
        if cartpole:  # theta unwrapped, 0 upright
            theta = np.unwrap(np.arctan2(y[:, 2], y[:, 3]))
            y, u = np.stack([y[:, 0], y[:, 1], theta, y[:, 4]], axis=1), CARTPOLE_FORCE * u
        runs.append(RawRun(name, t, y, u, source=path.name))
    return runs
