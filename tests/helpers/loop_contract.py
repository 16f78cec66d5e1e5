"""What every training loop does: killed anywhere and resumed it ends in the same bits, and so does the same seed."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from nsde_torch.data import Run
from nsde_torch.training import LossOptions, TrainerOptions
from nsde_torch.training.loop import Loop
from nsde_torch.training.task import Task


class Killed(Exception):
    """Represents a power failure."""


def kill_at(loop: Loop, count: int) -> None:
    """Raise in the middle of gradient step number `count` (steps of all stages are counted on)."""
    terms, calls = loop.terms, [0]

    def counted() -> dict[str, torch.Tensor]:
        calls[0] += 1
        if calls[0] == count:
            raise Killed
        return terms()

    loop.terms = counted  # type: ignore[method-assign]


def averages_of(loop: Loop) -> dict[int, list[torch.Tensor]]:
    """Running averages of the weights at every validation to come, by its step."""
    averages: dict[int, list[torch.Tensor]] = {}
    score = loop._score

    def watched(losses: dict[str, torch.Tensor]) -> dict[str, float]:
        averages[loop.progress.step] = [a.clone() for a in loop.average]
        return score(losses)

    loop._score = watched  # type: ignore[method-assign]
    return averages


def task_of(
    spec: Any, runs: Sequence[Run], checkpoint: Path, options: TrainerOptions, **changed: Any
) -> Task:
    """A task for a fit on the processor, in single precision."""
    given: dict[str, Any] = {"seed": 0, "name": "train", "validation": 0.3, "clock": 1.0, **changed}
    where: dict[str, Any] = {"device": torch.device("cpu"), "dtype": torch.float32, "checkpoint": checkpoint}
    quiet: dict[str, Any] = {"values": {}, "loss": LossOptions(), "log": lambda *_: None}
    return Task(spec=spec, runs=list(runs), options=options, **given, **where, **quiet)


class LoopContract:
    """Inherit it, and write `make` and the fixture `killed`: numbers of the steps that a run is killed in."""

    @pytest.fixture
    def killed(self) -> int:
        raise NotImplementedError

    def make(self, seed: int = 0) -> Loop:
        raise NotImplementedError

    def same(self, a: Loop, b: Loop) -> None:
        assert a.progress == b.progress
        for (name, p), q in zip(a.model.state_dict().items(), b.model.state_dict().values(), strict=True):
            assert torch.equal(p, q), name

    def test_killed_at_any_step_and_resumed_it_ends_in_the_same_bits(
        self, killed: int, tmp_path: Path
    ) -> None:
        whole = self.make()
        whole.run(title="t", quiet=True)
        first = self.make()
        kill_at(first, killed)
        with pytest.raises(Killed):
            first.run(title="t", checkpoint=tmp_path / "c", quiet=True)
        second = self.make()
        second.run(title="t", checkpoint=tmp_path / "c", quiet=True)
        self.same(whole, second)

    def test_killed_again_and_again_it_ends_in_the_same_bits(self, tmp_path: Path) -> None:
        whole = self.make()
        whole.run(title="t", quiet=True)
        for _ in range(20):
            loop = self.make()
            kill_at(loop, 3)
            try:
                loop.run(title="t", checkpoint=tmp_path / "c", quiet=True)
            except Killed:
                continue
            break
        self.same(whole, loop)

    def test_finished_and_run_again_it_changes_nothing_and_takes_no_step(self, tmp_path: Path) -> None:
        first = self.make()
        first.run(title="t", checkpoint=tmp_path / "c", quiet=True)
        again = self.make()
        kill_at(again, 1)
        again.run(title="t", checkpoint=tmp_path / "c", quiet=True)
        self.same(first, again)

    def test_the_same_seed_gives_the_same_bits_and_another_seed_others(self) -> None:
        a, b, c = (self.make(seed=s) for s in (1, 1, 2))
        for loop in (a, b, c):
            loop.run(title="t", quiet=True)
        self.same(a, b)
        assert a.progress.history != c.progress.history

    def test_the_global_generator_plays_no_part(self) -> None:
        a, b = self.make(), self.make()
        torch.manual_seed(1)
        a.run(title="t", quiet=True)
        torch.manual_seed(2)
        state = torch.random.get_rng_state()
        b.run(title="t", quiet=True)
        self.same(a, b)
        assert torch.equal(state, torch.random.get_rng_state())
