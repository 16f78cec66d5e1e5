"""Schemas declare what every key means and allows."""

import dataclasses
import inspect
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import nsde_torch
from nsde_torch import conf, simulation
from nsde_torch.cli import groups
from nsde_torch.cli.keys import check, key, mirrors, of, walk
from nsde_torch.cli.registry import hydra_commands
from nsde_torch.cli.schemas import CHOICES
from nsde_torch.errors import ConfigError
from nsde_torch.sde.options import TorchDiffEqOptions
from nsde_torch.sde.torchdiffeq_step import TorchDiffEq

SCHEMAS = {name: command.schema for name, command in hydra_commands().items()}
ALL_SCHEMAS = [*SCHEMAS.values()] + [choice for choices in CHOICES.values() for choice in choices.values()]


@pytest.mark.parametrize("declared", ALL_SCHEMAS, ids=lambda cls: cls.__name__)
def test_every_key_has_help_in_plain_words(declared: type) -> None:
    for entry in walk(declared):
        assert entry.help, entry.path
        assert not entry.help.endswith("."), entry.path


@pytest.mark.parametrize("declared", ALL_SCHEMAS, ids=lambda cls: cls.__name__)
def test_every_default_is_allowed(declared: type) -> None:
    values = {entry.path: entry.default for entry in walk(declared) if "." not in entry.path}
    check(declared, {name: value for name, value in values.items() if value != "???"})


@pytest.mark.parametrize("command", SCHEMAS)
def test_no_plain_key_bears_the_name_of_a_group(command: str) -> None:
    # Hydra takes `name=value` for a choice of the group `name`, also in a command that does not use that group.
    names = {folder.name for folder in Path(conf.__path__[0]).iterdir() if folder.is_dir()}
    plain = {entry.path for entry in walk(SCHEMAS[command]) if "." not in entry.path}
    assert not plain & names


def test_a_key_without_help_is_refused() -> None:
    @dataclasses.dataclass
    class Bare:
        size: int = 1

    with pytest.raises(AssertionError, match=r"Bare\.size has no help"):
        list(walk(Bare))


@dataclasses.dataclass
class _Sample:
    size: int = key(3, "size", low=1, high=9)
    rate: float = key(0.1, "rate", unit="1/s", above=0)
    widths: list[int] = key([4], "widths", low=1)
    way: str = key("up", "way", choices=("up", "down"))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("size", 0, "`a.size` must be from 1 to 9; got 0."),
        ("size", 10, "from 1 to 9; got 10"),
        ("rate", 0.0, "`a.rate` must be above 0; got 0.0."),
        ("rate", math.nan, "above 0; got nan"),
        ("widths", [4, 0], "`a.widths` must be at least 1; got 0."),
        ("way", "left", "`a.way` must be up | down; got 'left'."),
    ],
)
def test_a_value_out_of_range_is_named_with_the_range(name: str, value: Any, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        check(_Sample, {name: value}, "a.")
    assert words in str(caught.value)


def test_null_and_allowed_values_pass() -> None:
    check(_Sample, {"size": 9, "rate": None, "widths": [], "way": "down"})


@dataclasses.dataclass(frozen=True)
class _Library:
    size: int = key(3, "size", low=1, high=9)
    widths: tuple[int, ...] | None = key((4, 5), "widths", low=1)
    biases: Mapping[str, float] = key({}, "biases")
    hidden: float = key(0.5, "not for the command line")


def test_keys_are_made_of_options_with_lists_for_tuples_and_dicts_for_mappings() -> None:
    @mirrors(_Library, without=("hidden",))
    class Mirror:
        size: int = of(_Library, "size", default=4, help="another size")
        more: float = key(1.0, "more")

    made: Any = Mirror()
    assert dataclasses.asdict(made) == {"size": 4, "widths": [4, 5], "biases": {}, "more": 1.0}
    entries = {entry.path: entry for entry in walk(Mirror)}
    assert list(entries) == ["size", "widths", "biases", "more"]
    assert (entries["size"].help, entries["size"].high) == ("another size", 9)
    assert entries["widths"].annotation == "list[int] | None"
    made.widths.append(6)
    assert Mirror().widths == [4, 5]  # type: ignore[attr-defined]


# Keys whose home is the signature of a function: command, key -> function, argument.
SIGNATURES = [
    (command, f"{group}{argument}", function, argument)
    for command, group, function, arguments in (
        ("train", "", nsde_torch.train, "seed device dtype"),
        ("train", "data.", nsde_torch.train, "validation"),
        ("train", "data.", nsde_torch.read, "gap clock"),
        ("train", "data.", simulation.simulated, "durations seed process_noise sensor_noise cache gap clock"),
        ("diagnose", "", nsde_torch.diagnose, "alpha max_effects candidates seed"),
        ("evaluate", "", nsde_torch.evaluate, "seed particles horizons bootstrap compile"),
        ("simulate", "", nsde_torch.simulate, "durations dt"),
        ("simulate", "plant.", nsde_torch.simulate, "declared_only process_noise sensor_noise battery"),
    )
    for argument in arguments.split()
]


@pytest.mark.parametrize(("command", "name", "function", "argument"), SIGNATURES)
def test_a_key_has_the_default_of_the_function_that_it_is_for(
    command: str, name: str, function: Any, argument: str
) -> None:
    chosen = {**groups.defaults(command)}
    (entry,) = [entry for entry in groups.keys(command, chosen) if entry.path == name]
    assert inspect.signature(function).parameters[argument].default == entry.default


def test_a_method_of_torchdiffeq_has_the_defaults_of_its_options() -> None:
    taken = inspect.signature(TorchDiffEq.__init__).parameters
    assert TorchDiffEqOptions().settings == {k: taken[k].default for k in TorchDiffEqOptions().settings}
