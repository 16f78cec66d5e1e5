"""Classes and functions by name: a key of a catalogue, or `package.module:Name` of the user's own."""

import importlib
from collections.abc import Callable, Collection, Mapping
from difflib import get_close_matches
from traceback import extract_tb
from typing import Any, TypeVar, cast

from nsde_torch.errors import ConfigError, NsdeError

T = TypeVar("T")


def did_you_mean(name: str, known: Collection[str], shown: str = "{!r}", *, cutoff: float = 0.6) -> str:
    """The nearest of the known names as a question, with a space before it; empty where none is near.

    Args:
        name: What was typed.
        known: Names that there are.
        shown: Format of the name in the question.
        cutoff: Likeness from which one is near, see `difflib.get_close_matches`.
    """
    near = get_close_matches(name, known, 1, cutoff)
    return f" Did you mean {shown.format(near[0])}?" if near else ""


def raised(error: Exception, within: str) -> str:
    """What went wrong in a file of the user's own, and in which line.

    Args:
        error: What was raised.
        within: The function that the line is in, whatever it calls; `<module>` of a file that is loaded.
    """
    place = [frame for frame in extract_tb(error.__traceback__) if frame.name == within][-1:]
    at = f" ({place[0].filename}, line {place[0].lineno})" if place else ""
    return f"{type(error).__name__}: {error}{at}"


def class_by_name(
    name: str, known: Mapping[str, type[T]], base: type[Any], *, kind: str, home: str
) -> type[T]:
    """A class of a catalogue, or one of the user's own.

    Args:
        name: Key of `known`, or `package.module:Class`.
        known: The catalogue.
        base: What the class must derive from.
        kind: What it is, for messages.
        home: Where `base` is imported from, for messages.

    Raises:
        ConfigError: unknown name (lists the choices), no such module or class, or not derived from `base`.
    """
    if name in known:
        return known[name]
    module, colon, attribute = name.partition(":")
    if not colon:
        raise ConfigError(
            f"{kind} {name!r} is unknown; choose among {', '.join(known)}, or write `module:Class` of your own."
            + did_you_mean(name, known)
        )
    found = _found(module, attribute, kind=kind, name=name, what="class")
    if not (isinstance(found, type) and issubclass(found, base)):
        raise ConfigError(f"{kind} {name!r} must be a subclass of {home}.{base.__name__}; got {found!r}.")
    return cast("type[T]", found)


def function_by_name(name: str, *, kind: str = "function") -> Callable[..., Any]:
    """A function that a module defines.

    Args:
        name: `package.module:function`.
        kind: What it is, for messages.

    Raises:
        ConfigError: no such module or function.
    """
    module, _, attribute = name.partition(":")
    found = _found(module, attribute, kind=kind, name=name, what="function")
    if not callable(found):
        raise ConfigError(f"{kind} {name!r} must be a function; got {found!r}.")
    return cast("Callable[..., Any]", found)


def _found(module: str, attribute: str, *, kind: str, name: str, what: str) -> Any:
    if not module or module.startswith("."):
        raise ConfigError(f"{kind} {name!r}: expected `module:{what}`, with the full name of the module.")
    try:
        loaded = importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{kind} {name!r}: no module {error.name!r}. Put its file beside your configuration "
            "(--config-dir) or on PYTHONPATH."
        ) from error
    except NsdeError:
        raise
    except Exception as error:  # of the user's own file, whatever it is
        raise ConfigError(f"{kind} {name!r}: its file does not load: {raised(error, '<module>')}.") from error
    try:
        return getattr(loaded, attribute)
    except AttributeError as error:
        own = [known for known, value in vars(loaded).items() if getattr(value, "__module__", "") == module]
        raise ConfigError(
            f"{kind} {name!r}: module {module!r} has no {what} {attribute!r}."
            + (did_you_mean(attribute, own) or (f" It has {', '.join(own)}." if own else ""))
        ) from error
