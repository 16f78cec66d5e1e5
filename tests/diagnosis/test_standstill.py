"""What rests for much of the time is searched where it moves, once."""

import nsde_torch
from tests.helpers.sticking import STICKING, sticking_runs

SIZE = 2.5  # m/s2, which holds the mass for two thirds of the time


def test_a_mass_that_dry_friction_holds_for_most_of_the_time_is_searched_where_it_moves() -> None:
    stages: list[str] = []
    found = nsde_torch.diagnose(
        sticking_runs(SIZE, runs=2, seconds=20.0),
        system="mass_spring_damper",
        candidates=["coulomb_friction", "quadratic_damping"],
        say=lambda stage, done, total: stages.append(stage),
    ).content()
    assert found["added"] == ["coulomb_friction"]
    for label, true in {**STICKING, "coulomb_friction.size": SIZE}.items():
        found_as = {**found["declared_parameters"], **found["parameters"]}[label]
        low, high = found_as["interval_90"]
        assert abs(found_as["value"] - true) < high - low
    assert not [stage for stage in stages if stage.startswith("second search, round")]
