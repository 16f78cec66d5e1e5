"""An effect of the catalogue that only comes near to a law is told from one that is there, without a coordinate too."""

from __future__ import annotations

import pytest

from nsde_torch.diagnosis.elimination import Retained
from nsde_torch.diagnosis.imitation import a_law_is_nearer
from nsde_torch.diagnosis.options import Options
from nsde_torch.diagnosis.screening import joined
from nsde_torch.diagnosis.search import search_in
from nsde_torch.diagnosis.selection import Selection
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import recorded

NAME = "flapping_moment"


@pytest.mark.parametrize(
    ("effect", "nearer"),
    [
        ({"body_moment[x] = c1 abs(v_body_y) v_body_y": {"c1": 0.8}}, True),
        ({NAME: {"gain": [2.0, 2.0]}}, False),
    ],
    ids=["a moment of the square of a speed", "a moment of the speed"],
)
@pytest.mark.slow
def test_an_effect_of_a_multirotor_is_held_against_laws(
    effect: dict[str, dict[str, float]], nearer: bool
) -> None:
    data = recorded("quadrotor", effect, durations=(10.0,) * 3, dt=0.02)
    system = make_system("quadrotor")
    search = search_in(system, data.runs, 1.0, Options())
    declared = search.base(system)
    final = search.base(joined(system, NAME, {}), like=declared.regression)
    chosen = Selection(declared, final, [NAME], [], ())
    assert a_law_is_nearer(search, chosen, Retained([], final), NAME) is nearer
