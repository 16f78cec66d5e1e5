"""`nsde track` from the command line to files."""

import csv
import json
from pathlib import Path

import pytest

from nsde_torch.cli.main import main
from tests.helpers.commands import Said

pytestmark = pytest.mark.usefixtures("elsewhere")


FAST = ("mpc.compile=off", "mpc.period=0.04", "mpc.iterations=2")


def test_a_flight_leaves_numbers_a_log_that_other_commands_read_and_figures(
    shown: Said,
) -> None:
    words = ["run=declared", "duration=0.8", "beside=[pid]", "animation=gif", "out_dir=out", *FAST]
    printed = shown("track", *words)
    assert "RMSE" in printed
    assert "solves: p50" in printed
    content = json.loads(Path("out/tracking.json").read_text())
    assert set(content["controllers"]) == {"MPC, declared physics", "PID cascade"}
    own = content["controllers"]["MPC, declared physics"]
    assert own["lost"] == 0
    assert 0.0 < own["rmse_m"] < 0.1
    assert own["solve_ms"]["p50"] > 0.0
    assert content["reference"]["speed"] == 3.4
    for name in ("tracking.png", "solve_times.png", "flight.gif"):
        assert Path(f"out/plots/{name}").is_file()
    with Path("out/log/flight_0.csv").open() as file:
        rows = list(csv.reader(file))
    assert rows[0][:4] == ["t", "p_x", "p_y", "p_z"]
    assert rows[0][-1] == "u_6"
    assert len(rows) == 82


@pytest.mark.slow
def test_many_machines_fly_in_one_batch_with_noise_of_their_own() -> None:
    words = ["run=declared", "duration=0.3", "machines=3", "at_once=3", "reference=hover", "out_dir=out"]
    assert main(["track", *words, *FAST]) == 0
    content = json.loads(Path("out/tracking.json").read_text())
    flights = content["controllers"]["MPC, declared physics"]["flights"]
    assert len({f["rmse_m"] for f in flights}) == 3
    assert len(list(Path("out/log").glob("*.csv"))) == 3


def test_a_folder_with_a_flight_is_not_written_over(refused: Said) -> None:
    Path("out").mkdir()
    Path("out/tracking.json").write_text("{}")
    assert "holds a flight already" in refused("track", "run=declared", "out_dir=out")
