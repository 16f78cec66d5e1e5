"""Members of a tie in gusts that the inputs answer: gains near the truth, and the weak motor that is."""

from pathlib import Path

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.design import Question
from nsde_torch.design.experiment import write_plan
from nsde_torch.design.flown import evidence
from nsde_torch.design.members import Member, members_of
from nsde_torch.design.rehearsal import against, fit_all
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.search import Search
from nsde_torch.systems import System
from nsde_torch.systems.options import system_options

LOSS = 0.11
WEAK, OFFSET = ("motor_efficiency_loss",), ("com_offset",)
GAINS = {"thrust_gain": 6.4, "roll_gain": 58.0, "pitch_gain": 58.0}


pytestmark = pytest.mark.slow  # all look at one flight, whose members take a minute


def flown(name: str, folder: Path, t: np.ndarray, *points: np.ndarray, seed: int) -> Run:
    """A quadrotor whose third motor is weak, along points of place and yaw."""
    write_plan(folder / "plan.csv", ("p_x", "p_y", "p_z", "yaw"), np.column_stack((t, *points)))
    how = {"effects": [{"motor_efficiency_loss": {"loss": [0.0, 0.0, LOSS, 0.0]}}], "declared_only": True}
    (raw,) = nsde_torch.simulate("quadrotor", seed=seed, plan=folder / "plan.csv", **how).runs
    return Run(name, raw.t, raw.x, raw.u)


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> tuple[System, list[Run]]:
    t, runs = np.arange(9.0), []
    for i in range(2):
        points = (*(0.5 * np.sin(f * t + i) for f in (0.7, 0.5)), 2.0 + 0.0 * t, 0.0 * t)
        runs.append(flown(f"run_{i}", tmp_path_factory.mktemp("plan"), t, *points, seed=70 + i))
    return system_options("quadrotor").make(), runs


@pytest.fixture(scope="module")
def members(flights: tuple[System, list[Run]]) -> list[Member]:
    system, runs = flights
    return members_of(system, runs, Question((WEAK, OFFSET)), {}, clock=1.0)


def away(labels: list[str], theta: np.ndarray, errors: np.ndarray) -> float:
    """Standard errors by which the gain that is off most is off."""
    return max(abs(theta[i] - GAINS[k]) / errors[i] for i, k in enumerate(labels) if k in GAINS)


def test_gains_of_a_gentle_flight_are_near_the_truth_for_what_is_said_of_them(
    flights: tuple[System, list[Run]], members: list[Member]
) -> None:
    system, runs = flights
    for member in members:
        assert away(member.vector.labels, member.theta, np.sqrt(np.diag(member.covariance))) < 3.0
    # with a law for each channel alone, which is what is left of a diagnosis' means for runs as short, one is wrong
    base = Search(system, runs, 1.0, Options()).quick(members[0].system)
    flat = base.slopes.reshape(-1, len(base.vector))
    errors = np.sqrt(np.diag(np.linalg.pinv(flat.T @ flat)))
    assert away(base.vector.labels, base.theta, errors) > 4.0


def test_one_weak_motor_is_found_and_not_spoken_against(members: list[Member]) -> None:
    weak, offset = members
    loss = [weak.theta[weak.vector.labels.index(f"motor_efficiency_loss.loss[{i}]")] for i in range(4)]
    np.testing.assert_allclose(loss, [0.0, 0.0, LOSS, 0.0], atol=0.02)
    assert weak.nats > offset.nats + 3.0  # regressions of steps could not tell
    # what is held at nothing is drawn there
    drawn = weak.draws(8, np.random.default_rng(0))
    first = weak.vector.labels.index("motor_efficiency_loss.loss[0]")
    assert np.abs(drawn[:, first]).max() < 1e-3


def test_a_faster_flight_speaks_for_the_weak_motor(
    flights: tuple[System, list[Run]], members: list[Member], tmp_path: Path
) -> None:
    """Members that fly are fitted to all runs together."""
    system, runs = flights
    t = np.arange(7.0)
    points = [1.5 * np.sin(0.9 * t), 1.5 * np.sin(1.4 * t), 2.0 + 0.5 * np.sin(t), 0.3 * t]
    run, question = flown("flown", tmp_path, t, *points, seed=75), Question((WEAK, OFFSET))
    each = fit_all(members, [run])
    told = evidence(system, members, each, runs, [run], question, {}, clock=1.0)
    assert against(told, 0) > 3.0
    assert each[0].excess < 1.5
