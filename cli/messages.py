"""What went wrong with the configuration, in one message that names the key and the nearest that exists."""

import difflib
import errno
import re
from collections.abc import Collection, Sequence
from pathlib import Path

import yaml

from nsde_torch.lookup import did_you_mean

from . import groups
from .keys import walk
from .quoted import as_typed, typed_path
from .registry import hydra_command
from .schemas import CHOICES

# Arguments of the library whose key on the command line has another name.
_KEYS = {
    "path": "data.path",
    "mapping": "data.mapping",
    "dt_model": "system.dt",
    "horizon": "system.horizon",
    "dt": "data.dt",
    "gap": "data.gap",
    "test": "data.test",
}
# What the system says of a path that cannot be written to, or is none.
_NO_PLACE = {
    *(errno.ENOENT, errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.EACCES, errno.EPERM),
    *(errno.ELOOP, errno.ENAMETOOLONG, errno.EROFS),
}
_FULL = {errno.ENOSPC, errno.EDQUOT}
_TYPES = {"Float": "a number, without its unit", "Integer": "a whole number", "bool": "true or false"}
_POINTER = "`nsde {command} --help` lists groups and keys."
_NO_GROUP = re.compile(r"Could not override '(?P<group>[^'@]+)'. No match in the defaults list")
_IN_FILE = re.compile(
    r"In '(?P<file>[^']+)': (?P<kind>\w+) raised while composing config:\n"
    r"(?P<reason>.*)\n\s*full_key: (?P<key>\S+)"
)


def explain(error: Exception, command: str, words: Sequence[str]) -> str | None:
    """The message for a fault that Hydra or OmegaConf found in the configuration; None if it is not about that."""
    from hydra.errors import HydraException, MissingConfigException, OverrideParseException
    from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

    in_file = _IN_FILE.match(str(error))
    if in_file:
        return _in_file(in_file, command, words)
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    if isinstance(error, MissingConfigException):
        return _unknown_choice(error, command, words)
    if isinstance(cause, (ConfigAttributeError, ConfigKeyError)) and cause.full_key:
        return unknown_key(str(cause.full_key), command, words)
    if isinstance(cause, OmegaConfBaseException) and cause.full_key:
        return f"`{cause.full_key}` {_wrong_type(cause)}.{_meaning(str(cause.full_key), command, words)}"
    if isinstance(error, OverrideParseException):
        if "=" not in error.override:
            return _no_value(error.override, command, words)
        if error.override.startswith("data="):
            return _path_as_choice(error.override.removeprefix("data="))
        return (
            f"`{error.override}` is not in Hydra's grammar. Put text with spaces, brackets, quotes or letters beyond "
            "ASCII into quotes, of the shell too: \"KEY='VALUE'\"."
        )
    if isinstance(error, RecursionError) and groups.config_dir(words) is not None:
        return "A file of --config-dir includes itself (`defaults`), or nests too deeply."
    if isinstance(error, yaml.YAMLError):
        return f"A file of --config-dir is no plain YAML: {' '.join(str(error).split())}."
    absent = _NO_GROUP.search(str(error))
    if absent:
        return _no_group(absent["group"], command)
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        text = re.sub(r"\n?See https?://\S+.*", "", str(error)).strip()
        return f"{text}\n{_POINTER.format(command=command)}"
    if isinstance(error, OSError) and error.errno in _FULL:  # of a write, no file is named
        return "The disk is full, and what was being written is incomplete. Free some space, or write to another disk."
    if isinstance(error, OSError) and error.errno in _NO_PLACE and error.filename is not None:
        return f"{error.filename}: {error.strerror}. Name another folder or file."
    return None


def _wrong_type(error: Exception) -> str:
    """What OmegaConf says of a value of another type, without the names of its converters."""
    reason = _first_line(error).rstrip(".")
    found = re.search(r"Value '(.*)' (?:of type '.*' could not be converted to|is not a valid) (\w+)", reason)
    if found and found[2] in _TYPES:
        return f"must be {_TYPES[found[2]]}; got {found[1]!r}"
    if "not a ListConfig" in reason:
        return "must be a list, in brackets"
    if "merge DictConfig with ListConfig" in reason:  # which of the two was wanted, it does not say
        return "is of the wrong kind: a list stands in brackets, names with values in braces, {name: value}"
    if "is not Optional" in reason:
        return "must be given; it cannot be null"
    return f"cannot be set: {reason}"


def in_keys(text: str, own: Collection[str] = ()) -> str:
    """A message of the library with its arguments under the names of their keys, but for the command's `own`."""
    keys = {name: key for name, key in _KEYS.items() if name not in own}
    return re.sub(r"`(\w+)`", lambda found: f"`{keys.get(found[1], found[1])}`", text)


def _no_group(group: str, command: str) -> str:
    """The message for a group that the command does not have, `system=` of one that reads a model above all."""
    own = groups.defaults(command)
    said = f"`{group}` is not a group of `nsde {command}`."
    if group == "system" and "run" in hydra_command(command).keys:
        said += " The system is that of the model, run=DIR"
        flown = "; it has to be a multirotor (hexacopter, quadrotor), which alone the controller flies."
        said += flown if "mpc" in own else "."
    takes = ", ".join(f"{name}=" for name in own) or "none"
    return f"{said} Its groups: {takes}. {_POINTER.format(command=command)}"


def unknown_key(path: str, command: str, words: Sequence[str]) -> str:
    """The message for a key that the schema does not have."""
    known, elsewhere = _known_keys(command, words)
    if path in elsewhere:
        group = path.split(".")[0]
        now = groups.selected(command, words).get(group)
        homes = " or ".join(f"{group}={choice}" for choice in elsewhere[path])
        chosen = f"{group}={now}" if now != groups.NOTHING else f"no {group}="
        return f"`{path}` is a key of {homes}, but {chosen} is chosen."
    near = nearest(path, known)
    hint = f" Did you mean `{near}`?" if near else ""
    return f"`{path}` is not a key of `nsde {command}`.{hint} {_POINTER.format(command=command)}"


def nearest(name: str, known: Sequence[str]) -> str | None:
    """The known name that a mistyped one most likely means."""
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if close:
        return close[0]
    # A key without its group, or in the wrong one: `lr` or `model.lr` for `trainer.lr`.
    leaf = name.split(".")[-1]
    leaves = [key for key in known if key.split(".")[-1] == leaf]
    if leaves:
        return leaves[0]
    close = difflib.get_close_matches(leaf, [key.split(".")[-1] for key in known], n=1, cutoff=0.7)
    return next((key for key in known if close and key.split(".")[-1] == close[0]), None)


def _in_file(found: re.Match[str], command: str, words: Sequence[str]) -> str:
    """The message for a fault in a YAML file, most likely one of the user's own."""
    file, path = found["file"], found["key"]
    if "Key" not in found["kind"] and "Attribute" not in found["kind"]:
        return f"In {file}.yaml: `{path}` {_wrong_type(ValueError(found['reason']))}."
    message = f"In {file}.yaml: {unknown_key(path, command, words)}"
    group = file.split("/")[0]
    if group in CHOICES:
        message += f" A file of yours in {group}/ starts with `defaults: [CHOICE, _self_]` to have its keys."
    return message


def _unknown_choice(error: Exception, command: str, words: Sequence[str]) -> str:
    missing = str(getattr(error, "missing_cfg_file", "") or "")
    if missing.startswith("hydra/"):  # its groups have a slash, as hydra/launcher
        group, _, choice = missing.rpartition("/")
    else:  # a choice may be a path
        group, slash, choice = missing.partition("/")
        group = group if slash else ""
    if group == "data" and ("/" in choice or Path(choice).exists()):
        return _path_as_choice(choice)
    options = [str(option) for option in getattr(error, "options", None) or []]
    if not group:
        return _first_line(error)
    hint = did_you_mean(choice, options, f"`{group}={{}}`", cutoff=0.5)
    more = f" (your own: {group}/{choice}.yaml in a folder given with --config-dir)."
    if group.startswith("hydra/"):
        more = ". Launchers and sweepers come with the extras `nsde_torch[sweeps]` and `nsde_torch[ray]`."
    return f"`{group}={choice}`: no such choice.{hint} Choices: {', '.join(options)}{more}"


def _path_as_choice(path: str) -> str:
    """The message for `data=PATH`."""
    instead = as_typed(paths={"data.path": typed_path(path)})
    return (
        f"`data={path}`: `data` is a kind of data, and a path goes into `data.path`: {instead} (the names of the files "
        "decide the format)."
    )


def _no_value(word: str, command: str, words: Sequence[str]) -> str:
    """The message for a word without `=`, most likely a path."""
    if word in _known_keys(command, words)[0]:
        return f"`{word}` has no value: write {word}=VALUE, without spaces around the `=`."
    files = groups.files(command)
    key = next((name for name in ("run", "data.path") if name in files), None)
    hint = "" if key is None else f" A path goes into `{key}`: {as_typed(paths={key: typed_path(word)})}."
    return f"`{word}` is not KEY=VALUE.{hint} {_POINTER.format(command=command)}"


def _meaning(path: str, command: str, words: Sequence[str]) -> str:
    entry = next((entry for entry in groups.typed_keys(command, words) if entry.path == path), None)
    if entry is None:
        return ""
    unit = f" [{entry.unit}]" if entry.unit else ""
    brackets = f" A list needs brackets: '{path}=[...]'." if "list" in entry.annotation else ""
    return f" Meaning: {entry.help}{unit}.{brackets}"


def _known_keys(command: str, words: Sequence[str]) -> tuple[list[str], dict[str, list[str]]]:
    """Keys and groups that exist now, and keys of other choices with the choices that have them."""
    chosen = groups.selected(command, words)
    known = [entry.path for entry in groups.typed_keys(command, words)]
    known += [name for name in hydra_command(command).keys if name not in known]
    elsewhere: dict[str, list[str]] = {}
    for group, options in CHOICES.items():
        for choice, schema in options.items():
            for entry in walk(schema, f"{group}."):
                if group in chosen and entry.path not in known:
                    elsewhere.setdefault(entry.path, []).append(choice)
    return known, elsewhere


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
