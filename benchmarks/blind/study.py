"""What studies share: one thread a process, command lines, files of cases and answers, intervals that hold.

A folder of cases has the logs of a case in `data/NAME`, what is true of it in `truth/NAME.json`, and what was answered
in `answers/NAME.json`.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

Json = dict[str, Any]
Array = NDArray[np.float64]
Case = tuple[str, Callable[[], Json], Json]
"""Name of an answer, what makes it, and the answer where that ends in an error, which counts as wrong."""
_AXES = {"p": "xyz", "v": "xyz", "q": "wxyz", "w": "xyz"}
STATES: dict[str, tuple[str, ...]] = {
    "mass_spring_damper": ("q", "q_dot"),
    "cartpole": ("x", "x_dot", "theta", "theta_dot"),
}
STATES["multirotor"] = tuple(f"{k}_{a}" for k, axes in _AXES.items() for a in axes)
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # of libraries and processes that come later
threadpool_limits(1)

_COMMON: dict[str, Json] = {
    "seed": {"type": int, "help": "seed of the cases"},
    "seeds": {"type": int, "help": "how many seeds"},
    "first": {"type": int, "help": "number of the first case"},
    "count": {"type": int, "help": "how many cases"},
    "out": {"type": Path, "help": "folder to write into"},
    "cases": {"type": Path, "help": "folder of the cases"},
    "names": {"nargs": "+", "help": "these cases alone"},
    "jobs": {"type": int, "help": "processes at a time"},
    "at_once": {"type": int, "help": "jobs at a time, one thread each"},
    "first_seed": {"type": int, "help": "the first seed"},
    "threads": {"type": int, "help": "torch threads"},
    "repeats": {"type": int, "help": "timed repetitions"},
    "judge": {"action": "store_true", "help": "answer nothing; the table of what is there"},
}


def options(doc: str | None, *needed: str, **defaults: Any) -> argparse.ArgumentParser:
    """A command line with some of the common options: those that have to be given, and those with a default."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    for name in needed:
        parser.add_argument(f"--{name}", required=True, **_COMMON[name])
    for name, default in defaults.items():
        parser.add_argument(f"--{name.replace('_', '-')}", default=default, **_COMMON[name])
    return parser


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def write_json(path: Path, content: Any) -> None:
    """Write a file, and the folder that it is in."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1, default=float), encoding="utf-8")


def save(path: Path, names: Iterable[str], columns: Sequence[Any], fmt: str | list[str] = "%.9g") -> None:
    """Write columns, (n,) or (n, C), under their names as a CSV file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.column_stack(columns), fmt, ",", header=",".join(names), comments="")


def truth_of(folder: Path, name: str) -> Json:
    out: Json = read_json(folder / "truth" / f"{name}.json")
    return out


def missing(folder: Path, part: str, names: Iterable[str] | None = None) -> list[str]:
    """Names of cases of which there is no `truth` or `answers` yet; None: of all that have a truth."""
    every = sorted(p.stem for p in (folder / "truth").glob("*.json")) if names is None else names
    return [name for name in every if not (folder / part / f"{name}.json").is_file()]


def answered(folder: Path) -> Iterator[tuple[str, Json, Json]]:
    """Name, truth and answer of each case that has an answer."""
    for path in sorted((folder / "answers").glob("*.json")):
        yield path.stem, truth_of(folder, path.stem), read_json(path)


def markdown(head: Sequence[Any], rows: Iterable[Sequence[Any]]) -> list[str]:
    return [line(head), "|---" * len(head) + "|", *map(line, rows)]


def head(*names: Any) -> None:
    print("\n".join(markdown(names, [])), flush=True)


def line(cells: Iterable[Any]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def diagnosed(data: Any, system: Any, **how: Any) -> tuple[Any, Json]:
    """A diagnosis, and what studies keep of it."""

    import nsde_torch

    started = time.perf_counter()
    found = nsde_torch.diagnose(data, system=system, **{"say": False, **how})
    content = found.content()
    return found, {
        "verdict": content["verdict"],
        "added": content["added"],
        "leads": [f["name"] for f in content["findings"] if f["lead"]],
        "sure": sure(content),
        "ties": content["ties"] or [],
        "parameters": content["parameters"],
        "declared": content["declared_parameters"],
        "seconds": round(time.perf_counter() - started, 1),
    }


def written(write: Callable[[Path], Any], system: Any, **how: Any) -> tuple[Any, Any, Json]:
    """What a simulator returns that writes logs into a folder, and a diagnosis of these."""
    with tempfile.TemporaryDirectory() as folder:
        made = write(Path(folder))
        return made, *diagnosed(folder, system, **how)


def sure(content: Mapping[str, Any]) -> list[str]:
    """Effects that a diagnosis is sure of: no leads, no members of a tie, and nothing where most is unexplained."""
    if content["verdict"] != "effect_found":
        return []
    leads = {f["name"] for f in content["findings"] if f["lead"]}
    return [name for name in content["added"] if name not in leads | tied(content)]


def tied(content: Mapping[str, Any]) -> set[str]:
    """Members of ties, each part of a sum by itself."""
    names = {name for tie in content["ties"] or () for name in tie["effects"]}
    return names | {part for name in names for part in name.split(" + ")}


def labelled(effects: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[str, float]]:
    """Labels of `diagnosis.json` and values of the parameters of effects; those of a list are numbered."""
    for effect, values in effects.items():
        for name, value in values.items():
            many = isinstance(value, list) and len(value) > 1
            for i, v in enumerate(value if isinstance(value, list) else [value]):
                yield f"{effect}.{name}" + (f"[{i}]" if many else ""), v


def holds(said: Mapping[str, Any], value: float) -> bool:
    """Whether the 90 % interval of a parameter holds a value; an end that is a bound of the fit is open."""
    (low, high), bound = said["interval_90"], said.get("bound")
    return bool((bound == "below" or low <= value) and (bound == "above" or value <= high))


def held(effects: Mapping[str, Mapping[str, Any]], parameters: Mapping[str, Any]) -> list[int]:
    """How many intervals hold the true values of effects, and how many there are; values of nothing do not count."""
    said = [(parameters.get(label) or {}, value) for label, value in labelled(effects) if abs(value) > 1e-5]
    inside = [holds(one, value) for one, value in said if one.get("interval_90")]
    return [sum(inside), len(inside)]


def inside(answers: Iterable[Json]) -> str:
    """Intervals that hold in all answers, of how many."""
    some = [a["inside"] for a in answers]
    return " of ".join(str(sum(pair[k] for pair in some)) for k in (0, 1))


def numbered(
    a: argparse.Namespace, make: Callable[..., Json], begin: str = "seed", **wrong: Any
) -> list[Case]:
    return [
        (f"{begin}_{a.seed}_{i:03d}", partial(make, a.seed, i), {"case": i, **wrong})
        for i in range(a.first, a.first + a.count)
    ]


def in_turn(
    a: argparse.Namespace, kinds: Sequence[str], make: Callable[..., Json], **wrong: Any
) -> list[Case]:
    """Cases of kinds in turn, each round of another seed."""
    out = []
    for i in range(a.first, a.first + a.count):
        kind, seed = kinds[i % len(kinds)], a.seed + i // len(kinds)
        name = f"{kind.replace(': ', '_').replace(' ', '_')}_{seed}"
        out.append((name, partial(make, kind, seed), {"kind": kind, "seed": seed, **wrong}))
    return out


def answers(out: Path, cases: Iterable[Case], finish: Callable[[Json], str]) -> list[Json]:
    """Answer cases, print a line for each, and return all answers of the folder.

    `finish` adds to an answer what it is worth, and returns the line.
    """
    for name, make, wrong in cases:
        try:
            answer = make()
        except Exception as error:
            answer = {**wrong, "error": repr(error)}
        text = finish(answer)
        write_json(out / f"{name}.json", answer)
        print(text, flush=True)
    return [read_json(path) for path in sorted(out.glob("*.json"))]


def pooled(jobs: int, work: Mapping[str, Callable[[], str]]) -> None:
    """Do work in processes; print what became of each piece."""
    started = time.perf_counter()
    with ProcessPoolExecutor(jobs) as pool:
        waiting = {pool.submit(make): name for name, make in work.items()}
        for k, job in enumerate(as_completed(waiting), start=1):
            spent = time.perf_counter() - started
            print(waiting[job], job.result(), f"({k} of {len(work)}, {spent:.0f} s)", flush=True)
