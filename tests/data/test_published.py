"""The authors' files: kinds told by shape, the repeated test flight left out, scales and angles converted."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from nsde_torch.data import Windows
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording import read
from tests.helpers.data_systems import CARTPOLE, HEXACOPTER, MSD, QUADROTOR
from tests.helpers.flights import flight

PUBLISHED = Path(__file__).resolve().parents[3] / "shared" / "data" / "published"
needs_files = pytest.mark.skipif(
    not PUBLISHED.is_dir(), reason="the published data are not beside the checkout"
)


def write(path: Path, content: object) -> str:
    path.write_bytes(pickle.dumps(content))
    return str(path)


def flights(motors: int) -> dict:
    pairs = [flight(4.0, motors=motors, seed=s)[1:] for s in range(3)]
    return {"train": pairs, "test": [(pairs[1][0].copy(), pairs[1][1].copy())]}


def test_the_test_entry_that_repeats_a_training_flight_is_no_further_run(tmp_path: Path) -> None:
    data = read("published", HEXACOPTER, path=write(tmp_path / "trajs.pkl", flights(6)))
    assert data.names == ("trajs_0", "trajs_1", "trajs_2")
    assert data.dt == pytest.approx(0.01)


def test_a_test_entry_of_its_own_is_a_run(tmp_path: Path) -> None:
    content = flights(4)
    content["test"] = [flight(4.0, motors=4, seed=9)[1:]]
    assert len(read("published", QUADROTOR, path=write(tmp_path / "trajs.pkl", content))) == 4


def test_cartpole_inputs_become_newtons_and_the_angle_is_unwrapped(tmp_path: Path) -> None:
    theta = np.linspace(3.0, 9.0, 101)
    y = np.stack([np.zeros(101), np.zeros(101), np.sin(theta), np.cos(theta), np.full(101, 3.0)], axis=1)
    path = write(tmp_path / "learned.pkl", [(y, np.linspace(-1, 1, 100)[:, None])])
    run = read("published", CARTPOLE, path=path)[0]
    np.testing.assert_allclose(run.x[:, 2], theta, atol=1e-12)
    assert (run.u[0, 0], run.u[-2, 0], run.u[-1, 0]) == (-25.0, 25.0, 25.0)
    assert run.dt == pytest.approx(0.02)


def test_the_wrong_system_is_named_with_what_the_file_holds(tmp_path: Path) -> None:
    path = write(tmp_path / "trajs.pkl", flights(6))
    with pytest.raises(DataError, match=r"holds hexacopter flights .* 'quadrotor' has 13 states, 4 inputs"):
        read("published", QUADROTOR, path=path)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ({"a": 1}, "expected the keys 'train' and 'test'"), (3.0, "expected a list"), ([], "holds no runs"),
        ([np.zeros(3)], "pairs"), ([(np.zeros((5, 7)), np.zeros((5, 1)))], "belong to no published file"),
        ([(np.zeros((5, 2)), np.zeros((3, 1)))], "has shapes"),
        ([(np.zeros((5, 2)), np.zeros((5, 1))), (np.zeros((5, 5)), np.zeros((5, 1)))], "mixes runs"),
    ],
)  # fmt: skip
def test_contents_of_no_known_kind_are_refused(tmp_path: Path, content: object, text: str) -> None:
    with pytest.raises(DataError, match=text):
        read("published", MSD, path=write(tmp_path / "file.pkl", content))


def test_a_step_that_is_not_positive_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="`dt` must be a positive"):
        read("published", HEXACOPTER, path=write(tmp_path / "trajs.pkl", flights(6)), dt=-0.01)


FLIGHTS = str(PUBLISHED / "hexacopter" / "trajs.pkl")


@needs_files
@pytest.mark.published
def test_published_hexacopter_flights_hide_two_gaps_and_a_slow_clock() -> None:
    data = read("published", HEXACOPTER, path=FLIGHTS)
    assert [run.segments for run in data] == [
        ((0, 4641), (4641, 6498)),
        ((0, 5871),),
        ((0, 3142), (3142, 5682)),
    ]
    assert 1.04 < data.clock_scale < 1.07
    assert all(1.03 < s.value < 1.09 for s in data.summary.slopes)
    assert data.summary.input_rank.rank == 4
    envelope = data.summary.envelope
    assert envelope is not None
    assert envelope.speed_q95 == pytest.approx(1.71, abs=0.1)
    kept = read("published", HEXACOPTER, path=FLIGHTS, clock="trust")
    assert kept.clock_scale == 1.0
    with pytest.raises(DataError, match="clock runs wrong"):
        read("published", HEXACOPTER, path=FLIGHTS, clock="refuse")


@needs_files
@pytest.mark.published
def test_evaluation_starts_are_those_of_the_reference_script() -> None:
    data = read("published", HEXACOPTER, path=FLIGHTS)
    for run in data:
        jump = np.flatnonzero(np.linalg.norm(np.diff(run.x[:, :3], axis=0), axis=1) > 0.05)
        expected = [i for i in range(0, len(run) - 200, 25) if not ((jump >= i) & (jump < i + 200)).any()]
        windows = Windows([run], 0.05, 40)
        assert [s for _, s in windows.locate(windows.starts(0.25))] == expected


@needs_files
@pytest.mark.published
@pytest.mark.parametrize(
    ("system", "file", "runs"),
    [
        (QUADROTOR, "iris/trajs.pkl", 3), (CARTPOLE, "cartpole/learned.pkl", 100),
        (CARTPOLE, "cartpole/random.pkl", 100),
        (MSD, "mass_spring_damper/MSD_MeasHigh_TopRight_5.pkl", 5),
        (MSD, "mass_spring_damper/MSD_TestData.pkl", 10),
    ],
)  # fmt: skip
def test_the_other_published_files_keep_their_clock(system: object, file: str, runs: int) -> None:
    data = read("published", system, path=str(PUBLISHED / file))  # type: ignore[arg-type]
    assert len(data) == runs
    assert data.clock_scale == 1.0
