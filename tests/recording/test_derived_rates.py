"""Rates that were made of positions are told from sensors, by name, and never the other way round."""

from pathlib import Path

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data.csv_folder import read_csv
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording import Recording, assemble
from nsde_torch.recording.unmeasured_rates import derived_rates
from nsde_torch.systems import make_system
from tests.helpers.encoders import encoder_runs

SPRING = make_system("mass_spring_damper")


@pytest.mark.parametrize("counts", [False, True])
@pytest.mark.parametrize(
    ("rate", "how"),
    [
        ("gradient", "the central difference of"),
        ("backward", "the backward difference of"),
        ("savgol", "a filter of the differences of"),
        ("butterworth", "a filter of the differences of"),
    ],
)
def test_a_rate_that_was_made_of_the_position_is_named_by_how(rate: str, how: str, counts: bool) -> None:
    found = derived_rates(SPRING, encoder_runs(rate, counts=counts))
    assert found == [("q_dot", "q", how)]


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3, 4))])
@pytest.mark.parametrize("noise", [1e-5, 1e-3, 1e-2])
def test_a_sensor_of_its_own_is_none(noise: float, seed: int) -> None:
    assert not derived_rates(SPRING, encoder_runs("sensor", noise=noise, seed=seed, runs=2))


def test_the_true_rate_of_a_simulation_is_none() -> None:
    made = nsde_torch.simulate("mass_spring_damper", durations=[10.0, 10.0], seed=1, sensor_noise=0.0)
    assert not derived_rates(SPRING, made.runs)
    for gust in (0.0, 0.02, 0.3):
        assert not derived_rates(SPRING, encoder_runs("truth", gust=gust, runs=2))


def test_the_data_set_says_so_infers_the_rate_and_keeps_the_position() -> None:
    raw = encoder_runs("backward")
    q, made = (np.concatenate([run.x[:, k] for run in raw]) for k in (0, 1))
    data = assemble(raw, SPRING, kind="test")
    (finding,) = [f for f in data.summary.findings if f.kind == "derived_rate"]
    assert "q_dot is the backward difference of q" in str(finding)
    assert all(0.0 < run.inferred["q_dot"] < 0.1 for run in data.runs)
    assert np.array_equal(np.concatenate([run.x[:, 0] for run in data.runs]), q)
    inferred = np.concatenate([run.x[:, 1] for run in data.runs])
    true = np.concatenate([run.x[:, 1] for run in encoder_runs("truth")])
    assert np.std(inferred - true) < 0.3 * np.std(made - true)


def test_what_a_user_wants_to_keep_is_kept_and_said() -> None:
    data = assemble(encoder_runs("gradient"), SPRING, kind="test", derived_rates="keep")
    assert not data.runs[0].inferred
    assert [f.action for f in data.summary.findings if f.kind == "derived_rate"] == ["reported"]
    with pytest.raises(ConfigError, match="derived_rates"):
        assemble(encoder_runs("gradient"), SPRING, kind="test", derived_rates="drop")


def _written(folder: Path, *, header: str, columns: tuple[int, ...], runs: int = 2) -> None:
    for run in encoder_runs("gradient", runs=runs):
        table = np.column_stack([run.t, run.x, run.u])[:, columns]
        np.savetxt(folder / f"{run.name}.csv", table, "%.9f", ",", header=header, comments="")


def test_a_file_may_lack_the_rate_of_a_position_that_it_has(tmp_path: Path) -> None:
    _written(tmp_path, header="t,q,force", columns=(0, 1, 3))
    data = nsde_torch.read(tmp_path, system="mass_spring_damper")
    assert all("q_dot" in run.inferred for run in data.runs)
    assert "no column q_dot: inferred from the positions" in str(data.summary)


@pytest.mark.parametrize(
    ("header", "columns"), [("t,q_dot,force", (0, 2, 3)), ("t,q,qdot,force", (0, 1, 2, 3))]
)
def test_a_lacking_position_or_another_spelling_is_refused(
    tmp_path: Path, header: str, columns: tuple[int, ...]
) -> None:
    _written(tmp_path, header=header, columns=columns)
    with pytest.raises(DataError, match="are missing"):
        read_csv(SPRING, path=tmp_path)


def test_a_rate_that_some_runs_have_is_refused() -> None:
    runs = [*encoder_runs("none", runs=1), *encoder_runs("sensor", runs=2)[1:]]
    with pytest.raises(DataError, match="no value of 'q_dot' and others have"):
        assemble(runs, SPRING, kind="test")


def test_what_a_recording_chain_derives_is_found() -> None:
    for rows, how in ((2, "backward"), (3, "central"), (11, "filter")):
        chain, rng = Recording(derived_rate=rows), np.random.default_rng(0)
        made = [chain.apply(run, SPRING, dt=0.01, rng=rng) for run in encoder_runs("sensor", runs=2)]
        (found,) = derived_rates(SPRING, made)
        assert how in found[2]
    with pytest.raises(ConfigError, match="odd number of rows"):
        Recording(derived_rate=4).check(SPRING)
