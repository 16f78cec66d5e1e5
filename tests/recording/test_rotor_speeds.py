"""Rotor speeds as inputs: squares, glitches, ranges."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.data import RawRun
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording.faults import FAULTS
from nsde_torch.recording.noise import rotor_glitches, shares
from tests.helpers.data_systems import HEXACOPTER
from tests.helpers.flights import flight

MOST = 20_000.0


def speeds(seed: int) -> NDArray[np.float64]:
    """Speeds of a rotor behind its lag, in steps of 10 rpm, at 50 Hz in a log at 100 Hz (6000,)."""
    rng = np.random.default_rng(seed)
    share, out = 0.4, np.empty(6000)
    command = np.clip(0.4 + 0.1 * np.repeat(rng.standard_normal(600), 10), 0.05, 1)
    for k in range(6000):
        share += 0.25 * (command[k] - share)
        out[k] = share
    return 10 * np.round(0.1 * MOST * np.sqrt(out))[2 * (np.arange(6000) // 2)]


@pytest.mark.parametrize("seed", range(4))
def test_glitches_are_found_and_nothing_else_is(seed: int) -> None:
    clean = speeds(seed)
    assert not rotor_glitches(clean, MOST).any()
    rng = np.random.default_rng(seed + 100)
    rows = rng.choice(np.arange(10, 5990, 8), 40, replace=False)
    bad = clean.copy()
    bad[rows[:20]], bad[rows[20:]] = MOST * rng.uniform(3, 12, 20), 0.0
    assert set(np.flatnonzero(rotor_glitches(bad, MOST))) == set(rows.tolist())
    share, found = shares(bad, MOST, name="u_1", where="run 'a'")
    assert sorted(found) == sorted(rows.tolist())
    np.testing.assert_allclose(share, np.square(clean / MOST), atol=0.08)
    np.testing.assert_allclose(np.delete(share, rows), np.square(np.delete(clean, rows) / MOST))


def test_glitches_that_are_held_for_two_rows_are_found() -> None:
    clean = speeds(7)
    bad = clean.copy()
    bad[1000:1002], bad[2000:2002], bad[2002:2004] = 9 * MOST, 0.0, 4 * MOST
    assert np.flatnonzero(rotor_glitches(bad, MOST)).tolist() == [1000, 1001, *range(2000, 2004)]


def test_a_rotor_that_stops_is_no_glitch() -> None:
    clean = speeds(8)
    clean[3000:] = 0.0
    assert not rotor_glitches(clean, MOST).any()


def test_another_unit_is_refused() -> None:
    with pytest.raises(DataError, match=r"run 'a': rotor speed 'u_1' is at most .* in nine rows of ten"):
        shares(7 * speeds(0), MOST, name="u_1", where="run 'a'")
    with pytest.raises(DataError, match="electrical turns"):
        shares(0.02 * speeds(0), MOST, name="u_1", where="run 'a'")


def test_speeds_come_back_as_the_commands_they_were_made_of() -> None:
    t, x, u = flight(20.0)
    run = RawRun("a", t, x, u.copy())
    fault = FAULTS["rotor_speed"]
    fault.simulate(run, MOST, HEXACOPTER, dt=0.01, rng=np.random.default_rng(0))
    assert run.u.max() > 1000
    run.u[500, 2] = 10 * MOST
    fault.undo_raw(run, HEXACOPTER, {"u": MOST})
    np.testing.assert_allclose(np.delete(run.u, 500, axis=0), np.delete(u, 500, axis=0), atol=1e-9)
    (note,) = run.notes
    assert (note.kind, note.count, note.action) == ("input_glitch", 1, "interpolated")
    assert note.values["column"] == "u_3"
    with pytest.raises(ConfigError, match="'rpm' is no input of system 'hexacopter'"):
        fault.undo_raw(run, HEXACOPTER, {"rpm": MOST})
    with pytest.raises(ConfigError, match="must be a speed above 0"):
        fault.undo_raw(run, HEXACOPTER, {"u": 0.0})
