"""Faults of recordings are found, and handled or refused; sound recordings pass untouched."""

from collections.abc import Callable

import numpy as np
import pytest

from nsde_torch.data import DataSet, RawRun
from nsde_torch.data.quaternion import conjugate, rotate
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording import Recording, assemble
from nsde_torch.recording.faults import FAULTS
from nsde_torch.recording.times import no_finer
from nsde_torch.simulation import simulate
from nsde_torch.systems import make_system
from tests.helpers.data_systems import CARTPOLE, HEXACOPTER
from tests.helpers.flights import flight


def one(t: np.ndarray, x: np.ndarray, u: np.ndarray, **options: object) -> DataSet:
    return assemble([RawRun("a", t.copy(), x.copy(), u.copy())], HEXACOPTER, kind="test", **options)  # type: ignore[arg-type]


def kinds(data: DataSet) -> list[str]:
    return [f.kind for f in data.summary.findings]


def noisy(x: np.ndarray, size: float, seed: int) -> np.ndarray:
    """States with noise on all but the attitude."""
    where = np.r_[np.ones(6), np.zeros(4), np.ones(3)]
    return x + size * np.random.default_rng(seed).standard_normal(x.shape) * where


def test_a_sound_flight_passes_untouched() -> None:
    t, x, u = flight(30.0)
    data = one(t, x, u)
    assert kinds(data) == []
    assert data[0].segments == ((0, len(t)),)
    assert (data.clock_scale, data.dt, data[0].dt) == (1.0, 0.01, 0.01)
    np.testing.assert_allclose(data[0].x, x, atol=1e-12)


def test_a_late_sensor_is_reported_with_the_option_that_takes_it_out() -> None:
    t, x, u = flight(60.0)
    x[5:, 10:] = x[:-5, 10:]
    late = one(t, x, u)
    assert kinds(late) == ["late_sensor"]
    (finding,) = late.summary.findings
    assert finding.values["w_s"] == pytest.approx(0.05, rel=0.05)
    assert "data.sensor_delay={w: 0.05}" in finding.message
    put_right = one(t, x, u, sensor_delay={"w": 0.05})
    assert kinds(put_right) == []
    assert put_right[0].segments == ((0, len(t) - 5),)
    assert put_right.fingerprint != late.fingerprint


@pytest.mark.parametrize("scale", [0.9, 1.05])
def test_a_single_rate_is_scaled_in_place_of_the_clock(scale: float) -> None:
    chain = Recording(sensor_scale={"q_dot": scale})
    made = simulate("mass_spring_damper", durations=(12.0,) * 3, seed=1, recording=chain)
    system, logged = make_system("mass_spring_damper"), [run.x for run in made.runs]

    def read(clock: str = "rescale", **values: float) -> DataSet:
        runs = [RawRun(run.name, run.t.copy(), run.x.copy(), run.u.copy()) for run in made.runs]
        for run in runs:
            FAULTS["sensor_scale"].undo_raw(run, system, values)
        return assemble(runs, system, kind="test", clock=clock)

    data = read()
    (finding,) = data.summary.findings
    assert (finding.kind, finding.action, data.clock_scale) == ("sensor_scale", "rescaled", 1.0)
    for run, x in zip(data, logged, strict=True):
        np.testing.assert_allclose(x[:, 1] / run.x[:, 1], scale, rtol=5e-3)
        np.testing.assert_array_equal(x[:, 0], run.x[:, 0])
    kept = read(clock="trust")
    assert [f.action for f in kept.summary.findings] == ["reported"]
    np.testing.assert_array_equal(kept[0].x, logged[0])
    assert kinds(read(q_dot=scale)) == []
    with pytest.raises(DataError, match="column of q_dot"):
        read(clock="refuse")
    with pytest.raises(ConfigError, match="names 'p', which is no state"):
        read(p=2.0)
    with pytest.raises(ConfigError, match=r"other than 0; got 0\.0"):
        read(q=0.0)


def test_gaps_in_time_split_and_the_threshold_can_be_set() -> None:
    t, x, u = flight(10.0)
    keep = np.r_[0:400, 450:1001]
    data = one(t[keep], x[keep], u[keep])
    assert data[0].segments == ((0, 400), (400, 951))
    assert kinds(data) == ["time_gap"]
    assert data.summary.findings[0].values["missing_s"] == pytest.approx(0.51)
    assert kinds(one(t[keep], x[keep], u[keep], gap=1.0)) == ["non_uniform_step"]


def test_dropped_samples_are_interpolated_back_and_inputs_are_held() -> None:
    t, x, u = flight(10.0)
    keep = np.delete(np.arange(1001), [100, 300, 500])
    data = one(t[keep], x[keep], u[keep])
    assert len(data[0]) == 1001
    assert data.summary.findings[0].values["dropped_samples"] == 3
    np.testing.assert_allclose(data[0].x, x, atol=1e-3)
    np.testing.assert_array_equal(data[0].u[300], u[299])
    np.testing.assert_array_equal(data[0].u[301], u[301])


@pytest.mark.parametrize(("rate", "digits"), [(60, 3), (104, 6)])
def test_times_that_were_rounded_are_those_of_the_clock_that_was_rounded(rate: int, digits: int) -> None:
    t, x, u = flight(30.0, dt=1.0 / rate)
    data = one(np.round(t, digits), x, u)
    assert data.dt == pytest.approx(1.0 / rate, rel=1e-9)
    assert data[0].dt == pytest.approx(1.0 / rate, rel=1e-6)
    assert kinds(data) == []
    np.testing.assert_array_equal(data[0].u, u)
    np.testing.assert_allclose(data[0].x, x, atol=1e-12)


def test_duplicates_and_rows_out_of_order_are_mended() -> None:
    t, x, u = flight(5.0)
    order = np.arange(501)
    order[[200, 201]] = [201, 200]
    order = np.insert(order, 350, 350)
    data = one(t[order], x[order], u[order])
    assert kinds(data) == ["out_of_order", "duplicate_time"]
    np.testing.assert_allclose(data[0].x, x, atol=1e-12)


def test_rows_that_came_faster_than_their_clock_ticks_are_all_kept() -> None:
    t, x, u = flight(20.0)
    keep = np.r_[0:700, 830:2001]  # with a pause
    data = one(np.round(t[keep], 1), x[keep], u[keep])
    assert kinds(data)[0] == "rounded_time"
    assert sum(b - a for a, b in data[0].segments) > 0.99 * len(keep)
    assert data.dt == pytest.approx(0.01, rel=1e-2)


def test_a_clock_that_starts_again_is_refused() -> None:
    t, x, u = flight(5.0)
    with pytest.raises(DataError, match=r"goes back from 4.99 s to 0 s .* split the recording"):
        one(np.concatenate([t[:-1], t]), np.concatenate([x[:-1], x]), np.concatenate([u[:-1], u]))


def test_short_holes_are_filled_and_long_ones_split() -> None:
    t, x, u = flight(10.0)
    x[0], x[100, 3], x[500:560, :3], u[700, 2] = np.nan, np.nan, np.nan, np.nan
    data = one(t, x, u)
    assert kinds(data) == ["missing_values", "missing_rows", "time_gap"]
    assert data[0].segments == ((0, 499), (499, 940))
    assert data[0].u[639, 2] == data[0].u[638, 2]
    x[:, 4] = np.nan
    with pytest.raises(DataError, match="'v_y' has no value"):
        one(t, x, u)


def test_sign_flips_are_undone_also_across_holes() -> None:
    t, x, u = flight(5.0)
    bad = x.copy()
    bad[100:300, 6:10] *= -1
    bad[299] = np.nan
    data = one(t, bad, u)
    assert "sign_flip" in kinds(data)
    np.testing.assert_allclose(np.delete(data[0].x, 299, 0), np.delete(x, 299, 0), atol=1e-12)
    np.testing.assert_allclose(data[0].x[299], x[299], atol=1e-3)


def test_norms_a_little_off_are_mended_and_far_off_refused() -> None:
    t, x, u = flight(5.0)
    x[:, 6:10] *= 1.01
    data = one(t, x, u)
    assert kinds(data) == ["quaternion_norm"]
    np.testing.assert_allclose(np.linalg.norm(data[0].x[:, 6:10], axis=1), 1.0, atol=1e-12)
    x[30:, 6:10] *= 45
    with pytest.raises(DataError, match=r"'a' row 30: the quaternion .*Perhaps the columns hold degrees"):
        one(t, x, u)


@pytest.mark.parametrize(("seed", "lost"), [(0, 30), (1, 60), (2, 30)])
def test_a_gap_without_a_trace_in_the_clock_is_found_in_noise(seed: int, lost: int) -> None:
    t, x, u = flight(40.0, seed=seed)
    keep = np.r_[0:1500, 1500 + lost : 4001]
    data = one(t[: len(keep)], noisy(x[keep], 1e-3, seed), u[keep])
    assert data[0].segments == ((0, 1500), (1500, len(keep)))
    (finding,) = [f for f in data.summary.findings if f.kind == "hidden_gap"]
    assert finding.values["rows"] == [1499]


@pytest.mark.parametrize("scale", [0.93, 1.05])
def test_a_wrong_clock_is_measured_within_its_error(scale: float) -> None:
    raw = []
    for seed in range(2):
        t, x, u = flight(60.0, seed=seed, clock=scale)
        raw.append(RawRun(f"{seed}", t, noisy(x, 0.01, seed), u))
    data = assemble(raw, HEXACOPTER, kind="test", clock="rescale")
    assert data.clock_scale == pytest.approx(scale, abs=0.005)
    assert data.dt == pytest.approx(0.01)


def test_a_velocity_that_alone_disagrees_is_reported_and_not_scaled() -> None:
    t, x, u = flight(60.0)
    x[:, 3:6] *= 1.06
    data = one(t, x, u, clock="refuse")
    assert kinds(data) == ["kinematic_mismatch"]
    assert "read 6.0% too much (multiply them by 0.943" in data.summary.findings[0].message
    assert data.clock_scale == 1.0


def test_motor_commands_outside_zero_to_one_are_refused_with_a_guess() -> None:
    t, x, u = flight(3.0)
    with pytest.raises(DataError, match=r"'u_1' runs from .* pulse widths"):
        one(t, x, 1000 + 1000 * u)
    with pytest.raises(DataError, match="percent"):
        one(t, x, 100 * u)


def test_wrapped_angles_become_continuous() -> None:
    t = 0.02 * np.arange(600)
    x = np.stack([np.sin(t), np.cos(t), (2 * t + np.pi) % (2 * np.pi) - np.pi, np.full(600, 2.0)], axis=1)
    data = assemble([RawRun("a", t, x, np.sin(5 * t)[:, None])], CARTPOLE, kind="test")
    assert kinds(data) == ["angle_wrap", "constant_state"]  # it turns steadily
    np.testing.assert_allclose(data[0].x[:, 2], 2 * t, atol=1e-9)


def test_constant_and_dependent_inputs_are_named_with_their_directions() -> None:
    t, x, u = flight(5.0)
    u[:, 5] = u[:, 0] + u[:, 1] - u[:, 2]
    u[:, 3] = 0.3
    data = one(t, x, u.astype(np.float32).astype(float))
    assert kinds(data) == ["constant_input", "rank_deficient_inputs"]
    rank = data.summary.input_rank
    assert rank.rank == 5
    np.testing.assert_allclose(np.abs(rank.null_directions[0]), [0.5, 0.5, 0.5, 0, 0, 0.5], atol=1e-4)


def test_runs_on_other_steps_are_brought_to_one() -> None:
    raw = [RawRun(f"{k}", *flight(6.0, dt=dt, seed=k)) for k, dt in enumerate([0.01, 0.01, 0.02])]
    data = assemble(raw, HEXACOPTER, kind="test")
    assert [run.dt for run in data] == pytest.approx([0.01] * 3)
    half = assemble([RawRun("a", *flight(6.0))], HEXACOPTER, kind="test", dt=0.02)
    assert half[0].dt == pytest.approx(0.02)


def test_a_velocity_of_another_run_is_refused_by_name() -> None:
    for rolled in (False, True):
        runs = []
        for k in range(3):
            t, x, u = flight(30.0)
            if rolled and k == 1:
                x[:, 4] = np.roll(x[:, 4], 700) / 1.2
            x[:, :6] *= 1.0 + 0.2 * k
            runs.append(RawRun(f"run_{k}", t + 40.0 * k, x, u))
        if not rolled:
            assemble(runs, HEXACOPTER, kind="test")
    with pytest.raises(DataError, match="run 'run_1': 'p_y' and 'v_y' do not belong together"):
        assemble(runs, HEXACOPTER, kind="test")


@pytest.mark.parametrize(
    ("dt", "seconds", "rows"),
    [(0.001, 60.0, 5), (0.001, 8.0, 1), (0.002, 60.0, 2), (0.004, 60.0, 1), (0.01, 60.0, 1)],
)
def test_rows_of_a_long_log_that_are_closer_than_needed_become_one(
    dt: float, seconds: float, rows: int
) -> None:
    data = no_finer(one(*flight(seconds * dt / 0.01, dt=dt), clock="trust"), HEXACOPTER)
    assert data.dt == pytest.approx(rows * dt)
    told = [f.values for f in data.summary.findings if f.kind == "short_step"]
    assert told == ([] if rows == 1 else [{"step_s": pytest.approx(dt), "rows": rows}])


# ---- conventions -------------------------------------------------------------------------------------------

ROLLED, NED = [7, 8, 9, 6], [1.0, 1.0, -1.0]


@pytest.mark.parametrize(
    ("columns", "spoil", "remedy"),
    [
        (slice(6, 10), lambda x: x[:, ROLLED], "w x y z, body to world.*scalar last"),
        (slice(6, 10), lambda x: conjugate(x[:, 6:10]), "turns the world into the body"),
        (slice(6, 10), lambda x: conjugate(x[:, 6:10])[:, [1, 2, 3, 0]], "scalar last .* and it turns the world into"),
        (slice(3, 6), lambda x: rotate(conjugate(x[:, 6:10]), x[:, 3:6]),
         "velocities in m/s along the axes of the positions .* along the body's axes"),
        (slice(3, 6), lambda x: x[:, [4, 3, 5]], "the columns v_y v_x v_z are v_x v_y v_z"),
        (slice(3, 6), lambda x: x[:, [4, 3, 5]] * NED, "they are NED and the positions ENU"),
        (slice(10, 13), lambda x: x[:, 10:] * 180 / np.pi, "deg/s|degrees"),
        (slice(4, 5), lambda x: -x[:, 4:5], "opposite sign"),
        (slice(0, 3), lambda x: 1000.0 * x[:, :3], "mm or ms"),
    ],
)  # fmt: skip
def test_another_convention_or_unit_is_refused_with_the_way_to_write_it(
    columns: slice, spoil: Callable[[np.ndarray], np.ndarray], remedy: str
) -> None:
    t, x, u = flight(30.0)
    x[:, columns] = spoil(x)
    with pytest.raises(DataError, match=remedy):
        one(t, x, u)


def test_a_sound_flight_passes_whatever_its_noise_and_one_too_short_to_judge_does() -> None:
    for noise in (0.0, 0.02, 0.3):
        t, x, u = flight(30.0)
        x[:, :6] += noise * np.random.default_rng(0).normal(size=(len(t), 6))
        assert len(one(t, x, u)) == 1
    t, x, u = flight(4.0)
    x[:, 3:6] = rotate(conjugate(x[:, 6:10]), x[:, 3:6])
    assert len(one(t, x, u)) == 1


# ---- the clock, where rows are few for the motion ----------------------------------------------------------


def test_a_velocity_of_another_scale_in_one_run_is_named_and_sound_runs_are_not() -> None:
    for scale in (1.0, 1.05):
        made = [(t, noisy(x, 0.005, k), u) for k in range(3) for t, x, u in [flight(30.0, seed=k)]]
        made[1][1][:, 4] *= scale
        raw = [RawRun(f"run_{k}", *arrays) for k, arrays in enumerate(made)]
        data = assemble(raw, HEXACOPTER, kind="test")
        odd = [f for f in data.summary.findings if f.kind == "odd_scale"]
        assert [f.run for f in odd] == (["run_1"] if scale > 1.0 else [])
    assert odd[0].message.startswith("p_y changes 0.95")
    assert "v_y" in odd[0].message


@pytest.mark.parametrize("wrong", [True, False])
def test_times_that_jitter_are_taken_for_even_where_the_rows_are(wrong: bool) -> None:
    """A clock that notes when a row arrived, and a sensor that measures when it likes, log the same times."""
    rng, dt, mean = np.random.default_rng(2), 0.02, 0.02 * np.arange(600)
    times = mean + np.r_[0.0, rng.uniform(-0.003, 0.003, 598), 0.0]

    def states(t: np.ndarray) -> np.ndarray:
        return np.stack((np.sin(3.0 * t), 3.0 * np.cos(3.0 * t)), 1)

    x = states(mean if wrong else times) + rng.normal(size=(600, 2)) * [0.0005, 0.005]
    system = make_system("mass_spring_damper")
    data = assemble([RawRun("a", times, x, np.zeros((600, 1)))], system, kind="test")
    assert kinds(data)[:1] == ["jittered_times" if wrong else "non_uniform_step"]
    assert data.dt == pytest.approx(dt, rel=1e-3)
    # a row that was measured 3 ms later differs by 27 mm/s
    assert np.abs(data[0].x[5:-5] - states(data[0].t[5:-5])).max() < (0.03 if wrong else 0.06)
