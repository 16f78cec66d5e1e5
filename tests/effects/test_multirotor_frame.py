"""Axes of the log that are turned against the machine's: the contract, and the machine itself seen from them."""

from __future__ import annotations

import pytest
import torch
from scipy.spatial.transform import Rotation

from nsde_torch.systems import make_system
from tests.helpers.effect_contract import EffectContract


def seen_from(x: torch.Tensor, r: Rotation) -> torch.Tensor:
    """States of a machine (N, 13) in axes that are turned by `r` against its own."""
    out = x.clone()
    q = Rotation.from_quat(x[:, [7, 8, 9, 6]].numpy()) * r
    out[:, 6:10] = torch.from_numpy(q.as_quat()[:, [3, 0, 1, 2]])
    out[:, 10:13] = torch.from_numpy(r.inv().apply(x[:, 10:13].numpy()))
    return out


class TestFrameMisalignment(EffectContract):
    name, system = "frame_misalignment", "hexacopter"

    @pytest.mark.parametrize("turn", [[0.02, -0.05, 0.03], [0.0, 0.0, 1.2]])
    def test_it_is_the_same_machine_in_other_axes(self, turn: list[float]) -> None:
        values: dict[str, float | list[float]] = {"inertia_x": 0.6, "inertia_y": 0.9}
        own = make_system(self.system, values=values).double()
        other = self.machine(values={**values, "frame_misalignment.turn": turn}).double()
        x, u, _ = self.rows(6)
        r = Rotation.from_rotvec(turn)
        there, here = (
            own.drift(0.0, x, u).detach(),
            other.drift(0.0, seen_from(x, r), u).detach(),
        )
        torch.testing.assert_close(here[:, :6], there[:, :6], atol=1e-5, rtol=0)
        torch.testing.assert_close(
            here[:, 10:13], torch.from_numpy(r.inv().apply(there[:, 10:13].numpy())), atol=1e-5, rtol=0
        )
