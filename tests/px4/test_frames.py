"""The border between NED/FRD and ENU/FLU, against values worked by hand and against the reader of logs."""

from math import cos, degrees, pi, sin, sqrt

import numpy as np
import pytest

from nsde_torch.data.quaternion import attitude_to_enu, swap_body, swap_world
from nsde_torch.px4.link import frames
from nsde_torch.px4.link.vectors import Quat, yaw_of


def test_north_is_y_east_is_x_down_is_minus_z_and_so_is_it_in_the_body() -> None:
    assert frames.world((1.0, 2.0, 3.0)) == (2.0, 1.0, -3.0)
    assert frames.body((1.0, 2.0, 3.0)) == (1.0, -2.0, -3.0)


S, C30, S30, C20, S20 = sqrt(0.5), cos(pi / 6), sin(pi / 6), cos(pi / 9), sin(pi / 9)


@pytest.mark.parametrize(
    ("what", "ned", "enu", "heading"),
    [
        ("level, nose north: heading +90 deg from east", (1.0, 0.0, 0.0, 0.0), (S, 0.0, 0.0, S), 90.0),
        ("level, nose east", (S, 0.0, 0.0, S), (1.0, 0.0, 0.0, 0.0), 0.0),
        ("level, nose west: NED yaw -90 deg, ENU 180 deg", (S, 0.0, 0.0, -S), (0.0, 0.0, 0.0, 1.0), 180.0),
        # rolled about the nose: the roll is +60 deg about x in both body frames
        (
            "nose east, right wing down 60 deg", (S * C30, S * S30, S * S30, S * C30), (C30, S30, 0.0, 0.0), 0.0,
        ),
        # +40 deg about y in FRD, -40 deg about y in FLU
        ("nose east, nose up 40 deg", (S * C20, -S * S20, S * S20, S * C20), (C20, 0.0, -S20, 0.0), 0.0),
    ],
)  # fmt: skip
def test_attitudes_worked_by_hand(what: str, ned: Quat, enu: Quat, heading: float) -> None:
    assert frames.attitude(ned) == pytest.approx(enu, abs=1e-12), what
    assert frames.attitude(enu) == pytest.approx(ned, abs=1e-12), what
    assert degrees(yaw_of(enu)) == pytest.approx(heading, abs=1e-9), what


def test_flights_and_logs_are_converted_alike() -> None:
    rng = np.random.default_rng(1)
    q, v = rng.normal(size=(20, 4)), rng.normal(size=(20, 3))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    flown = np.array([frames.attitude(tuple(row)) for row in q])
    np.testing.assert_allclose(np.abs((attitude_to_enu(q) * flown).sum(1)), 1.0)
    np.testing.assert_allclose([frames.world(tuple(row)) for row in v], swap_world(v))
    np.testing.assert_allclose([frames.body(tuple(row)) for row in v], swap_body(v))
