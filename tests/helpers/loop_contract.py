"""What every training loop does: killed anywhere and resumed it ends in the same bits, and so does the same seed."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

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
    """A quiet task for a fit on the processor, in single precision."""
    given: dict[str, Any] = {"seed": 0, "name": "train", "validation": 0.3, "clock": 1.0, **changed}
    where: dict[str, Any] = {"device": torch.device("cpu"), "dtype": torch.float32, "checkpoint": checkpoint}
    rest: dict[str, Any] = {"values": {}, "loss": LossOptions(), "log": lambda *_: None, "quiet": True}
    return Task(spec=spec, runs=list(runs), options=options, **{**rest, **where, **given})


class LoopContract:
    """Inherit it, and write `make`: a loop that keeps its checkpoint in a folder."""

    def make(self, folder: Path, seed: int = 0) -> Loop:
        raise NotImplementedError

    def same(self, a: Loop, b: Loop) -> None:
        assert a.progress == b.progress
        for (name, p), q in zip(a.model.state_dict().items(), b.model.state_dict().values(), strict=True):
            assert torch.equal(p, q), name

    def test_killed_again_and_again_it_ends_in_the_same_bits(self, tmp_path: Path) -> None:
        whole = self.make(tmp_path / "whole")
        whole.run()
        for _ in range(20):
            loop = self.make(tmp_path / "killed")
            kill_at(loop, 3)
            try:
                loop.run()
            except Killed:
                continue
            break
        self.same(whole, loop)

    def test_finished_and_run_again_it_changes_nothing_and_takes_no_step(self, tmp_path: Path) -> None:
        first = self.make(tmp_path)
        first.run()
        again = self.make(tmp_path)
        kill_at(again, 1)
        again.run()
        self.same(first, again)

    def test_the_same_seed_gives_the_same_bits_whatever_the_global_generator_and_another_seed_others(
        self, tmp_path: Path
    ) -> None:
        a, b, c = (self.make(tmp_path / name, seed=s) for name, s in (("a", 1), ("b", 1), ("c", 2)))
        for number, loop in enumerate((a, b, c)):
            torch.manual_seed(number)
            state = torch.random.get_rng_state()
            loop.run()
            assert torch.equal(state, torch.random.get_rng_state())
        self.same(a, b)
        assert a.progress.history != c.progress.history
