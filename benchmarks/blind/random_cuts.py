"""Random pieces of logs through a whole diagnosis: does every one end in an answer or in one sentence?

    python benchmarks/blind/random_cuts.py --seed 1 --count 200 --out runs/cuts

A log of a machine is cut: 1 to 5,000 rows in one to four runs, every k-th row, columns that are missing, held, zero,
copied, rounded or exact. `nsde diagnose` runs in a process of its own. An answer is exit status 0; a refusal is exit
status 2 with one sentence. Anything else is a fault, and so is a diagnosis that takes more than a minute of a processor
or 1 GiB, or a warning of NumPy on the screen.
"""

import contextlib
import io
import os
import signal
import time
from functools import partial
from pathlib import Path

import numpy as np
from study import Json, answers, numbered, options, save

from nsde_torch.cli.main import main as nsde

STEPS = {  # of the logs that are cut [s]
    "mass_spring_damper": (0.0005, 0.002, 0.01, 0.02),
    "cartpole": (0.0005, 0.002, 0.01, 0.02),
    "quadrotor": (0.002, 0.005, 0.01),
    "hexacopter": (0.005, 0.01),
}
EFFECTS = {
    "mass_spring_damper": ("", "coulomb_friction", "cubic_stiffness", "input_delay"),
    "cartpole": ("", "coulomb_friction", "quadratic_damping", "constant_force"),
    "quadrotor": ("", "linear_drag", "motor_lag", "constant_wind"),
    "hexacopter": ("", "linear_drag", "ground_effect", "motor_lag"),
}
TIME, MEMORY = 60.0, 1024.0  # [s], [MiB]
_LONGEST = 300.0  # [s] after which a diagnosis is stopped


def source(folder: Path, system: str, dt: float, effect: str, seed: int) -> Path:
    """A long log, simulated once for all cuts of it."""
    out = folder / f"{system}_{dt:g}_{effect or 'none'}"
    if not out.exists():
        seconds = min(40.0, 6000 * dt)
        words = [f"system={system}", f"out={out}", f"dt={dt:g}", f"durations=[{seconds:g},{seconds:g}]"]
        if effect:
            words.append(f"plant.effects=[{effect}]")
        if nsde(["simulate", *words, f"seed={seed}"]):
            raise SystemExit(f"{system} was not simulated")
    return out


def cut(log: Path, out: Path, rng: np.random.Generator, most: int = 5000) -> str:
    """Writes one cut; returns what was done to it, in words."""
    files = sorted(log.glob("*.csv"))
    head = files[0].read_text(encoding="utf-8").partition("\n")[0].split(",")
    tables = [np.loadtxt(f, delimiter=",", skiprows=1, ndmin=2) for f in files]
    stride = int(rng.choice([1, 1, 1, 2, 5, 10, 25]))
    runs = int(rng.choice([1, 2, 2, 3, 4]))
    words = [f"every {stride}"]
    pieces = []
    for _ in range(runs):
        table = tables[rng.integers(len(tables))][::stride]
        rows = int(np.exp(rng.uniform(0.0, np.log(most))))
        start = int(rng.integers(0, max(len(table) - rows, 0) + 1))
        pieces.append(table[start : start + rows].copy())
    words.append("rows " + "+".join(str(len(p)) for p in pieces))
    keep = list(range(len(head)))
    for k in range(1, len(head)):
        kinds = ["as it is", "missing", "held", "zero", "copied", "rounded", "nan"]
        kind = rng.choice(kinds, p=[0.88, *[0.02] * 6])
        if kind == "as it is":
            continue
        words.append(f"{head[k]} {kind}")
        if kind == "missing":
            keep.remove(k)
        for p in pieces:
            if kind == "held":
                p[:, k] = p[0, k]
            elif kind == "zero":
                p[:, k] = 0.0
            elif kind == "copied":
                p[:, k] = p[:, int(rng.integers(1, len(head)))]
            elif kind == "rounded":
                p[:, k] = np.round(p[:, k], 1)
            elif kind == "nan":
                p[rng.random(len(p)) < 0.1, k] = np.nan
    if rng.random() < 0.3:
        for p in pieces:
            p[:, 0] -= p[0, 0]
    for n, p in enumerate(pieces):
        save(out / f"run_{n}.csv", [head[k] for k in keep], [p[:, keep]])
    return ", ".join(words)


def diagnosed(words: list[str], screen: Path) -> Json:
    """One diagnosis in a process of its own, split off from this one, whose modules are loaded."""
    started = time.perf_counter()
    child = os.fork()
    if not child:
        try:
            out = os.open(screen, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(out, 1)
            os.dup2(out, 2)
            os._exit(nsde(["diagnose", *words]))
        finally:
            os._exit(70)  # an exception that no one caught
    while True:
        done, status, used = os.wait4(child, os.WNOHANG)
        seconds = time.perf_counter() - started
        if done:
            break
        if seconds > _LONGEST:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.1)
    text = screen.read_text(encoding="utf-8", errors="replace")
    text += "\nstopped: no end" if seconds > _LONGEST else ""
    about = {"code": os.waitstatus_to_exitcode(status), "text": text, "mib": used.ru_maxrss / 1024.0}
    return {**about, "seconds": used.ru_utime + used.ru_stime}


def fault(answer: Json) -> str:
    """What is wrong with an answer; empty if nothing is."""
    text = answer["text"]
    if "no end" in text[-20:]:
        return "no end"
    if "Traceback" in text or answer["code"] not in (0, 2):
        return "traceback"
    if "Warning:" in text:
        return "warning of a library"
    if answer["seconds"] > TIME:
        return f"{answer['seconds']:.0f} s"
    if answer.get("mib", 0.0) > MEMORY:
        return f"{answer['mib']:.0f} MiB"
    return ""


def one(folder: Path, seed: int, number: int) -> Json:
    rng = np.random.default_rng([seed, number])
    system = str(rng.choice(list(STEPS)))
    dt, effect = float(rng.choice(STEPS[system])), str(rng.choice(EFFECTS[system]))
    place = folder / f"case_{number:03d}"
    done = cut(source(folder / "sources", system, dt, effect, seed), place / "data", rng)
    words = [f"system={system}", "data=csv", f"data.path={place / 'data'}", "retrain=false"]
    answer = diagnosed([*words, f"out_dir={place / 'out'}"], place / "screen.txt")
    answer |= {"system": system, "dt": dt, "effect": effect, "cut": done}
    return answer | {"fault": fault(answer)}


def told(a: Json) -> str:
    of = f"{a['system']} {a['dt']:g} s, {a['effect'] or 'nothing'}; {a['cut']}"
    return f"{a['code']} {a['seconds']:.1f} s {a['fault']}: {of}"


def main() -> None:
    given = options(__doc__, "out", seed=1, first=0, count=200).parse_args()
    warm = ["diagnose", "system=mass_spring_damper", "data=csv", "data.path=/nowhere"]
    with contextlib.suppress(SystemExit), contextlib.redirect_stderr(io.StringIO()):
        nsde(warm)  # loads what every diagnosis loads
    done = answers(given.out / "answers", numbered(given, partial(one, given.out)), told)
    wrong = [f"{a['case']:>4} {told(a)}" for a in done if a["fault"]]
    codes, longest = [a["code"] for a in done], max(a["seconds"] for a in done)
    counts = (
        f"{codes.count(0)} answers, {codes.count(2)} refusals, {len(wrong)} faults; longest {longest:.0f} s"
    )
    print("\n".join([*wrong, f"{len(done)} cuts: {counts}"]))


if __name__ == "__main__":
    main()
