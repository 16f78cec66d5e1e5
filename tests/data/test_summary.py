"""The summary holds the figures of the data, as JSON and as a table."""

import json
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
import torch

from nsde_torch.data import RawRun, Windows
from nsde_torch.recording import assemble
from tests.helpers.data_systems import HEXACOPTER
from tests.helpers.flights import flight


def test_figures_json_and_table_say_the_same() -> None:
    t, x, u = flight(30.0, clock=1.05)
    keep = np.r_[0:1000, 1300:3001]
    raw = [RawRun("flight", t[keep], x[keep], u[keep], extra={"battery_voltage": 16 - t[keep]})]
    data = assemble(raw, HEXACOPTER, kind="test")
    found = json.loads(data.summary.to_json())
    assert found["rate_hz"] == pytest.approx(100)
    assert found["duration_s"] == pytest.approx(9.99 + 17.0)
    assert found["clock_scale"] == pytest.approx(1.05, abs=0.005)
    assert found["runs"][0]["segments"] == [[0, 1000], [1000, 2701]]
    channel = next(c for c in found["channels"] if c["name"] == "p_x")
    assert channel["minimum"] == pytest.approx(x[keep, 0].min())
    assert channel["q95"] == pytest.approx(np.quantile(x[keep, 0], 0.95))
    assert found["channels"][-1]["name"] == "battery_voltage"
    speed = np.linalg.norm(x[keep, 3:6], axis=1)
    assert found["envelope"]["speed_q95_m_per_s"] == pytest.approx(np.quantile(speed, 0.95))
    assert found["envelope"]["speed_max_m_per_s"] == pytest.approx(speed.max())
    assert [f["kind"] for f in found["findings"]] == ["time_gap", "clock"]
    text = str(data.summary)
    named = ("flight", "0-1000 1000-2701", "p_x", "|roll| [deg]", "inputs span 6 of 6", "clock runs wrong")
    assert all(part in text for part in named), text


def test_roll_pitch_yaw_are_those_of_the_attitude() -> None:
    t = 0.01 * np.arange(200)
    x = np.zeros((200, 13))
    half = np.radians(20) / 2
    x[:, 6:10] = np.cos(half), np.sin(half), 0, 0
    e = assemble([RawRun("a", t, x, np.full((200, 6), 0.4))], HEXACOPTER, kind="test").summary.envelope
    assert e is not None
    most = [e[f"{angle}_max_deg"] for angle in ("roll", "pitch", "yaw")]
    assert most == pytest.approx((20.0, 0.0, 0.0), abs=1e-9)


def test_reading_data_needs_no_torch() -> None:
    code = (
        "import sys, nsde_torch.data as d, nsde_torch.recording as r; r.read, d.split; "
        "assert 'torch' not in sys.modules; d.Windows"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_checking_and_windowing_take_at_most_four_times_the_data() -> None:
    n = 100_000
    t = 0.01 * np.arange(n)  # of ten hours at 100 Hz: 1.4 GiB
    x = np.zeros((n, 13))
    x[:, 0], x[:, 3], x[:, 6] = np.sin(t), np.cos(t), 1.0
    u = 0.4 + 0.1 * np.sin(np.outer(t, np.arange(1, 7)))
    size = t.nbytes + x.nbytes + u.nbytes
    raw = [RawRun("long", t, x, u)]
    tracemalloc.start()  # the raw arrays above are not counted: they come on top, once
    try:
        data = assemble(raw, HEXACOPTER, kind="test", clock="trust")
        windows = Windows(data.runs, 0.05, 20)
        train, _ = windows.held_out(0.15, 10.0, torch.Generator().manual_seed(0))
        train.batch(train.sample(512, torch.Generator().manual_seed(0)))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 3 * size
