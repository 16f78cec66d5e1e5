"""Exported files: zip archives with one JSON record that describes them, and a hash over everything in them.

    sha256 = H(for every member by name: len(name), name, len(bytes), bytes),   lengths as 8 bytes, little-endian

where the record enters with two of its values empty: the hash, and the time of writing, without which the
same controller has the same hash.

Archives are written with fixed times, order and names, so that the same controller makes the same bytes. The hash
reveals a damaged file; it says nothing about who wrote it, and a TorchScript file or a compiled package is code.
"""

import hashlib
import io
import json
import os
import platform
import re
import time
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, fields
from importlib.metadata import version
from math import inf
from pathlib import Path
from typing import Any

import torch

from nsde_torch.control.controller import REST, SafetyOptions, word_at_rest
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.solve import SolverOptions
from nsde_torch.errors import ExportError
from nsde_torch.export import step as of_step
from nsde_torch.export.step import ExportedStep
from nsde_torch.models import Model
from nsde_torch.models.run_directory import CONFIG, WEIGHTS, make_spec
from nsde_torch.systems import System, make_plant_system

ROOT, RECORD = "controller", "extra/nsde.json"
FORMAT = "nsde_torch controller/2"
_BLANK = re.compile(rb'^( "(?:sha256|written)": )"[^"\n]*"', re.MULTILINE)
_LARGEST = 512 << 20
_MANGLED = re.compile(rb"\.___torch_mangle_\d+")


def digest_of(members: Mapping[str, bytes]) -> str:
    """Hash (hex) over members by name."""
    digest = hashlib.sha256()
    for name in sorted(members):
        content = _BLANK.sub(rb'\1""', members[name]) if name == RECORD else members[name]
        for part in (name.encode(), content):
            digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


def members_of(archive: bytes) -> dict[str, bytes]:
    """Members of an archive by their name below its one folder; ExportError where it is none, damaged, or too large."""
    out: dict[str, bytes] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(archive)) as opened:
            if sum(item.file_size for item in opened.infolist()) > _LARGEST:
                raise ExportError("the file is far larger than any controller. Export anew.")
            for item in opened.infolist():
                name = item.filename.partition("/")[2]
                if name in out:
                    raise ExportError(f"the file holds {name} twice. Export anew.")
                out[name] = opened.read(item)
    except (zipfile.BadZipFile, EOFError, OSError, ValueError, NotImplementedError, RuntimeError) as error:
        if isinstance(error, ExportError):
            raise
        raise ExportError(f"the file is truncated or damaged ({error}). Export anew.") from error
    return out


def archive_of(members: Mapping[str, bytes]) -> bytes:
    """An archive of members, the same bytes for the same members."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as made:
        for name in sorted(members, key=lambda n: (n == RECORD, n)):
            item = zipfile.ZipInfo(f"{ROOT}/{name}", date_time=(1980, 1, 1, 0, 0, 0))
            item.external_attr = 0o644 << 16
            item.create_system = 3
            made.writestr(item, members[name])
    return buffer.getvalue()


def plain(members: Mapping[str, bytes]) -> dict[str, bytes]:
    """Members of a TorchScript archive without what differs from process to process.

    Those are numbers in the names of classes, and tables of source files and lines.
    """
    out = {}
    for name, content in members.items():
        if name.endswith(".debug_pkl") or name == ".data/serialization_id":
            continue
        name = re.sub(r"/___torch_mangle_\d+\.py$", ".py", name)
        out[name] = _MANGLED.sub(b"", content) if name.endswith((".py", "data.pkl")) else content
    return out


def signed(members: Mapping[str, bytes], record: Mapping[str, Any]) -> tuple[bytes, str]:
    """The text of a record of plain values with the hash of it and everything else, and the hash (hex)."""

    def text(digest: str) -> bytes:
        made = json.dumps({"format": FORMAT, "sha256": digest, **record}, indent=1, allow_nan=False)
        return made.replace("*/", "*\\/").encode()  # in C it stands in a comment

    digest = digest_of({**members, RECORD: text("")})
    return text(digest), digest


def write(path: Path, members: Mapping[str, bytes], record: Mapping[str, Any]) -> str:
    """Write a file of a record and everything else in it; returns its hash (hex)."""
    text, digest = signed(members, record)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".partial")
    temporary.write_bytes(archive_of({**members, RECORD: text}))
    temporary.replace(path)
    return digest


def read(path: Path) -> tuple[bytes, dict[str, Any]]:
    """The bytes of a file and its record; ExportError where there is none, or it is damaged, changed, or foreign."""
    if not path.is_file():
        raise ExportError(f"no file {path}; give what `nsde export` wrote.")
    archive = path.read_bytes()
    try:
        members = members_of(archive)
    except ExportError as error:
        raise ExportError(f"{path}: {error}") from error
    return archive, checked(path, members)


def checked(path: Path, members: Mapping[str, bytes]) -> dict[str, Any]:
    """The record of a file with these members; ExportError where it was changed, or is of another format."""
    if RECORD not in members:
        raise ExportError(
            f"{path} is no exported controller (it holds no {RECORD}). Make one with `nsde export`."
        )
    try:
        record: dict[str, Any] = json.loads(members[RECORD])
        written, digest = str(record["format"]), str(record["sha256"])
    except (ValueError, LookupError, TypeError) as error:
        raise ExportError(f"{path}: its record {RECORD} is damaged ({error}). Export anew.") from error
    if written != FORMAT:
        raise ExportError(
            f"{path} is of the format {written!r}, and this version reads {FORMAT!r}. Export anew."
        )
    found = digest_of(members)
    if found != digest:
        raise ExportError(
            f"{path} was changed after it was written: its content hashes to {found[:16]}..., and its record says "
            f"{digest[:16]}.... Export anew."
        )
    return record


# The record of an exported file: what it was made of, and what its tensors are.

FRAMES = "world ENU, body FLU, quaternion w x y z from body to world, SI units, radians"
TORCHSCRIPT, AOTI, C = "torchscript", "aoti", "c"


def record_of(
    step: ExportedStep, known: Model | System, *, kind: str, run: Path | None, period: float, latency: float
) -> dict[str, Any]:
    """What a controller is made of and what it was tuned for.

    That is the time between steps, `period` [s], and that from a measurement to the effect of the command that follows
    from it, `latency` [s]. The run directory of a model gives its hashes; None for declared physics.
    """
    system = known if isinstance(known, System) else known.system
    s, units = step.sizes, ", ".join(dict.fromkeys(system.state_units))
    stamp = os.environ.get("SOURCE_DATE_EPOCH")
    return {
        "kind": kind,
        "written": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(float(stamp) if stamp else None)),
        "versions": {"nsde_torch": version("nsde_torch"), "torch": torch.__version__},
        "processor": _processor() if kind == AOTI else None,
        "dtype": str(step.dtype).removeprefix("torch."),
        "frames": FRAMES if system.quaternion is not None else "SI units, radians",
        "period_s": period,
        "sample_s": step.sample.dt,
        "step_s": step.options.dt,
        "latency_s": latency,
        "sizes": asdict(s),
        **of_step.tensors(s, units),
        "status": list(of_step.status_words(word_at_rest(system))),
        "loops": step.loops._asdict(),
        "hover": step.hover_u[0, 0].double().tolist(),
        "ports": {port.value: width for port, width in step.predictor.ports.items()},
        "state_names": list(system.state_names),
        "input_names": list(system.input_names),
        "problem": {k: None if v == inf else v for k, v in asdict(step.options).items()},
        "solver": {"name": "gauss_newton"} | {k: getattr(step.loops, k) for k in ("iterations", "tolerance")},
        "safety": asdict(step.safety),
        "model": {
            "spec": None if isinstance(known, System) else known.spec.as_dict(),
            "system": system.name,
            "parameters": {k: v.tolist() for k, (v, _) in system.all_declared().items()},
            **hashes(known, run),
        },
    }


def hashes(known: Model | System, run: Path | None) -> dict[str, str]:
    """What a model is recognised by: hashes of its files, or of the values of declared physics."""
    if run is not None:
        files = {"weights": WEIGHTS, "config": CONFIG}
        return {f"{k}_sha256": hashlib.sha256((run / f).read_bytes()).hexdigest() for k, f in files.items()}
    system = known if isinstance(known, System) else known.system
    values = {k: v.tolist() for k, (v, _) in sorted(system.all_declared().items())}
    text = json.dumps([system.name, system.effect_names, values])
    return {"weights_sha256": hashlib.sha256(text.encode()).hexdigest()}


def check(record: Mapping[str, Any]) -> None:
    """Refuse a record of other versions or another processor; an ExportError names what differs."""
    try:
        written = record["versions"]
        for name, own in (("nsde_torch", version("nsde_torch")), ("torch", torch.__version__)):
            if _series(written[name]) != _series(own):
                raise ExportError(
                    f"it was written with {name} {written[name]}, and this is {own}. Export anew, or install that "
                    "version."
                )
        if record["kind"] == AOTI and record["processor"] != _processor():
            raise ExportError(
                f"it was compiled for {record['processor']}, and this is {_processor()}. Export it here with "
                "format=aoti."
            )
        if tuple(record["status"]) not in (of_step.STATUS, of_step.status_words(REST)):
            raise ExportError("it knows other words of a status than this version. Export anew.")
    except (LookupError, TypeError, AttributeError) as error:
        raise ExportError(f"its record lacks {error}. Export anew.") from error


def options_of(record: Mapping[str, Any]) -> tuple[ProblemOptions, SolverOptions, SafetyOptions]:
    """What the controller in a file was made with."""
    problem: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in record["problem"].items()
    }
    if problem["fence"] is not None:
        problem["fence"] = tuple(tuple(w) for w in problem["fence"])
    for field in fields(ProblemOptions):
        if problem[field.name] is None and field.default == inf:
            problem[field.name] = inf
    solver, safety = SolverOptions(**record["solver"], compile="off"), SafetyOptions(**record["safety"])
    return ProblemOptions(**problem), solver, safety


def system_of(record: Mapping[str, Any]) -> System:
    """The machine's declared physics with the values of the model in a file; its learned part is in the file alone."""
    model = record["model"]
    if model["spec"] is None:
        return make_plant_system(model["system"], declared_only=True)
    return make_spec(model["spec"]).make_system(model["parameters"])


def _series(text: str) -> tuple[str, ...]:
    return tuple(text.split("+")[0].split(".")[:2])


def _processor() -> str:
    return f"{platform.system()} {platform.machine()} {torch.backends.cpu.get_cpu_capability()}"
