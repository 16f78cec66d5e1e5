"""A controller in a process of its own: its faults are known to the loop, which never waits."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from nsde_torch.px4.flight.controller import Asked, Demand, DemandPlan, FlightController, Maker, Process
from nsde_torch.px4.link.connection import STREAM, urgent

ROW = (0.0,) * 6 + (1.0,) + (0.0,) * 6


def _still(row: tuple[float, ...], time: float, t: float, asked: Asked = ()) -> DemandPlan:
    return DemandPlan(time, 0.05, (Demand((0.0, 0.0, 0.0), 9.81),))


def good(say: Callable[[str], None]) -> FlightController:
    return _still


def crashing(say: Callable[[str], None]) -> FlightController:
    def crash(row: tuple[float, ...], time: float, t: float, asked: Asked = ()) -> DemandPlan:
        raise ValueError("no plan today")

    return crash


@contextmanager
def _made(maker: Maker) -> Iterator[Process]:
    """A process that is ready, and was offered a state."""
    runner = Process(maker)
    try:
        _wait(runner, lambda: runner.ready)
        runner.offer(ROW, 5.0, 0.0)
        yield runner
    finally:
        runner.close()


def _wait(runner: Process, until: Callable[[], bool], longest: float = 60.0) -> None:
    end = time.monotonic() + longest
    while not until() and time.monotonic() < end:
        runner.collect()
        time.sleep(0.01)
    assert until()


def test_plans_come_back_and_a_killed_process_is_noticed() -> None:
    with _made(good) as runner:
        _wait(runner, lambda: runner.plan is not None)
        assert runner.plan.demands[0].thrust == 9.81
        os.kill(runner.process.pid, signal.SIGKILL)
        _wait(runner, lambda: runner.fault is not None)
        assert "gone" in str(runner.fault)
        begun = time.monotonic()
        runner.offer(ROW, 6.0, 0.0)
        assert time.monotonic() - begun < 0.5


def test_an_error_over_there_is_told_here_in_its_words() -> None:
    with _made(crashing) as runner:
        _wait(runner, lambda: runner.fault is not None)
        assert "no plan today" in str(runner.fault)


def scheduled(say: Callable[[str], None]) -> FlightController:
    """Makes one that says how its thread is scheduled, as its thrust."""

    def plan(row: tuple[float, ...], time: float, t: float, asked: Asked = ()) -> DemandPlan:
        return DemandPlan(time, 0.05, (Demand((0.0, 0.0, 0.0), float(os.sched_getscheduler(0))),))

    return plan


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="Linux alone has these calls")
def test_stream_and_plans_go_before_other_processes_where_the_system_allows_it() -> None:
    before = os.sched_getscheduler(0)
    with urgent(STREAM) as allowed:
        assert os.sched_getscheduler(0) & 0xFF == (os.SCHED_RR if allowed else os.SCHED_OTHER)
    assert os.sched_getscheduler(0) == before
    with _made(scheduled) as runner:
        _wait(runner, lambda: runner.plan is not None)
        alone = len(os.sched_getaffinity(0)) == 1
        kind = os.SCHED_RR if allowed and not alone else os.SCHED_OTHER
        assert int(runner.plan.demands[0].thrust) & 0xFF == kind
