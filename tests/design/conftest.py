"""Members of a tie, fitted once."""

import pytest

import nsde_torch
from nsde_torch.design import Question
from nsde_torch.design.members import members_of
from nsde_torch.systems.options import system_options
from tests.helpers.ties import BIASED, DT, SIDED, TRUE, Tie


@pytest.fixture(scope="session")
def tie() -> Tie:
    how = {"durations": [5.0] * 2, "seed": 3, "dt": DT, "options": {"force_size": 1.0}}
    made = nsde_torch.simulate("mass_spring_damper", effects=TRUE, **how)
    system = system_options("mass_spring_damper").make()
    runs = tuple(nsde_torch.read(made, system=system).runs)
    question = Question((BIASED, SIDED))
    return Tie(system, runs, question, tuple(members_of(system, runs, question, {}, clock=1.0)))
