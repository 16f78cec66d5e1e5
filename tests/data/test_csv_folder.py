"""CSV data sets: read back as written, and every fault of a file named by file, line and column."""

import math
from pathlib import Path

import numpy as np
import pytest

from nsde_torch.data import RawRun, write_csv
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording import assemble, read
from tests.helpers.data_systems import CARTPOLE, HEXACOPTER, MSD, multirotor
from tests.helpers.flights import flight

HEADER = "t,q,q_dot,force"
ROWS = [f"{0.01 * k:.2f},{math.sin(0.01 * k)!r},{math.cos(0.01 * k)!r},{k % 3}" for k in range(60)]


def folder(tmp_path: Path, text: str, name: str = "run.csv") -> str:
    (tmp_path / name).write_text(text, encoding="utf-8")
    return str(tmp_path)


def lines(header: str = HEADER, rows: list[str] = ROWS) -> str:
    return "\n".join([header, *rows]) + "\n"


def test_writing_and_reading_gives_the_same_numbers_and_extra_channels(tmp_path: Path) -> None:
    raw = []
    for seed in (0, 1):
        t, x, u = flight(12.0, seed=seed)
        raw.append(RawRun(f"flight_{seed}", t + 1000.0, x, u, extra={"battery_voltage": 16 - 0.01 * t}))
    data = assemble(raw, HEXACOPTER, kind="test")
    files = write_csv(data, tmp_path / "new" / "set")
    assert [f.name for f in files] == ["flight_0.csv", "flight_1.csv"]
    again = read("csv", HEXACOPTER, path=str(tmp_path / "new" / "set"))
    assert again.fingerprint == data.fingerprint
    np.testing.assert_array_equal(again[1].t, data[1].t)
    np.testing.assert_array_equal(again[1].extra["battery_voltage"], data[1].extra["battery_voltage"])


def test_channels_that_the_system_reads_follow_the_inputs(tmp_path: Path) -> None:
    t, x, u = flight(2.0)
    raw = [RawRun("a", t, x, u, extra={"battery_voltage": 16 - 0.01 * t, "wind": 0 * t})]
    system = multirotor("hexacopter", 6, exogenous=("battery_voltage",))
    data = assemble(raw, system, kind="test")
    assert data.input_names[-1] == "battery_voltage"
    np.testing.assert_array_equal(data[0].u[:, 6], 16 - 0.01 * t)
    write_csv(data, tmp_path)
    assert read("csv", system, path=str(tmp_path)).fingerprint == data.fingerprint


def test_an_absent_force_is_zero_for_the_mass_spring_damper_alone(tmp_path: Path) -> None:
    rows = [r.rsplit(",", 1)[0] for r in ROWS]
    assert not read("csv", MSD, path=folder(tmp_path, lines("t,q,q_dot", rows)))[0].u.any()
    with pytest.raises(DataError, match=r"columns \['x', 'x_dot', 'theta', 'theta_dot', 'force'\]"):
        read("csv", CARTPOLE, path=str(tmp_path))


def test_bom_spaces_crlf_quotes_and_any_column_order_are_read(tmp_path: Path) -> None:
    rows = [",".join(reversed(r.split(","))) for r in ROWS]
    text = "\ufeff" + lines('force, "q_dot" , q ,t', rows).replace("\n", "\r\n")
    (tmp_path / "run.csv").write_bytes(text.encode())
    np.testing.assert_allclose(read("csv", MSD, path=str(tmp_path))[0].x[5], [np.sin(0.05), np.cos(0.05)])


@pytest.mark.parametrize("cell", ["", "nan", "N/A", "NA", "null", "-"])
def test_cells_that_say_nothing_are_missing_values(tmp_path: Path, cell: str) -> None:
    rows = list(ROWS)
    rows[20], rows[40] = f"0.20,{cell},1.0,0", f"0.40,{cell},{cell},0"
    data = read("csv", MSD, path=folder(tmp_path, lines(rows=rows)))
    assert data[0].x[20, 0] == pytest.approx(np.sin(0.2), abs=1e-4)
    assert data[0].x[40, 0] == pytest.approx(np.sin(0.4), abs=1e-4)
    assert [f.kind for f in data.summary.findings] == ["missing_values"]


def test_dates_are_times_and_words_of_further_columns_are_missing(tmp_path: Path) -> None:
    rows = [f"2026-11-28 13:59:59.{r[2:4]}0{r[4:]},manual" for r in ROWS]
    data = read("csv", MSD, path=folder(tmp_path, lines(HEADER + ",mode", rows)))
    assert data.dt == pytest.approx(0.01)
    assert len(data[0].t) == len(ROWS)
    assert [f.kind for f in data.summary.findings] == ["empty_channel"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (lines("t,q,qdot,force"), r"run.csv:1: the columns \['q_dot'\] .* is 'qdot' meant as 'q_dot'\?"),
        (lines("T,q,q_dot,force"), r"\['t'\].*is 'T' meant as 't'\?"),
        (lines("t,q,q,q_dot"), r"run.csv:1: the columns \['q'\] occur more than once"),
        (lines("t,q,,q_dot"), "column 3 of the header has no name"),
        (lines(HEADER.replace(",", ";"), [r.replace(",", ";") for r in ROWS]), "separated by semicolons"),
        (lines(rows=[*ROWS[:7], "0.07,abc,1,0", *ROWS[8:]]), r"run.csv:9: column 'q' holds 'abc'; expected"),
        (lines(rows=[*ROWS[:7], "0.07,1,1", *ROWS[8:]]), r"run.csv:9: the row has 3 cells, the header 4"),
        (lines(rows=[*ROWS[:7], "0.07,inf,1,0", *ROWS[8:]]), r"run.csv:9: column 'q' is infinite"),
        (lines(rows=[*ROWS[:7], "0.07,1,-1e151,0", *ROWS[8:]]), r"run.csv:9: 'q_dot' reads -1e\+151, which no sensor"),
        ("\n".join(ROWS), "first row holds numbers; expected a header row"),
        (HEADER + "\n", "has a header and no rows"),
        (lines(rows=ROWS[:1]), "has 1 row; a run needs at least two"),
        ("", "is empty"), ("\x00\x01\x02", "not text"),
        (lines(rows=["nan,1,2,3"] * 5), r"0 row\(s\) with a time"),
    ],
)  # fmt: skip
def test_a_faulty_file_is_refused_with_place_and_remedy(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read("csv", MSD, path=folder(tmp_path, text))


def test_a_step_far_below_that_of_the_data_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"`dt` must be at least 1/1000 of the data's step of 0.01 s"):
        read("csv", MSD, path=folder(tmp_path, lines()), dt=1e-9)


def test_paths_that_are_no_data_set_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"holds no .csv file \(it holds nothing\)"):
        read("csv", MSD, path=str(tmp_path))
    folder(tmp_path, lines())
    with pytest.raises(DataError, match="is a file; a CSV data set is a folder"):
        read("csv", MSD, path=str(tmp_path / "run.csv"))
    with pytest.raises(DataError, match="does not exist"):
        read("csv", MSD, path=str(tmp_path / "none"))
    with pytest.raises(ConfigError, match="`path` is empty"):
        read("csv", MSD, path="")


def test_unknown_kinds_and_options_list_the_choices(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"must be one of .*csv, .*published, .*ulog; got 'excel'"):
        read("excel", MSD, path=str(tmp_path))
    with pytest.raises(ConfigError, match="unexpected keyword argument 'speling'"):
        read("csv", MSD, path=str(tmp_path), speling=1)
    with pytest.raises(ConfigError, match="`clock` must be one of rescale, trust, refuse; got 'maybe'"):
        read("csv", MSD, path=folder(tmp_path, lines()), clock="maybe")
    with pytest.raises(ConfigError, match="`gap` must be longer than the step"):
        read("csv", MSD, path=str(tmp_path), gap=0.001)
