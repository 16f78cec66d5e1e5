"""A log that follows other conventions is refused with the way to write it; a sound one passes, whatever its noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.data import DataSet, RawRun
from nsde_torch.data.quaternion import conjugate, rotate
from nsde_torch.errors import DataError
from nsde_torch.recording import assemble
from tests.helpers.data_systems import HEXACOPTER
from tests.helpers.flights import flight

Array = NDArray[np.float64]


def read(x: Array, t: Array, u: Array) -> DataSet:
    return assemble([RawRun("a", t, x, u)], HEXACOPTER, kind="test")


def scalar_last(x: Array) -> None:
    x[:, 6:10] = x[:, [7, 8, 9, 6]]


def world_to_body(x: Array) -> None:
    x[:, 6:10] = conjugate(x[:, 6:10])


def both(x: Array) -> None:
    world_to_body(x)
    scalar_last(x)


def body_velocity(x: Array) -> None:
    x[:, 3:6] = rotate(conjugate(x[:, 6:10]), x[:, 3:6])


def swapped(x: Array) -> None:
    x[:, [3, 4]] = x[:, [4, 3]]


def north_east_down(x: Array) -> None:
    x[:, 3:6] = x[:, [4, 3, 5]] * [1.0, 1.0, -1.0]


@pytest.mark.parametrize(
    ("spoil", "remedy"),
    [
        (scalar_last, "scalar last: write w before x y z"),
        (world_to_body, "turns the world into the body: change the signs of its last three"),
        (both, "scalar last and turns the world into the body"),
        (body_velocity, r"along the body's axes: turn it into the world .* v_world = R\(q\) v"),
        (swapped, "the columns v_y v_x v_z are v_x v_y v_z"),
        (north_east_down, "NED: write east, north, up"),
    ],
)
def test_another_convention_is_refused_with_the_way_to_write_it(
    spoil: Callable[[Array], None], remedy: str
) -> None:
    t, x, u = flight(30.0)
    spoil(x)
    with pytest.raises(DataError, match=remedy):
        read(x, t, u)


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.3])
def test_a_sound_flight_passes_whatever_its_noise(noise: float) -> None:
    t, x, u = flight(30.0)
    x[:, :6] += noise * np.random.default_rng(0).normal(size=(len(t), 6))
    assert len(read(x, t, u)) == 1


def test_a_flight_too_short_to_judge_passes() -> None:
    t, x, u = flight(4.0)
    body_velocity(x)
    assert len(read(x, t, u)) == 1
