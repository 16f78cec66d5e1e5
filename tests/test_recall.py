"""What jobs of a sweep share: worked out once, and never changed by one of them for another."""

from pathlib import Path
from typing import Any

import pytest

import nsde_torch
from nsde_torch.recall import recall, remembering


def test_what_is_recalled_was_made_once_and_is_a_copy() -> None:
    made: list[int] = []

    def make() -> dict[str, list[int]]:
        made.append(1)
        return {"values": [1, 2]}

    assert recall("key", make) == recall("key", make)
    assert len(made) == 2, "nothing is kept unless it is asked for"
    with remembering():
        recall("key", make)["values"].append(3)
        assert recall("key", make) == {"values": [1, 2]}
        assert len(made) == 3
        recall("other", make)
        assert len(made) == 4
    assert recall("key", make) == {"values": [1, 2]}
    assert len(made) == 5


@pytest.mark.slow
def test_a_training_after_another_seed_gives_the_same_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from nsde_torch.training import fit_innovations

    identifications: list[int] = []  # of all training runs, and without each of them
    identified = fit_innovations.identified

    def counted(*args: Any, **options: Any) -> Any:
        identifications.append(1)
        return identified(*args, **options)

    distances: list[int] = []
    fit_distance = fit_innovations.fit_distance

    def fitted(*args: Any, **options: Any) -> None:
        distances.append(1)
        fit_distance(*args, **options)

    monkeypatch.setattr(fit_innovations, "identified", counted)
    monkeypatch.setattr(fit_innovations, "fit_distance", fitted)
    data = nsde_torch.simulate(
        "mass_spring_damper", durations=[3.0] * 3, seed=1, effects=["quadratic_damping"]
    )

    def metrics(seed: int, name: str) -> dict[str, Any]:
        made = nsde_torch.train(
            data, system="mass_spring_damper", trainer="fast", seed=seed, run_dir=tmp_path / name, say=False
        )
        return {k: v for k, v in made.metrics.items() if k != "seconds"}

    alone = metrics(1, "alone")
    assert alone["calibration"]["left_out"]
    count = len(identifications)
    with remembering():
        metrics(0, "first")
        assert len(identifications) == 2 * count
        assert len(distances) == 2 * 3
        assert metrics(1, "second") == alone
        assert len(distances) == 2 * 3 + 1, "fits without a run were made again"
        assert len(identifications) == 2 * count, "what does not depend on the seed was worked out again"
