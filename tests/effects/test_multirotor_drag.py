"""Drag of multirotors: the contract, and each formula by hand."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from nsde_torch.systems.machines import plant_effects
from tests.helpers.effect_contract import EffectContract
from tests.helpers.effect_rows import flying, term


class TestLinearDrag(EffectContract):
    name, system = "linear_drag", "hexacopter"

    def test_it_brakes_along_the_axes_of_the_body(self) -> None:
        effect = self.make({"drag": [0.1, 0.2, 0.3]})
        # turned left by a quarter: world's +x is the body's right (-y)
        x = flying([2.0, 0.0, 1.0], Rotation.from_euler("z", 90, degrees=True))
        torch.testing.assert_close(term(effect, x), torch.tensor([[0.0, 0.4, -0.3]]), atol=1e-6, rtol=0)

    def test_it_takes_energy_at_every_attitude(self) -> None:
        s = self.machine().double()
        x, _, _ = self.rows(50)
        u = torch.zeros(50, s.nu).double()
        force = s.drift(0.0, x, u)[:, 3:6] - torch.tensor([0.0, 0.0, -9.81]).double()
        assert bool(((force * x[:, 3:6]).sum(1) < 0).all())


class TestQuadraticDrag(EffectContract):
    name, system = "quadratic_drag", "quadrotor"

    def test_it_grows_with_the_square_of_the_speed(self) -> None:
        effect = self.make({"drag": [0.1, 0.1, 0.2]})
        x = flying([3.0, 0.0, 4.0], Rotation.identity())
        torch.testing.assert_close(term(effect, x), torch.tensor([[-1.5, 0.0, -4.0]]))
        doubled = flying([6.0, 0.0, 8.0], Rotation.identity())
        torch.testing.assert_close(term(effect, doubled), 4 * term(effect, x))


class TestRotorDrag(EffectContract):
    name, system = "rotor_drag", "hexacopter"

    def test_it_is_linear_drag_at_hover_and_twice_that_at_four_times_the_thrust(self) -> None:
        effect = self.make({"drag": [0.1, 0.2, 0.3]})
        x = flying([2.0, -1.0, 3.0], Rotation.identity())
        for thrust, times in ((9.81, 1.0), (4 * 9.81, 2.0), (-1.0, 0.0)):
            u = torch.cat((torch.zeros(1, 6), torch.tensor([[thrust]])), 1)
            expected = times * torch.tensor([[-0.2, 0.2, -0.9]])
            torch.testing.assert_close(term(effect, x, u), expected, atol=1e-5, rtol=0)

    def test_it_stands_in_for_linear_drag(self) -> None:
        before, after = (plant_effects("hexacopter", effects=e) for e in ([], ["rotor_drag"]))
        assert after["rotor_drag"] == before["linear_drag"]
        assert "linear_drag" not in after


class TestTranslationalLift(EffectContract):
    name, system = "translational_lift", "quadrotor"

    def test_it_grows_with_the_square_of_the_speed_in_the_plane_of_the_rotors(self) -> None:
        effect = self.make({"lift": 0.02})
        # on its side, what is up in the world lies in that plane
        x = flying([3.0, 0.0, 4.0], Rotation.from_euler("x", 90, degrees=True))
        torch.testing.assert_close(term(effect, x), torch.tensor([[0.0, 0.0, 0.5]]), atol=1e-6, rtol=0)
        torch.testing.assert_close(
            term(effect, flying([0.0, 0.0, 4.0], Rotation.identity())), torch.zeros(1, 3)
        )


class TestTrackedPoint(EffectContract):
    name, system = "tracked_point", "hexacopter"

    def test_it_is_what_turning_adds_to_the_acceleration_of_a_point(self) -> None:
        offset, rate, faster = (
            np.array(v) for v in ([0.03, -0.02, 0.05], [1.0, -2.0, 0.5], [8.0, 3.0, -4.0])
        )

        def velocity(t: float) -> np.ndarray:
            """Of the point about the centre, in the axes of the start: to the second order in time."""
            turned = Rotation.from_rotvec(rate * t + 0.5 * faster * t * t)
            return turned.apply(np.cross(rate + faster * t, offset))

        expected = (velocity(1e-4) - velocity(-1e-4)) / 2e-4
        x = flying([0.0, 0.0, 0.0], Rotation.from_euler("xyz", [20, -30, 70], degrees=True))
        x[0, 10:13] = torch.tensor(rate)
        u = torch.cat((torch.zeros(1, 6), torch.tensor(faster, dtype=torch.float32)[None]), 1)
        ours = term(self.make({"offset": offset.tolist()}), x, u)
        np.testing.assert_allclose(ours.detach().numpy()[0], expected, atol=1e-5)


class TestConstantWind(EffectContract):
    name, system = "constant_wind", "hexacopter"

    def test_who_flies_with_the_wind_feels_none(self) -> None:
        effect = self.make({"drag": [0.1, 0.2, 0.3], "wind": [2.0, -1.0]})
        x = flying([2.0, -1.0, 0.0], Rotation.from_euler("z", 40, degrees=True))
        torch.testing.assert_close(term(effect, x), torch.zeros(1, 3), atol=1e-6, rtol=0)

    def test_who_hovers_is_pushed_along_it_in_body_axes(self) -> None:
        effect = self.make({"drag": [0.1, 0.2, 0.3], "wind": [2.0, 0.0]})
        # turned left by a quarter: a wind to the east comes from the left, to the right (-y)
        x = flying([0.0, 0.0, 0.0], Rotation.from_euler("z", 90, degrees=True))
        torch.testing.assert_close(term(effect, x), torch.tensor([[0.0, -0.4, 0.0]]), atol=1e-6, rtol=0)

    def test_without_wind_it_is_linear_drag(self) -> None:
        x, _, _ = self.rows(9)
        wind = self.make({"drag": [0.1, 0.2, 0.3], "wind": [0.0, 0.0]}).double()
        drag = TestLinearDrag().make({"drag": [0.1, 0.2, 0.3]}).double()
        torch.testing.assert_close(term(wind, x), term(drag, x))
