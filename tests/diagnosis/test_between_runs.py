"""What differs between runs, or begins or drifts within one, is named with its moment and its sizes."""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import nsde_torch
from nsde_torch.data import DataSet
from nsde_torch.data.raw import RawRun
from nsde_torch.diagnosis.stages import MOVING_ROWS
from nsde_torch.diagnosis.text import lines
from nsde_torch.errors import ConfigError
from nsde_torch.systems import System
from tests.helpers.machines import Array, held, simulated
from tests.helpers.own_machines import STEP, Room, pushed_spring, warmed

HOME, SPRING = "double_pendulum:DoublePendulum", "mass_spring_damper"


@pytest.fixture(scope="module")
def folder(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(root / "examples" / "double_pendulum")
        maker = importlib.import_module("make_data")
        out = tmp_path_factory.mktemp("zeros")
        push = maker.friction(np.array([0.02, 0.01]), np.zeros(2))
        maker.write(out, push, seed=21, runs=4, seconds=8.0)
    return out


@pytest.fixture(autouse=True)
def _importable(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(root / "examples" / "double_pendulum")


def diagnosed(
    runs: DataSet | Sequence[RawRun], system: str | type[System] = SPRING, **options: Any
) -> dict[str, Any]:
    return dict(nsde_torch.diagnose(runs, system=system, say=False, **options).content())


def off(data: DataSet, column: int, by: Mapping[str, float]) -> DataSet:
    """Runs in some of which a state reads too much."""
    out = []
    for run in data.runs:
        x = run.x.copy()
        x[:, column] += by.get(run.name, 0.0)
        out.append(replace(run, x=x))
    return replace(data, runs=tuple(out))


def sizes(content: dict[str, Any], effect: str) -> dict[str, tuple[float, float, float]]:
    """Value and interval of an effect in each run."""
    own = [p for name, p in content["parameters"].items() if name.startswith(f"{effect}.")]
    return {p["run"]: (p["value"], *p["interval_90"]) for p in own}


@pytest.mark.slow
def test_a_load_of_a_run_has_its_share_where_all_parameters_are_over_the_inertia(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a share of the first run too, as of other effects, data showed none: all parameters scale with it."""
    monkeypatch.syspath_prepend(root / "examples" / "pendulum")
    runs = []
    for number, load in enumerate((1.0, 1.25, 0.9)):

        def rates(x: Array, u: Array, load: float = load) -> list[float]:
            return [x[1], (12.0 * u[0] - 9.0 * np.sin(x[0]) - 0.2 * x[1]) / load]

        rng = np.random.default_rng(number)
        pushes = held(rng, -0.8, 0.8, 1000, each=60)
        how = {"noise": (0.001, 0.005), "kick": (0.0, 0.05), "rng": rng}
        runs.append(simulated(number, rates, [0.3, 0.0], pushes, 0.01, **how))
    content = diagnosed(runs, "pendulum:Pendulum")
    assert content["added"] == ["run_inertia"]
    found = sizes(content, "run_inertia")
    for run, share in (("run_1", 0.2), ("run_2", 1.0 - 1.0 / 0.9)):
        _, low, high = found[run]
        assert low < share < high
        assert high - low < 0.02


@pytest.mark.slow
def test_a_zero_of_a_joint_that_differs_has_its_runs_and_the_option_that_takes_it_out(folder: Path) -> None:
    data = off(nsde_torch.read(folder, system=HOME), 1, {"run_1": 0.12, "run_3": -0.08})
    content = diagnosed(data, HOME, effects=["coulomb_friction[q1]", "coulomb_friction[q2]"])
    assert content["added"] == ["run_zero[q2]"]
    found = sizes(content, "run_zero[q2]")
    middle = found["run_2"][0]  # no stretch of run_0 is long enough without the rows at standstill
    assert found["run_1"][0] - middle == pytest.approx(0.12, abs=0.02)
    assert found["run_3"][0] - middle == pytest.approx(-0.08, abs=0.02)
    (finding,) = content["findings"]
    assert finding["take_out"].startswith("data.sensor_bias={run_")
    assert any("to take it out: data.sensor_bias" in line for line in lines(content))  # type: ignore[arg-type]


def test_a_reader_takes_out_what_one_run_reads_too_much(tmp_path: Path) -> None:
    nsde_torch.simulate(SPRING, durations=[4.0] * 2, seed=1).save(tmp_path)
    off = {"run_1": {"q": 0.12, "q_dot": 0.02}, "q_dot": 0.01}
    plain, data = (
        nsde_torch.read(tmp_path, system=SPRING),
        nsde_torch.read(tmp_path, system=SPRING, sensor_bias=off),
    )
    for before, after, taken in zip(plain.runs, data.runs, ((0.0, 0.01), (0.12, 0.03)), strict=True):
        # what holds in all runs, and what is said of this one
        assert np.allclose(before.x - after.x, taken)
    said = r"`sensor_bias` names 'run_9', which is no run; runs are run_0, run_1"
    with pytest.raises(ConfigError, match=said):
        nsde_torch.read(tmp_path, system=SPRING, sensor_bias={"run_9": {"q": 0.12}})


FEW = ("coulomb_friction", "quadratic_damping", "actuator_gain_drift", "constant_force")


@pytest.mark.slow
def test_a_gain_that_falls_at_moments_of_two_runs_is_no_drift() -> None:
    moments = (17.0, 12.5)
    runs = [
        pushed_spring(r, 30.0, lambda t, v, u, q, at=at: -0.25 * u * (t > at))
        for r, at in enumerate(moments)  # type: ignore[misc]
    ]
    content = diagnosed(runs, candidates=FEW)
    name = "run_difference[force_gain]"
    assert content["added"] == [name]
    assert not any(f["lead"] for f in content["findings"])
    for ((first, last),), moment in zip(content["data"]["moments"].values(), moments, strict=True):
        assert first - 0.1 <= moment <= last + 0.1
        assert last - first < 2.0
        assert f"between {first:.2f} and {last:.2f} s" in content["summary"]
    own = [p for key, p in content["parameters"].items() if key.startswith(name)]
    gain = content["declared_parameters"]["force_gain"]["value"]
    # the reference is one of the parts
    values = sorted([gain, *(gain + p["value"] for p in own)])
    assert values == pytest.approx([0.75, 0.75, 1.0, 1.0], abs=0.02)


def test_a_heater_that_becomes_weaker_in_one_run_is_no_noise() -> None:
    content = diagnosed(warmed(weaker=0.12), Room)
    assert content["added"] == ["run_difference[gain]"]
    ((first, last),) = content["data"]["moments"]["run_1"]
    assert first <= 1450.0 <= last
    own = [p for key, p in content["parameters"].items() if key.startswith("run_difference[gain]")]
    least = min(own, key=lambda p: p["value"])
    assert least["interval_90"][0] < -0.06 < least["interval_90"][1]


def test_a_friction_of_one_run_alone_is_one_thing_that_is_missing() -> None:
    runs = [
        pushed_spring(r, 15.0, lambda t, v, u, q, r=r: -0.3 * (r == 1) * np.tanh(v / 0.02))  # type: ignore[misc]
        for r in range(3)
    ]
    content = diagnosed(runs, candidates=("coulomb_friction", "quadratic_damping"))
    assert content["summary"] == "Missing: run_difference[coulomb_friction/size]."
    low, high = content["parameters"]["run_difference[coulomb_friction/size].change[0]"]["interval_90"]
    assert low < 0.3 < high


def test_a_gust_in_one_run_has_its_time_and_its_size() -> None:
    runs = [
        pushed_spring(r, 30.0, lambda t, v, u, q, r=r: 0.2 * (r == 1 and 11.0 < t < 18.0)) for r in range(3)
    ]  # type: ignore[misc]
    content = diagnosed(runs, candidates=FEW)
    assert content["added"] == ["run_force"]
    ((begin, end),) = content["data"]["moments"].values()
    assert begin[0] - 0.1 <= 11.0 <= begin[1] + 0.1
    assert end[0] - 0.1 <= 18.0 <= end[1] + 0.1
    text = f"between {begin[0]:.2f} and {begin[1]:.2f} s and between {end[0]:.2f} and {end[1]:.2f} s"
    assert text in content["summary"]
    sizes = {key: p["value"] for key, p in content["parameters"].items() if key.startswith("run_force")}
    assert max(sizes.values()) == pytest.approx(0.2, abs=0.02)
    assert sorted(map(abs, sizes.values()))[-2] < 0.02


@pytest.mark.slow
def test_an_oscillation_has_a_phase_of_its_own_in_each_run() -> None:
    phases = [0.3, 2.9, 5.1]
    runs = [
        pushed_spring(r, 25.0, lambda t, v, u, q, p=p: 0.2 * np.sin(2.0 * np.pi * 1.37 * t + p))  # type: ignore[misc]
        for r, p in enumerate(phases)
    ]
    content = diagnosed(runs, candidates=(*FEW, "hidden_mass", "periodic_force"))
    assert content["added"] == ["run_periodic_force"]
    assert not any(f["lead"] for f in content["findings"])
    found = content["parameters"]
    assert found["run_periodic_force.frequency"]["value"] == pytest.approx(1.37, abs=1e-3)
    waves = [found[f"run_periodic_force.waves[{k}]"] for k in range(6)]
    late = np.pi * 1.37 * STEP  # the simulator holds a push over a step
    expected = [0.2 * f(p - late) for f in (np.cos, np.sin) for p in phases]
    for wave, size in zip(waves, expected, strict=True):
        low, high = wave["interval_90"]
        assert 1.3 * low - 0.3 * high <= size <= 1.3 * high - 0.3 * low
        assert high - low < 0.03


@pytest.mark.slow
def test_what_swings_beside_a_wave_from_outside_is_no_load_for_sure() -> None:
    phases = [0.3, 2.9, 5.1]
    runs = [
        pushed_spring(r, 25.0, lambda t, v, u, q, p=p: 0.2 * np.sin(2.0 * np.pi * 1.37 * t + p))  # type: ignore[misc]
        for r, p in enumerate(phases)
    ]
    content = diagnosed(runs, candidates=["hidden_mass"])
    mass = next(f for f in content["findings"] if f["name"] == "hidden_mass")
    assert mass["lead_reason"].endswith("Hz is left, near its own: a force from outside may move both")


def test_what_is_no_candidate_differs_in_no_run() -> None:
    runs = [pushed_spring(r, 15.0, lambda t, v, u, q, r=r: 0.2 * (r == 1)) for r in range(3)]  # type: ignore[misc]
    content = diagnosed(runs, candidates=("coulomb_friction",))
    assert "run_force" not in content["added"]
    assert content["verdict"] == "unexplained"
    assert content["unexplained"][0]["sentence"] == "The rate of q_dot is off by a constant, in run_1 only."


def test_one_run_is_not_held_against_others() -> None:
    content = diagnosed([pushed_spring(5, 20.0, lambda t, v, u, q: 0.5)], candidates=["quadratic_damping"])
    # a steady force, of which that of each run alone is none of the candidates
    assert content["verdict"] == "unexplained"
    assert (content["added"], content["not_done"]) == ([], [])


def test_wind_that_comes_and_goes_is_no_gust() -> None:
    runs = []
    for r in range(3):
        white = np.random.default_rng(50 + r).normal(size=6300)
        wind = 0.2 * lfilter([(1.0 - 0.9975**2) ** 0.5], [1.0, -0.9975], white)  # lasts 2 s
        runs.append(pushed_spring(r, 30.0, lambda t, v, u, q, w=wind: w[int(200.0 * t)]))  # type: ignore[misc]
    content = diagnosed(runs, candidates=FEW)
    assert content["added"] == []
    assert content["data"]["moments"] == {}


def test_rows_in_which_it_moves_that_are_too_few_cost_no_selection() -> None:
    """A spring that is shaken at 1.4 and 2 Hz turns round after 27 rows at most, and a likelihood needs 32."""

    def shaken(t: Any) -> Any:
        return 3.0 * np.sin(9.0 * t) + 2.0 * np.sin(13.0 * t + 1.0)

    runs = []
    for seed in (1, 2):
        run = pushed_spring(seed, 20.0, lambda t, v, u, q: shaken(t) - u - 0.3 * np.tanh(v / 0.01))
        runs.append(RawRun(run.name, run.t[::2], run.x[::2], shaken(run.t[::2])[:, None]))
    content = diagnosed(runs, candidates=["coulomb_friction"])
    assert content["added"] == ["coulomb_friction"]
    (left,) = content["not_done"]
    assert left["stage"] == MOVING_ROWS
    assert "the longest 27 rows (0.54 s): let it move one way for longer at a time" in left["why"]


@pytest.mark.parametrize(
    ("push", "behind", "variable", "words"),
    [
        # of a stiffness of 4 that falls by 3 % a second
        (lambda t, v, u, q: 0.12 * t * q, 0.0, "q over time", "something drifts"),
        (lambda t, v, u, q: 0.0, 0.04, "force before", "something has a memory"),
        (lambda t, v, u, q: 0.0, 0.0, "", ""),
    ],
    ids=["stiffness falls", "filtered force", "a sound spring"],
)  # fmt: skip
@pytest.mark.slow
def test_it_is_said_and_told_apart(push: Any, behind: float, variable: str, words: str) -> None:
    runs = []
    for r in range(6):
        run = pushed_spring(r, 8.0, push)
        decay = STEP / (behind + STEP)
        logged = lfilter([decay], [1.0, decay - 1.0], run.u, axis=0)
        runs.append(replace(run, u=logged))
    content = diagnosed(runs, max_effects=0)
    assert content["verdict"] == ("unexplained" if words else "no_effect")
    if words:
        assert content["structure"]["after"][0]["variable"] == variable
        assert words in content["unexplained"][0]["sentence"]
