"""The border between NED/FRD and ENU/FLU, against values worked by hand and against the reader of logs."""

from __future__ import annotations

from math import cos, pi, sin, sqrt

import numpy as np
import pytest

from nsde_torch.data.quaternion import attitude_to_enu, swap_body, swap_world
from nsde_torch.px4.link import frames
from nsde_torch.px4.link.vectors import Quat, Vec, normalised, rotate, rotate_back, yaw_of

S = sqrt(0.5)


@pytest.mark.parametrize(
    ("ned", "enu"),
    [
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
        ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),
        ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0)),
    ],
)
def test_north_is_y_east_is_x_down_is_minus_z(ned: Vec, enu: Vec) -> None:
    assert frames.world(ned) == enu
    assert frames.world(enu) == ned


def test_right_is_minus_y_of_the_body_and_down_is_minus_z() -> None:
    assert frames.body((1.0, 2.0, 3.0)) == (1.0, -2.0, -3.0)


@pytest.mark.parametrize(
    ("what", "ned", "enu"),
    [
        ("level, nose north: heading +90 deg from east", (1.0, 0.0, 0.0, 0.0), (S, 0.0, 0.0, S)),
        ("level, nose east", (S, 0.0, 0.0, S), (1.0, 0.0, 0.0, 0.0)),
        ("level, nose west: NED yaw -90 deg, ENU 180 deg", (S, 0.0, 0.0, -S), (0.0, 0.0, 0.0, 1.0)),
        # nose east, rolled right by 60 deg about the nose: the roll is +60 deg about x in both body frames
        (
            "nose east, right wing down 60 deg",
            (S * cos(pi / 6), S * sin(pi / 6), S * sin(pi / 6), S * cos(pi / 6)),
            (cos(pi / 6), sin(pi / 6), 0.0, 0.0),
        ),
        # nose east, nose up by 40 deg: +40 deg about y in FRD, -40 deg about y in FLU
        (
            "nose east, nose up 40 deg",
            (S * cos(pi / 9), -S * sin(pi / 9), S * sin(pi / 9), S * cos(pi / 9)),
            (cos(pi / 9), 0.0, -sin(pi / 9), 0.0),
        ),
    ],
)
def test_attitudes_worked_by_hand(what: str, ned: Quat, enu: Quat) -> None:
    assert frames.attitude(ned) == pytest.approx(enu, abs=1e-12), what
    assert frames.attitude(enu) == pytest.approx(ned, abs=1e-12), what


def test_a_vector_comes_out_the_same_by_both_ways_round() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = normalised(tuple(rng.normal(size=4)))  # type: ignore[arg-type]
        v: Vec = tuple(rng.normal(size=3))  # type: ignore[assignment]
        one = frames.world(rotate(q, v))
        other = rotate(frames.attitude(q), frames.body(v))
        assert one == pytest.approx(other, abs=1e-12)
        assert rotate_back(q, rotate(q, v)) == pytest.approx(v, abs=1e-12)


def test_flights_and_logs_are_converted_alike() -> None:
    rng = np.random.default_rng(1)
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    v = rng.normal(size=3)
    assert abs(np.dot(attitude_to_enu(q), frames.attitude(tuple(q)))) == pytest.approx(1.0)
    assert frames.world(tuple(v)) == pytest.approx(tuple(swap_world(v)))
    assert frames.body(tuple(v)) == pytest.approx(tuple(swap_body(v)))


def test_heading_north_is_ninety_degrees() -> None:
    assert yaw_of(frames.attitude((1.0, 0.0, 0.0, 0.0))) == pytest.approx(pi / 2)
