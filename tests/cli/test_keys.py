"""Schemas declare what every key means and allows."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest

from nsde_torch import conf
from nsde_torch.cli import schema
from nsde_torch.cli.keys import check, key, walk
from nsde_torch.errors import ConfigError

ALL_SCHEMAS = [*schema.COMMAND_SCHEMAS.values()] + [
    choice for choices in schema.CHOICES.values() for choice in choices.values()
]


@pytest.mark.parametrize("declared", ALL_SCHEMAS, ids=lambda cls: cls.__name__)
def test_every_key_has_help_in_plain_words(declared: type) -> None:
    for entry in walk(declared):
        assert entry.help, entry.path
        assert not entry.help.endswith("."), entry.path


@pytest.mark.parametrize("declared", ALL_SCHEMAS, ids=lambda cls: cls.__name__)
def test_every_default_is_allowed(declared: type) -> None:
    values = {entry.path: entry.default for entry in walk(declared) if "." not in entry.path}
    check(declared, {name: value for name, value in values.items() if value != "???"})


@pytest.mark.parametrize("command", schema.COMMAND_SCHEMAS)
def test_no_plain_key_bears_the_name_of_a_group(command: str) -> None:
    # Hydra takes `name=value` for a choice of the group `name`, also in a command that does not use that group.
    groups = {folder.name for folder in Path(conf.__path__[0]).iterdir() if folder.is_dir()}
    plain = {entry.path for entry in walk(schema.COMMAND_SCHEMAS[command]) if "." not in entry.path}
    assert not plain & groups


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
