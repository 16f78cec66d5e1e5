"""Scores of a policy study become checks that follow the numbers; a folder without one is refused."""

import json
from pathlib import Path

import pytest

from nsde_benchmarks.paper.policies import learned_in
from nsde_torch.errors import DataError


def study(folder: Path, sde: float, ensemble: float, blackbox: float = 0.5) -> Path:
    rows = []
    scores = {"truth": 1.0, "limited": 0.2, "nsde": sde, "blackbox_nsde": blackbox, "ensemble": ensemble}
    for kind, score in scores.items():
        policy = folder / f"{kind}_0"
        policy.mkdir()
        curve = [{"interactions": n, "truth_reward": n / 10, "environment_reward": n / 9} for n in (0, 100)]
        (policy / "policy.json").write_text(json.dumps({"curve": curve}))
        data = "published" if kind in ("truth", "limited") else "random"
        row = {"data": data, "truth": "published", "environment": kind, "seeds": 1, "policies": [str(policy)]}
        row |= {"reward": 10 * score, "reward_std_over_seeds": 0.0, "score": score}
        rows.append({**row, "score_std_over_seeds": 0.0, "random_reward": -300.0, "truth_reward": 10.0})
    (folder / "policies.json").write_text(json.dumps({"rows": rows}))
    return folder


@pytest.mark.parametrize(
    ("sde", "ensemble", "passed"), [(0.97, 0.3, [True, True]), (0.9, 0.96, [False, False])]
)
def test_checks_follow_the_scores(tmp_path: Path, sde: float, ensemble: float, passed: list[bool]) -> None:
    folder = study(tmp_path, sde, ensemble)
    outcome = learned_in(folder, ("nsde", "ensemble"), title="policies", source="a claim")
    assert [check.passed for check in outcome.checks] == passed
    assert set(outcome.figures) == {"random"}
    assert outcome.values["random"]["limited"]["score"] == 0.2


@pytest.mark.parametrize(("blackbox", "passed"), [(0.5, True), (0.98, False)])
def test_physics_is_worth_something_where_policies_without_it_earn_less(
    tmp_path: Path, blackbox: float, passed: bool
) -> None:
    folder = study(tmp_path, 0.97, 0.3, blackbox)
    outcome = learned_in(folder, ("nsde", "blackbox_nsde"), title="policies", source="a claim")
    assert [check.passed for check in outcome.checks] == [True, passed]
    assert "one seed" in outcome.checks[1].measured


def test_a_folder_without_a_study_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"bench_policy\.py"):
        learned_in(tmp_path, ("nsde",), title="policies", source="a claim")
