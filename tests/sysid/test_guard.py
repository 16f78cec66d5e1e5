"""A fit is held against simple ones; faults of the log that only physics shows are told by name, sound logs are not."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

import nsde_torch
from nsde_torch.data import DataSet, RawRun
from nsde_torch.sysid.guard import Guarded, _gone, guarded
from nsde_torch.sysid.identify import identify_in_loop
from nsde_torch.sysid.readings import better_readings
from nsde_torch.sysid.rough import left_at, rough_fit
from nsde_torch.sysid.timing import Shifted
from nsde_torch.systems import make_system
from tests.helpers.electric_motors import CoilMotor, turns
from tests.helpers.tyres import LAG_S, TRUTH, Tyre, drives

Change = Callable[[int, RawRun], None]
Table = np.ndarray


@cache
def log_of(system: str) -> list[RawRun]:
    options = {"variants": 2, "rounds": 1} if system == "quadrotor" else {}
    made = nsde_torch.simulate(system, durations=[10.0] * 3, seed=3, declared_only=True, options=options)
    return list(made.runs)


def guard_of(system: str, change: Change = lambda k, run: None, runs: list[RawRun] | None = None) -> Guarded:
    copies = [
        RawRun(r.name, r.t.copy(), r.x.copy(), r.u.copy(), dict(r.extra)) for r in runs or log_of(system)
    ]
    for k, run in enumerate(copies):
        change(k, run)
    data: DataSet = nsde_torch.read(copies, system=system, state_smoothing="keep")
    found = identify_in_loop(make_system(system), data.runs, clock=data.clock_scale)
    assert found.guard is not None
    return found.guard


@pytest.mark.parametrize("system", ["mass_spring_damper", "cartpole", "quadrotor"])
def test_nothing_speaks_against_the_fit_of_a_sound_log(system: str) -> None:
    guard = guard_of(system)
    assert guard.objections == ()
    for channel in guard.channels:
        assert channel.least_squares <= channel.fit * 1.001 < channel.measured
    assert guard.as_dict()["channels"].keys() == {c.name for c in guard.channels}


DOWN = np.where(np.isin(range(13), (2, 5)), -1.0, 1.0)
NED = [1, 0, 2, 4, 3, 5, *range(6, 13)]


@pytest.mark.parametrize(
    ("system", "written", "words"),
    [
        ("quadrotor", lambda x, u: (x, u[:, [2, 1, 0, 3]]), "u_1 and u_3 exchanged"),
        ("quadrotor", lambda x, u: (x * DOWN, u), "counted downwards"),
        ("quadrotor", lambda x, u: (x / np.repeat((0.3048, 1.0), (6, 7)), u), "in feet"),
        ("quadrotor", lambda x, u: (x[:, NED] * DOWN, u), "in NED and the attitude in ENU"),
        ("mass_spring_damper", lambda x, u: (x, -u), "the opposite sign of 'force'"),
        ("cartpole", lambda x, u: (x + np.array([0, 0, np.pi, 0]), u), "pi more"),
    ],
)
@pytest.mark.slow
def test_columns_that_are_to_be_read_otherwise_are_told_by_name(
    system: str, written: Callable[[Table, Table], tuple[Table, Table]], words: str
) -> None:
    def change(k: int, run: RawRun) -> None:
        run.x, run.u = written(run.x, run.u)

    (objection,) = guard_of(system, change).objections
    assert objection.kind == "reading"
    assert words in objection.sentence
    assert objection.remedy


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_sign_of_a_pole_is_told_on_a_cart_whose_friction_nobody_declared(sign: float) -> None:
    friction = [{"viscous_friction[cart]": {"damping": 15.0}}]
    made = nsde_torch.simulate("cartpole", durations=[6.0] * 3, seed=1, effects=friction)
    turned = [replace(run, x=run.x * [1.0, 1.0, sign, sign]) for run in made.runs]
    # with noise of the input, of which another reading is fitted beside physics that the wrong sign drives far off
    rng = np.random.default_rng(0)
    noisy = [replace(run, u=run.u + 0.05 * rng.normal(size=run.u.shape)) for run in turned]
    machine, data = make_system("cartpole"), nsde_torch.read(noisy, system="cartpole")
    rough = rough_fit(machine, data.runs, data.clock_scale)
    assert rough is not None
    found = better_readings(machine, data.runs, data.clock_scale, rough)
    told = "" if found is None else found.remedy
    assert told == ("" if sign > 0 else "change the signs of 'theta' and 'theta_dot'")


@pytest.mark.slow
@pytest.mark.parametrize("system", ["quadrotor", "hexacopter"])
def test_propellers_that_turn_the_other_way_are_told_and_can_be_declared(system: str) -> None:
    # with the drag, the motor lag and the gusts of the machine
    runs = list(nsde_torch.simulate(system, durations=[10.0] * 2, seed=2).runs)
    yaw = np.array(make_system(system).mixing[-1])  # type: ignore[attr-defined]
    turn = np.eye(len(yaw)) - np.outer(yaw, 2.0 * yaw / (yaw @ yaw))
    flipped = [replace(run, u=(run.u @ turn).clip(0.0, 1.0)) for run in runs]

    def better(log: list[RawRun], direction: int) -> str:
        machine = make_system(system, yaw_direction=direction)
        data = nsde_torch.read(log, system=system, state_smoothing="keep")
        rough = rough_fit(machine, data.runs, data.clock_scale)
        assert rough is not None
        found = better_readings(machine, data.runs, data.clock_scale, rough)
        return "" if found is None else found.remedy

    assert better(flipped, 1) == "write system.options.yaw_direction=-1"
    assert better(runs, -1) == "write system.options.yaw_direction=1"
    assert better(runs, 1) == better(flipped, -1) == ""
    (objection,) = guard_of(system, runs=flipped).objections  # as `nsde diagnose` says it
    assert objection.kind == "reading"
    assert "propellers that turn the other way" in objection.sentence


@pytest.mark.parametrize("milliseconds", [-60, 60])
def test_an_attitude_and_its_rate_that_are_late_or_early_together_are_told_with_the_time(
    milliseconds: int,
) -> None:
    def change(k: int, run: RawRun) -> None:
        run.x[:, 2:4] = np.roll(run.x[:, 2:4], round(milliseconds / 20), axis=0)
        run.t, run.x, run.u = run.t[5:-5], run.x[5:-5], run.u[5:-5]

    (objection,) = guard_of("cartpole", change).objections
    assert objection.kind == "shifted_stream"
    assert objection.sentence.startswith("theta and theta_dot")
    told = re.search(r"about (\d+) ms (late|early) against", objection.sentence)
    assert float(told[1]) == pytest.approx(abs(milliseconds), abs=4.0)
    assert told[2] == ("late" if milliseconds > 0 else "early")


def test_inputs_that_act_as_late_as_actuators_do_are_a_note_and_others_an_objection() -> None:
    def late(rows: int) -> Change:
        def change(k: int, run: RawRun) -> None:
            run.t, run.x, run.u = run.t[:-40], run.x[:-40], np.roll(run.u, -rows, axis=0)[:-40]

        return change

    guard = guard_of("cartpole", late(2))
    assert guard.objections == ()
    assert "motor_lag" in guard.notes[0]
    (objection,) = guard_of("cartpole", late(7)).objections
    assert objection.sentence.startswith("force act about 1")
    assert "later than they are logged" in objection.sentence
    assert not Shifted("u", 0.05, 1.0, 1.0, True).of_actuators


LOADED = {"force_gain": 0.6, "linear_spring.stiffness": 0.6, "viscous_friction.damping": 0.3}


@pytest.mark.parametrize(
    ("machine", "load"),
    [({"effects": {"linear_spring": {"stiffness": 1.6}}}, None), ({"parameters": LOADED}, 1.0 / 0.6)],
    ids=["another machine", "a load"],
)
def test_a_run_of_another_machine_is_named(machine: dict[str, Any], load: float | None) -> None:
    other = nsde_torch.simulate("mass_spring_damper", durations=[10.0], seed=9, **machine).runs[0]
    runs = [*log_of("mass_spring_damper")[:2], RawRun("run_9", other.t + 40.0, other.x, other.u)]
    (objection,) = guard_of("mass_spring_damper", runs=runs).objections
    assert objection.kind == "odd_run"
    assert "'run_9'" in objection.sentence
    told = re.search(r"as with (\S+) times the mass", objection.sentence)
    assert (told and float(told[1])) == (load and pytest.approx(load, abs=0.05))
    assert load or ("stiffness" in objection.sentence and "another machine" in objection.remedy)


def test_an_input_of_another_run_names_the_run() -> None:
    def change(k: int, run: RawRun) -> None:
        if k == 1:
            run.u[:] = np.resize(log_of("mass_spring_damper")[2].u, run.u.shape)

    (objection,) = guard_of("mass_spring_damper", change).objections
    assert objection.kind == "unexplained_run"
    assert objection.sentence.startswith("'run_1' is not explained")


@pytest.mark.slow
def test_a_fit_whose_noise_model_learned_a_smoother_is_not_believed() -> None:
    def smoothed(k: int, run: RawRun) -> None:
        run.x[:] = sosfiltfilt(butter(2, 2.0, fs=50.0, output="sos"), run.x, axis=0)

    guard = guard_of("cartpole", smoothed)
    assert [o.kind for o in guard.objections] == ["least_squares"]
    assert "smoothed" in guard.objections[0].remedy
    # the values that are recommended are said, with their intervals
    assert guard.to_use.keys() == set(guard.labels)
    for name, one in guard.to_use.items():
        assert one["interval_90"][0] < one["value"] < one["interval_90"][1]
        assert f"{name} {one['value']:.3g}" in guard.objections[0].remedy
    assert guard.as_dict()["to_use"] == guard.to_use
    assert "to_use" not in guard_of("cartpole").as_dict()


@pytest.fixture(scope="module")
def rough() -> Any:
    """A rough fit of flights."""
    data = nsde_torch.read(log_of("quadrotor"), system="quadrotor", state_smoothing="keep")
    return rough_fit(make_system("quadrotor"), data.runs)


@pytest.mark.parametrize(
    ("share", "error", "explained", "told"),
    [
        (1e-3, 0.0, 0.0, True),
        (1e-3, 0.2, 0.0, False),  # not sure
        (0.5, 0.0, 0.0, False),  # half as strong as expected
        (1e-3, 0.0, 0.5, False),  # something else explains the channel
    ],
)
def test_a_gain_that_has_surely_gone_and_with_it_all_that_was_explained_is_told(
    share: float, error: float, explained: float, told: bool, rough: Any
) -> None:
    first, theta = rough.vector.start, rough.theta.copy()
    j = rough.vector.labels.index("roll_gain")
    theta[j] = share * first[j]
    covariance = np.diag(np.square(error * first))
    left = [replace(a, left=a.measured * (1.0 - explained) ** 0.5) for a in left_at(rough, theta)]
    gone = _gone(rough, theta, covariance, left)
    assert (gone is not None) == told
    assert gone is None or ("nothing of w_x and" in gone.sentence and "roll_gain" in gone.sentence)


def test_noise_of_states_that_a_stiff_machine_amplifies_speaks_not_against_its_fit() -> None:
    # with a lag that is declared: means over 0.15 s of a slip that is mostly noise fit wrong gains better
    system, data = Tyre(effects=["actuator_lag"]), drives(2)
    rough = rough_fit(system, data.runs)
    assert rough is not None
    true = np.array([TRUTH.get(label, LAG_S) for label in rough.physics.vector.labels])
    left = {c.name: c.left for c in left_at(rough, true)}
    assert left["rim"] > 1.2 * next(c.left for c in left_at(rough, rough.theta) if c.name == "rim")
    assert guarded(rough, data.runs, theta=true).objections == ()


def test_what_is_left_of_a_state_that_settles_within_a_row_is_that_of_the_last_row() -> None:
    # a current of 1 ms, off by a ripple of 0.1 A: the sum over a box of 15 rows has 15 times that
    ripple = 0.1
    data = turns(1, 1000.0, ripple=ripple)
    rough = rough_fit(CoilMotor(), data.runs)
    assert rough is not None
    (current,) = (c for c in left_at(rough, rough.theta) if c.name == "i")
    assert current.left < 1.3 * ripple / rough.dt
