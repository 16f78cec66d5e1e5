"""What jobs of a sweep share: worked out once, and never changed by one of them for another."""

from collections.abc import Callable
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

    counts = dict.fromkeys(("identified", "fit_distance"), 0)

    def counting(name: str) -> Callable[..., Any]:
        real = getattr(fit_innovations, name)

        def counted(*args: Any, **how: Any) -> Any:
            counts[name] += 1
            return real(*args, **how)

        return counted

    for name in counts:
        monkeypatch.setattr(fit_innovations, name, counting(name))
    system = "mass_spring_damper"
    data = nsde_torch.simulate(system, durations=[3.0] * 3, seed=1, effects=["quadratic_damping"])

    def metrics(seed: int, name: str) -> dict[str, Any]:
        made = nsde_torch.train(
            data, system=system, trainer="fast", seed=seed, run_dir=tmp_path / name, say=False
        )
        return {k: v for k, v in made.metrics.items() if k != "seconds"}

    alone = metrics(1, "alone")
    with remembering():
        metrics(0, "first")
        assert counts == {"identified": (count := counts["identified"]), "fit_distance": 2 * 3}
        assert metrics(1, "second") == alone
    # fits without a run, and what does not depend on the seed, are not made again
    assert counts == {"identified": count, "fit_distance": 2 * 3 + 1}
