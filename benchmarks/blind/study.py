"""What studies share: one thread a process, command lines, files of cases and answers, intervals that hold.

A folder of cases has the logs of a case in `data/NAME`, what is true of it in `truth/NAME.json`, and what was answered
in `answers/NAME.json`.
"""

import argparse
import json
import os
import tempfile
import time
import traceback
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
"""Name of an answer, what makes it, and what is known of it beforehand."""
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


def shares(asked: Iterable[tuple[str, Sequence[Json], Callable[[Json], Any]]], by: str) -> list[str]:
    """How many cases of each question are right (or intervals hold), of all and by a key of theirs."""
    asked = [question for question in asked if question[1]]
    groups = ["all", *sorted({j[by] for _, cases, _ in asked for j in cases})]
    rows = []
    for what, cases, right in asked:
        cells = [what]
        for group in groups:
            found = [right(j) for j in cases if group in ("all", j[by])]
            pairs = [one if isinstance(one, list) else [bool(one), 1] for one in found]
            cells.append(" of ".join(str(sum(pair[k] for pair in pairs)) for k in (0, 1)) if found else "")
        rows.append(cells)
    return markdown(("", *groups), rows)


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


def columns(system: str, motors: int = 0) -> tuple[str, ...]:
    """Names of the columns of a log; a machine without motors has a force."""
    return ("t", *STATES[system], *([f"u_{k + 1}" for k in range(motors)] or ["force"]))


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


def judged(answer: Json, truth: Mapping[str, Any], right: bool | None = None) -> Json:
    """An answer with what it is worth where these effects are true.

    It is right where the first that it names is true, or where it names nothing and nothing is.
    """
    added = answer["added"]
    return {
        **answer,
        "truth": truth,
        "right": (added[0] in truth if added else not truth) if right is None else right,
        "alone": set(added) == {*truth},
        "wrong": [name for name in answer["sure"] if name not in truth],
        "inside": held(truth, answer["parameters"]),
    }


ERROR: Json = {"verdict": "error", "right": False, "alone": False, "inside": [0, 0], "seconds": 0.0}
ERROR |= {"parameters": {}, "truth": {"?": {}}}
ERROR |= {key: [] for key in ("added", "leads", "sure", "ties", "wrong")}
"""An answer that ended in an error counts as wrong."""


def told(a: Json) -> str:
    """What an answer says, what it is worth, and values beside the true ones."""
    parts = {"": a["added"] or [a["verdict"]], "leads": a["leads"], "WRONG AND SURE": a["wrong"]}
    said = "; ".join(f"{what} {', '.join(some)}".strip() for what, some in parts.items() if some)
    for label, value in labelled(a["truth"]):
        found = a["parameters"].get(label)
        if found and found.get("interval_90"):
            inside = "" if holds(found, value) else " OUTSIDE"
            said += f"; {label} {found['value']:.4g} of {value:.4g}{inside}"
    true = ", ".join(a["truth"]) or "nothing"
    return f"{'right' if a['right'] else 'WRONG'}: {true} -> {a.get('error', said)} ({a['seconds']:.0f} s)"


def table(done: Sequence[Json], also: Sequence[str] = ()) -> None:
    """Print by kind how many answers are right, and how many intervals hold."""
    keys = ("right", "alone", "wrong", *also)
    head("kind", "cases", *keys, "intervals that hold", "s a case")
    for kind in ["all", *dict.fromkeys(d["kind"] for d in done)]:
        own = [d for d in done if kind in ("all", d["kind"])]
        hold = " of ".join(str(sum(d["inside"][k] for d in own)) for k in (0, 1))
        seconds = f"{np.median([d['seconds'] for d in own]):.0f}"
        print(line([kind, len(own), *(sum(bool(d.get(k)) for d in own) for k in keys), hold, seconds]))


def numbered(a: argparse.Namespace, make: Callable[..., Json], begin: str = "seed") -> list[Case]:
    return [
        (f"{begin}_{a.seed}_{i:03d}", partial(make, a.seed, i), {"kind": begin, "case": i})
        for i in range(a.first, a.first + a.count)
    ]


def in_turn(a: argparse.Namespace, kinds: Sequence[str], make: Callable[..., Json]) -> list[Case]:
    """Cases of kinds in turn, each round of another seed."""
    out = []
    for i in range(a.first, a.first + a.count):
        kind, seed = kinds[i % len(kinds)], a.seed + i // len(kinds)
        name = f"{kind.replace(': ', '_').replace(' ', '_')}_{seed}"
        out.append((name, partial(make, kind, seed), {"kind": kind, "seed": seed}))
    return out


def answers(
    out: Path | None, cases: Iterable[Case], say: Callable[[Json], str] = told, error: Json = ERROR
) -> list[Json]:
    """Answer cases, print a line for each, and return all answers of the folder, or these where there is none."""
    done = []
    for name, make, about in cases:
        try:
            answer = {**about, **make()}
        except Exception as raised:
            answer = {**error, **about, "error": repr(raised)}
        done.append(answer)
        if out is not None:
            write_json(out / f"{name}.json", answer)
        print(name, say(answer), flush=True)
    return done if out is None else [read_json(path) for path in sorted(out.glob("*.json"))]


def kept(folder: Path, name: str, make: Callable[[Path, str], Json]) -> str:
    """Answer a case of a folder and keep the answer; returns the verdict."""
    try:
        answer = make(folder, name)
    except Exception as error:  # a crash is an answer too, and the worst
        answer = {**ERROR, "verdict": "crash", "error": repr(error), "traceback": traceback.format_exc()}
    write_json(folder / "answers" / f"{name}.json", answer)
    return str(answer["verdict"])


def report(folder: Path, judged: Mapping[str, Json], table: str) -> None:
    """Keep what answers are worth beside them, and print the table."""
    write_json(folder / "judged.json", judged)
    (folder / "table.md").write_text(table, encoding="utf-8")
    print(table)


def pooled(jobs: int, work: Mapping[str, Callable[[], str]]) -> None:
    """Do work in processes; print what became of each piece."""
    started = time.perf_counter()
    with ProcessPoolExecutor(jobs) as pool:
        waiting = {pool.submit(make): name for name, make in work.items()}
        for k, job in enumerate(as_completed(waiting), start=1):
            spent = time.perf_counter() - started
            print(waiting[job], job.result(), f"({k} of {len(work)}, {spent:.0f} s)", flush=True)
