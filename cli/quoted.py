"""Words as a user types them that Hydra's grammar wants otherwise.

Paths: a key of a file or folder holds a name, not grammar. It is quoted for Hydra, so that umlauts, spaces, brackets,
`=`, `,` and quotes are letters like others. With -m a comma separates two of them; in a key that takes several `[A,B]`
is a list. Text that is in quotes altogether was quoted by the user; `${...}` stays an interpolation.

Effects of one coordinate: the brackets of `coulomb_friction[q2]` are escaped in values, and are a level of their own in
keys.
"""

import os
import re
import shlex
from collections.abc import Mapping, Sequence

from .keys import Key

_QUOTED = re.compile(r"('(?:[^'\\]|\\.)*'|\"(?:[^\"\\]|\\.)*\")")
_ITEM = re.compile(rf"\s*({_QUOTED.pattern[1:-1]}|\[[^\[\]]*\]|[^,]*?)\s*(?:,|$)")
_LAW = re.compile(r"([A-Za-z_]\w*)\[(\w+)\]")
# Hydra reads these as the text that they are, unless they are words of its own.
_PLAIN = re.compile(r"(?:[A-Za-z_/]|\.{1,2}/)[\w./+-]*|\.{0,2}", re.ASCII)
_WORDS = re.compile(r"true|false|null|nan|inf(inity)?", re.IGNORECASE)
_SWEPT = re.compile(r"(choice|glob|interval|range|shuffle|sort|tag)\(.*\)")
_EFFECTS = (".yaml", ".yml")
_ONE_FOLDER = ("run_dir", "sweep_dir", "resume")


def typed_path(value: str) -> str:
    """The path that a value says: without the user's quotes, `~/` being the home folder as in a shell."""
    if _QUOTED.fullmatch(value):
        return re.sub(rf"(\\+)({value[0]}|$)", lambda m: m[1][: len(m[1]) // 2] + m[2], value[1:-1])
    return os.path.expanduser(value) if value == "~" or value.startswith("~/") else value


def quoted(value: str) -> str:
    """A path as Hydra's grammar has it: in quotes, unless it is plain."""
    if _PLAIN.fullmatch(value) and not _WORDS.fullmatch(value):
        return value
    escaped = re.sub(r"(\\*)('|$)", lambda m: 2 * m[1] + ("\\'" if m[2] else ""), value)
    return f"'{escaped}'"


def path_word(word: str, files: Mapping[str, Key], *, sweep: bool = False) -> str:
    """`KEY=PATH` for Hydra, where KEY names files or folders; any other word as it is."""
    name, equals, value = word.partition("=")
    entry = files.get(name.lstrip("+"))
    if entry is None or not equals or word.startswith("-") or (sweep and _SWEPT.fullmatch(value)):
        return word
    effects = name.endswith("effects")
    if effects and not any(end in value for end in _EFFECTS):
        return word  # names and laws, which are Hydra's grammar
    several = effects or "list" in entry.annotation or "Any" in entry.annotation

    def one(item: str) -> str:
        if (effects and not item.endswith(_EFFECTS)) or item in ("", "null", "???"):
            return item
        return quoted(typed_path(item))

    def made(item: str) -> str:
        if several and item.startswith("[") and item.endswith("]"):
            return f"[{','.join(map(one, _items(item[1:-1])))}]"
        alone = name.endswith("system.effects") and item.endswith(_EFFECTS)
        return f"[{one(item)}]" if alone else one(item)  # that key holds a list, of one file as well

    swept = sweep and name not in _ONE_FOLDER
    return f"{name}={','.join(map(made, _items(value) if swept else [value]))}"


def _items(text: str) -> list[str]:
    """What commas separate, but for those in quotes and brackets."""
    found, place = [], 0
    while place <= len(text):
        match = _ITEM.match(text, place)
        assert match is not None  # its last choice is any text
        found.append(match[1])
        place = match.end() + (match.end() == len(text) and not match[0].endswith(","))
    return found


def as_typed(*words: str, paths: Mapping[str, object]) -> str:
    """Words, and `KEY=PATH` for each of the paths, as a shell takes them: a line that is printed can be copied."""
    literal = {
        key: f"./{path}" if typed_path(str(path)) != str(path) else path for key, path in paths.items()
    }
    return shlex.join([*words, *(f"{key}={path}" for key, path in literal.items())])


def coordinates_named(word: str) -> str:
    """`KEY=[law[q2]]` with the brackets of the coordinate escaped, `LAW[q2].NAME=1` with it as a level of its own."""
    if word.startswith("-"):
        return word
    key, equals, value = word.partition("=")
    outside = _QUOTED.split(value)  # what stands in quotes is left alone
    outside[::2] = [_LAW.sub(r"\1\\[\2\\]", part) for part in outside[::2]]
    return _LAW.sub(r"\1.\2", key) + equals + "".join(outside)


def from_file(words: Sequence[str]) -> list[str]:
    """`controller=FILE` as `run=FILE`: what is flown may be a run directory or a file of `nsde export`."""
    return [f"run={w.partition('=')[2]}" if w.startswith("controller=") else w for w in words]
