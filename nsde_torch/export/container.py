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
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nsde_torch.errors import ExportError

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
