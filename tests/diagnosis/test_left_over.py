"""Candidates of a machine that declares no spring."""

from nsde_torch.diagnosis.candidates import candidate_names
from nsde_torch.systems import make_system

SPRING = "mass_spring_damper"


def test_a_spring_is_sought_where_none_is_declared() -> None:
    assert "linear_spring[cart]" in candidate_names(make_system("cartpole"))
    assert not [n for n in candidate_names(make_system(SPRING)) if n.startswith("linear_spring")]
