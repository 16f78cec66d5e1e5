"""Files that hold what was said before, and the comparison of what is said now with them.

`make golden` (`pytest tests/golden --regenerate`) writes them anew. Do that only for a change that is meant, and
read the difference before it is committed.
"""

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
_DIGITS = 6


def differences(got: Any, want: Any, *, rel: float, abs: float, path: str = "") -> Iterator[str]:
    """What differs between two JSON values, a line each.

    Args:
        got: Value now.
        want: Value that was kept.
        rel: Relative tolerance of numbers, of those within sentences too.
        abs: Absolute tolerance.
        path: Where the values are.
    """
    if isinstance(got, dict) and isinstance(want, dict):
        if list(got) != list(want):
            yield f"{path}: keys {list(got)}, kept {list(want)}"
        for key in got.keys() & want.keys():
            yield from differences(got[key], want[key], rel=rel, abs=abs, path=f"{path}.{key}")
    elif isinstance(got, list) and isinstance(want, list) and len(got) == len(want):
        for k, pair in enumerate(zip(got, want, strict=True)):
            yield from differences(*pair, rel=rel, abs=abs, path=f"{path}[{k}]")
    elif isinstance(got, str) and isinstance(want, str):
        numbers = [[float(n) for n in _NUMBER.findall(text)] for text in (got, want)]
        if _NUMBER.sub("#", got) != _NUMBER.sub("#", want):
            yield f"{path}: {got!r}, kept {want!r}"
        else:
            # a number in a sentence has two or three digits
            yield from differences(*numbers, rel=max(rel, 0.02), abs=abs, path=path)
    elif _is_number(got) and _is_number(want):
        if not math.isclose(got, want, rel_tol=rel, abs_tol=abs):
            yield f"{path}: {got!r}, kept {want!r}"
    elif got != want:
        yield f"{path}: {got!r}, kept {want!r}"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def rounded(value: Any) -> Any:
    """A JSON value with six significant digits."""
    if isinstance(value, dict):
        return {str(k): rounded(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(v) for v in value]
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


def _lines(value: Any, indent: str = "", room: int = 110) -> str:
    """JSON, what fits a line on one."""
    flat = json.dumps(value)
    if len(flat) <= room or not isinstance(value, dict | list):
        return flat
    named = isinstance(value, dict)
    items = [(f"{json.dumps(k)}: ", v) for k, v in value.items()] if named else [("", v) for v in value]
    inner = [f"{indent} {name}{_lines(of, indent + ' ', room - len(name) - 1)}" for name, of in items]
    return "\n".join((flat[0], ",\n".join(inner), indent + flat[-1]))


def same_text(file: Path, text: str, *, regenerate: bool) -> None:
    if regenerate:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    assert text == file.read_text(encoding="utf-8"), f"{file.name} has changed; see tests/golden/kept.py"


def same_values(file: Path, value: Any, *, regenerate: bool, rel: float = 0.0, abs: float = 0.0) -> None:
    plain = rounded(json.loads(json.dumps(value)))
    if regenerate:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(_lines(plain) + "\n", encoding="utf-8")
    found = list(differences(plain, json.loads(file.read_text(encoding="utf-8")), rel=rel, abs=abs))
    assert not found, f"{file.name} has changed; see tests/golden/kept.py\n" + "\n".join(found[:20])
