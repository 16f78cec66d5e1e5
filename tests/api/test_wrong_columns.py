"""Columns that hold something else: `read` and `inspect` name the same cause, and sound logs are not suspected."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import nsde_torch
from nsde_torch.api.inspecting import Inspection
from nsde_torch.data.system_info import changed
from nsde_torch.errors import DataError
from nsde_torch.systems import make_system
from tests.helpers.leaning import G, leaning_flight
from tests.helpers.log_writers import write_table

Array = NDArray[np.float64]
Columns = dict[str, Array]
SPRING, CART, QUAD = "mass_spring_damper", "cartpole", "quadrotor"
FLYING = [*(f"{n}_{a}" for n in "pv" for a in "xyz"), *(f"q_{a}" for a in "wxyz"), *(f"w_{a}" for a in "xyz")]
FLYING += [f"u_{k}" for k in range(1, 5)]


@lru_cache
def spring(*, stiffness: float = 4.0, size: float = 1.0, dt: float = 0.01, seed: int = 0) -> Columns:
    """A spring under a random force, by Euler steps of a tenth of the log's, with noise of its sensors."""
    rng = np.random.default_rng(seed)
    n = round(16.0 / dt)
    wide = round(0.4 / dt)
    force = size * np.convolve(rng.standard_normal(n + wide), np.ones(wide) / wide**0.5, "same")[:n]
    q, v = np.zeros(n), np.zeros(n)
    for k in range(n - 1):
        x, y = float(q[k]), float(v[k])
        for _ in range(10):
            y += 0.1 * dt * (force[k] - stiffness * x - 0.4 * y)
            x += 0.1 * dt * y
        q[k + 1], v[k + 1] = x, y
    noise = size * rng.standard_normal((2, n))
    return {"t": dt * np.arange(n), "q": q + 1e-3 * noise[0], "q_dot": v + 3e-3 * noise[1], "force": force}


@lru_cache
def cart() -> Columns:
    """A cart and its pole as two sums of sines, the pole upright."""
    rng = np.random.default_rng(3)
    t = 0.02 * np.arange(900)
    out = {"t": t}
    for name, size in (("x", 0.4), ("theta", 0.2)):
        f, phase = rng.uniform(1.0, 6.0, 4), rng.uniform(0, 6, 4)
        wave = np.outer(t, f) + phase
        out[name] = size * np.sin(wave).sum(1)
        out[f"{name}_dot"] = size * (f * np.cos(wave)).sum(1)
    noisy = {k: v + (0.0 if k == "t" else 2e-3) * rng.standard_normal(len(t)) for k, v in out.items()}
    return {**noisy, "force": rng.standard_normal(len(t))}


@lru_cache
def flight() -> Columns:
    """A quadrotor whose motors make the lean and the turning of a flight that was drawn first (PX4's numbers)."""
    run = leaning_flight(10.0)
    w = run.x[:, 10:13]
    turning = np.gradient(w, run.t, axis=0)
    rise = np.gradient(run.x[:, 3:6], run.t, axis=0) + np.array([0.0, 0.0, G])
    signs = np.array([[-1, 1, 1, -1], [-1, 1, -1, 1], [-1, -1, 1, 1]])
    u = 0.5 * np.linalg.norm(rise, axis=1)[:, None] / G + turning / [60.0, 60.0, 3.0] @ signs / 4
    sizes = np.repeat([1e-3, 5e-3, 5e-4, 5e-3], [3, 3, 4, 3])
    x = run.x + sizes * np.random.default_rng(5).standard_normal(run.x.shape)
    return {"t": run.t, **dict(zip(FLYING, np.column_stack([x, u]).T, strict=True))}


SOUND = {SPRING: spring, CART: cart, QUAD: flight}


def asked(
    folder: Path, columns: Columns, system: str, *, physics: bool = False, **options: str
) -> tuple[Inspection, str]:
    """What `inspect` finds, and what `read` refuses or finds."""
    write_table(folder / "run_0.csv", columns)
    found = nsde_torch.inspect(folder, system=system, physics=physics, **options)  # type: ignore[arg-type]
    try:
        kind = "csv" if found.native else "log"
        data = nsde_torch.read(folder, system=system, kind=kind, state_smoothing="keep")
    except DataError as error:
        return found, str(error)
    return found, "\n".join(str(finding) for finding in data.summary.findings)


def order(columns: Columns, a: str, b: str) -> Columns:
    """Columns whose names are exchanged."""
    return {**columns, a: columns[b], b: columns[a]}


@pytest.mark.parametrize("seconds", [1e-3, 1e-6])
@pytest.mark.parametrize("system", [SPRING, CART, QUAD])
def test_times_in_ms_or_us_are_named_as_that_and_not_as_a_unit_of_the_rate(
    tmp_path: Path, system: str, seconds: float
) -> None:
    sound = SOUND[system]()
    found, said = asked(tmp_path, {**sound, "t": sound["t"] / seconds}, system)
    unit = {1e-3: "ms", 1e-6: "us"}[seconds]
    (check,) = found.checks
    assert (check.name, check.passed) == ("time", False)
    assert f"in {unit} they agree" in check.text
    assert f"{{from: t, unit: {unit}}}" in found.doubts[0]
    assert check.text in said
    # and it is read like that through the mapping that is proposed
    proposed = nsde_torch.inspect(tmp_path, system=system, kind="table", physics=False)
    assert proposed.mapping is not None
    assert proposed.mapping.time.unit == unit


@pytest.mark.parametrize("system", [SPRING, CART, QUAD])
def test_times_that_count_rows_are_no_unit_of_a_rate(tmp_path: Path, system: str) -> None:
    sound = SOUND[system]()
    rate = 1.0 / float(np.median(np.diff(sound["t"])))
    found, said = asked(tmp_path, {**sound, "t": np.arange(len(sound["t"])) + 5.0}, system)
    (check,) = found.checks
    assert (check.name, check.passed) == ("time", False)
    assert check.text.startswith("the times count rows")
    assert check.text in said
    written = float(check.remedy.partition("{rate: ")[2].partition("}")[0])
    assert written == pytest.approx(rate, rel=0.01)


@pytest.mark.parametrize("clock", ["t", "time"])
def test_shuffled_rows_and_two_runs_in_one_file_are_not_in_the_order_of_time(
    tmp_path: Path, clock: str
) -> None:
    sound = spring()
    mixed = np.random.default_rng(1).permutation(len(sound["t"]))
    backwards = np.arange(len(mixed))[::-1]
    for rows in (mixed, np.tile(np.arange(400), 2), backwards):
        write_table(tmp_path / "run_0.csv", {clock if k == "t" else k: v[rows] for k, v in sound.items()})
        for ask in (nsde_torch.inspect, nsde_torch.read):
            given = {} if clock == "t" or ask is nsde_torch.inspect else {"kind": "log"}
            with pytest.raises(DataError, match=rf"`{clock}` goes back .* not in the order of time"):
                ask(tmp_path, system=SPRING, **given)  # type: ignore[operator]


@pytest.mark.parametrize(
    ("system", "names"),
    [
        (SPRING, ("q", "q_dot")), (SPRING, ("q_dot", "force")), (CART, ("x", "theta")), (CART, ("theta", "theta_dot")),
        (QUAD, ("p_y", "v_y")),
    ],
)  # fmt: skip
def test_columns_that_are_exchanged_are_named(tmp_path: Path, system: str, names: tuple[str, str]) -> None:
    sound = SOUND[system]()
    found, said = asked(tmp_path, order(sound, *names), system)
    words = f"{names[0]} and {names[1]} are exchanged"
    (failed,) = [check for check in found.checks if check.passed is False]
    assert words in failed.text
    assert words in said
    assert found.doubts[0].startswith(f"exchange the columns {names[0]} and {names[1]}")


@pytest.mark.parametrize("kind", [None, "table"])
def test_runs_that_are_too_short_to_judge_alone_are_judged_together(tmp_path: Path, kind: str | None) -> None:
    for name, columns in (("sound", cart()), ("exchanged", order(cart(), "theta", "theta_dot"))):
        for k in range(4):  # 4 s each
            rows = slice(200 * k, 200 * (k + 1))
            (tmp_path / name).mkdir(exist_ok=True)
            write_table(tmp_path / name / f"run_{k}.csv", {c: v[rows] for c, v in columns.items()})
    sound = nsde_torch.inspect(tmp_path / "sound", system=CART, kind=kind, physics=False)
    assert [check.passed for check in sound.checks] == [True, True]
    nsde_torch.read(tmp_path / "sound", system=CART, state_smoothing="keep")
    found = nsde_torch.inspect(tmp_path / "exchanged", system=CART, kind=kind, physics=False)
    assert found.doubts[0].startswith("exchange the columns theta and theta_dot")
    with pytest.raises(DataError, match=r"short runs together.*theta and theta_dot are exchanged"):
        nsde_torch.read(tmp_path / "exchanged", system=CART)


@pytest.mark.parametrize(
    ("system", "column", "factor", "words"),
    [
        (SPRING, "q_dot", -1.0, "q_dot has the opposite sign"),
        (SPRING, "q", 1e3, "q is in mm"),
        (SPRING, "q_dot", 1e2, "q_dot is in cm/s"),
        (CART, "theta_dot", 180 / np.pi, "theta_dot is in deg/s"),
        (CART, "theta", 180 / np.pi, "theta is in deg"),
        (SPRING, "q_dot", 9.55, "0.1047 times as fast as its rate says"),
        (SPRING, "q_dot", 0.0, "'q_dot' never changes"),
    ],
)
def test_units_and_signs_of_one_column_are_named_by_both(
    tmp_path: Path, system: str, column: str, factor: float, words: str
) -> None:
    sound = SOUND[system]()
    found, said = asked(tmp_path, {**sound, column: factor * sound[column]}, system, physics=True)
    assert any(words in check.text for check in found.checks if check.passed is False)
    assert words in said
    assert not found.usable


def turning(speed: float, noise: float) -> Columns:
    """A cart whose pole rests, or turns steadily."""
    t = cart()["t"]
    drawn = noise * np.random.default_rng(2).standard_normal((2, len(t)))
    return {**cart(), "theta": speed * t + drawn[0], "theta_dot": speed + drawn[1]}


def held() -> Columns:
    """A vehicle that is held still."""
    rng, sizes = np.random.default_rng(4), {"p": 1e-3, "v": 5e-3}
    return {k: sizes[k[0]] * rng.standard_normal(len(v)) if k[0] in "pv" else v for k, v in flight().items()}


def wrapped() -> Columns:
    """A pole whose angle goes on beyond half a turn, and is logged within it."""
    t = np.arange(0.0, 20.0, 0.02)
    theta = np.mod(5.0 * np.sin(1.5 * t) + np.pi, 2 * np.pi) - np.pi
    moving = {"t": t, "x": np.sin(t), "x_dot": np.cos(t), "force": np.sin(t)}
    return {**moving, "theta": theta, "theta_dot": 7.5 * np.cos(1.5 * t)}


INNOCENT: dict[str, tuple[str, Callable[[], Columns]]] = {
    "a small motion": (SPRING, lambda: spring(size=1e-4)),
    "a stiff spring": (SPRING, lambda: spring(stiffness=400.0, dt=0.002)),
    "a wide motion": (SPRING, lambda: spring(size=1e3, stiffness=0.5, dt=0.05)),
    "a slow log": (SPRING, lambda: spring(stiffness=1.0, dt=0.2)),
    "a cart": (CART, cart),
    "a flight": (QUAD, flight),
    "a pole that rests": (CART, lambda: turning(0.0, 0.0)),
    "a noisy pole that rests": (CART, lambda: turning(0.0, 2e-3)),
    "a pole that turns": (CART, lambda: turning(2.0, 0.0)),
    "a noisy pole that turns": (CART, lambda: turning(2.0, 2e-3)),
    "a vehicle that is held": (QUAD, held),
    "an angle that was wrapped": (CART, wrapped),
}
ACCUSATIONS = ("exchanged", "order of time", "apart as the times", "theta_dot leaves", "velocities leave")


@pytest.mark.parametrize("what", INNOCENT)
def test_what_is_sound_is_not_suspected(tmp_path: Path, what: str) -> None:
    system, made = INNOCENT[what]
    found, said = asked(tmp_path, made(), system)
    assert not [doubt for doubt in found.doubts if "never change" not in doubt]
    assert found.usable
    assert not any(word in said for word in ACCUSATIONS)
    assert ("wraps of the angle" in said) == ("wrapped" in what)


def test_frames_and_exchanged_motors_are_said_by_read_as_by_inspect(tmp_path: Path) -> None:
    sound = flight()
    assert asked(tmp_path, sound, QUAD, physics=True)[0].doubts == []
    found, said = asked(tmp_path, order(sound, "u_1", "u_3"), QUAD, physics=True)
    assert any("u_1 and u_3 exchanged" in check.text for check in found.checks)
    assert "u_1 and u_3 exchanged" in said
    turned = order(order(sound, "p_x", "p_y"), "v_x", "v_y") | {k: -sound[k] for k in ("p_z", "v_z")}
    found, said = asked(tmp_path, turned, QUAD)
    (failed,) = [check for check in found.checks if check.passed is False]
    assert "one of them is NED and the other ENU" in failed.text
    assert failed.text.rstrip(".") in said


@pytest.mark.parametrize(
    ("system", "wrong"),
    [
        (SPRING, lambda made: {"q": made["q"] + 5.0 * made["t"]}),
        (SPRING, lambda made: {"q": made["q_dot"]}),
        (QUAD, lambda made: {"v_x": made["v_y"], "v_y": -made["v_x"]}),
    ],
)
def test_what_inspect_doubts_is_reported_by_read_and_no_physics_beside_it(
    tmp_path: Path, system: str, wrong: Callable[[Columns], Columns]
) -> None:
    sound = SOUND[system]()
    found, said = asked(tmp_path, {**sound, **wrong(sound)}, system, physics=True)
    (doubt,) = [check for check in found.checks if check.doubts]
    assert doubt.passed is None
    assert doubt.text.rstrip(".") in said
    assert "declared physics leaves much less" not in said


@pytest.mark.parametrize("name", ["q_des", "q_ref", "target_q", "q_sp", "pos_d", "position_cmd"])
def test_a_setpoint_is_never_taken_for_a_state(tmp_path: Path, name: str) -> None:
    sound = spring()
    measured = {"t": sound["t"], name: 1.1 * sound["q"], "position": sound["q"], "velocity": sound["q_dot"]}
    found, _ = asked(tmp_path, {**measured, "force": sound["force"]}, SPRING)
    assert found.mapping is not None
    assert found.mapping.columns["q"].source == ("position",)
    assert found.open == []
    del measured["position"]
    found, _ = asked(tmp_path, {**measured, "force": sound["force"]}, SPRING)
    assert found.missing == [f"a column for q (columns that are called as setpoints are none: {name})"]


def test_the_one_angle_and_the_one_place_of_a_cart_are_found_beside_their_setpoints(tmp_path: Path) -> None:
    sound = cart()
    wrapped = np.remainder(sound["theta"] + np.pi, 2.0 * np.pi) - np.pi
    names = {"position": "x", "positionD": "x_dot", "angleD": "theta_dot", "force": "force"}
    columns = {"time": sound["t"], "angle": wrapped, **{new: sound[name] for new, name in names.items()}}
    still = np.repeat([0.0, 0.1], [10, len(wrapped) - 10])
    asked_for = {"angleTarget": still, "target_position": still, "Q_squared": np.square(sound["force"])}
    found, _ = asked(tmp_path, {**columns, **asked_for}, CART)
    assert found.mapping is not None
    assert found.missing == found.open == []
    sources = {name: entry.source for name, entry in found.mapping.columns.items()}
    told = {"x": "position", "x_dot": "positionD", "theta": "angle", "theta_dot": "angleD", "force": "force"}
    assert sources == {name: (column,) for name, column in told.items()}


@pytest.mark.parametrize(
    ("name", "low", "high", "expected"),
    [
        ("motor", 384.0, 1456.0, {"full": 1500.0}),
        ("u", 384.0, 1456.0, {"full": 1500.0, "low": None, "unit": None}),
        ("motor_rpm", 900.0, 2100.0, {"full": 2100.0, "unit": "rpm"}),
        ("omega", 820.0, 1456.0, {"full": 1500.0}),
        ("erpm", 4000.0, 41000.0, {"full": 41000.0}),
        ("pwm", 1050.0, 1900.0, {"low": 1000.0, "high": 2000.0, "unit": "us"}),
        ("motor", 3000.0, 60000.0, {"low": 0.0, "high": 65535.0}),
    ],
)
def test_speeds_of_rotors_are_no_pulses_and_the_proposal_is_read(
    tmp_path: Path, name: str, low: float, high: float, expected: dict[str, object]
) -> None:
    sound = flight()
    rng = np.random.default_rng(2)
    for k in range(2):  # of the second run a rotor is faster than any of the first
        drawn = low + (high - low) * rng.uniform(0, 0.9, (len(sound["t"]), 4))
        drawn[0], drawn[5 + k] = low, high - 1.0 * (k == 0)
        motors = {f"{name}_{j + 1}": drawn[:, j] for j in range(4)}
        rest = {key: v for key, v in sound.items() if not key.startswith("u_")}
        write_table(tmp_path / f"run_{k}.csv", {**rest, **motors})
    found = nsde_torch.inspect(tmp_path, system=QUAD, physics=False)
    assert found.mapping is not None
    entry = found.mapping.columns["u"]
    assert {key: getattr(entry, key) for key in expected} == expected
    assert found.usable
    if name == "u":  # what bears the names of commands is read through a mapping
        (tmp_path / "mapping.yaml").write_text(found.yaml, encoding="utf-8")
    columns = changed(make_system(QUAD))  # without its physics, which such motors do not move
    data = nsde_torch.read(tmp_path, system=columns, kind="log", state_smoothing="keep")
    assert len(data.runs) == 2


def test_rows_that_repeat_a_time_are_inspected(tmp_path: Path) -> None:
    write_table(tmp_path / "run.csv", {k: np.repeat(v, 2) for k, v in spring().items()})
    found = nsde_torch.inspect(tmp_path, system=SPRING)
    assert found.usable
    assert any("repeat a time" in note for note in found.notes)


def test_a_table_of_too_many_columns_is_refused_at_once(tmp_path: Path) -> None:
    names = ",".join(["t", "q", "q_dot", "force", *(f"c{k}" for k in range(10_000))])
    (tmp_path / "run.csv").write_text(f"{names}\n{'0,' * 10_003}0\n" * 2)
    for act in (nsde_torch.read, nsde_torch.inspect):
        with pytest.raises(DataError, match="10004 columns"):
            act(tmp_path, system=SPRING)
