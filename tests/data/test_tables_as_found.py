"""CSV data sets, and tables as people and programs write them; each fault is named by file, line and column."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

import nsde_torch
from nsde_torch.data import RawRun, write_csv
from nsde_torch.data.formats.table import open_table
from nsde_torch.data.mapping.reader import log_files
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording import assemble, read
from tests.helpers.data_systems import HEXACOPTER, MSD, multirotor
from tests.helpers.flights import flight
from tests.helpers.leaning import leaning_flight

T = np.arange(40) / 20.0
Q, V, F = np.sin(T), np.cos(T), np.sin(3.0 * T)
ROWS = [
    f"{t!r},{q!r},{v!r},{f!r}"
    for t, q, v, f in zip(T.tolist(), Q.tolist(), V.tolist(), F.tolist(), strict=True)
]
NAMES = "t,q,q_dot,force"


def _columns(path: Path) -> dict[str, np.ndarray]:
    (stream,) = open_table(path).streams
    return {"t": stream.t, **stream.fields}


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        ("before the header", ["# a pendulum, by hand", "#", NAMES, *ROWS]),
        ("the header itself", ["# by hand", f"# {NAMES}", *ROWS]),
        ("NumPy's header", ["# " + NAMES.replace(",", " "), *(row.replace(",", " ") for row in ROWS)]),
        ("between rows", [NAMES, "# s, rad, rad/s", *ROWS[:20], "# a pause, here", *ROWS[20:]]),
        ("decimal commas", [NAMES.replace(",", ";"), *(r.replace(",", ";").replace(".", ",") for r in ROWS)]),
    ],
)
def test_comments_and_decimal_commas(tmp_path: Path, name: str, lines: list[str]) -> None:
    (tmp_path / "run.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    read = _columns(tmp_path / "run.csv")
    assert list(read) == ["t", "q", "q_dot", "force"], name
    assert np.array_equal(np.column_stack(list(read.values())), np.column_stack([T, Q, V, F]))


def test_a_table_without_a_header_has_numbers_of_columns(tmp_path: Path) -> None:
    for k in range(2):  # whose first rows differ, and which are two runs nevertheless
        (tmp_path / f"run{k}.csv").write_text("# by hand\n" + "\n".join(ROWS[k:]) + "\n", encoding="utf-8")
    assert list(_columns(tmp_path / "run0.csv")) == ["t", "column_2", "column_3", "column_4"]
    found = nsde_torch.inspect(tmp_path, system="mass_spring_damper", physics=False)
    assert found.runs == ["run0", "run1"]
    assert found.usable
    assert "time: {from: column_1, unit: s}" in found.yaml
    assert "q_dot: {from: column_3}" in found.yaml
    assert "the table has no names" in found.open[0]
    (tmp_path / "mapping.yaml").write_text(found.yaml, encoding="utf-8")
    run = nsde_torch.read(tmp_path, system="mass_spring_damper").runs[0]
    assert np.allclose(run.x, np.column_stack([Q, V]))


@pytest.mark.parametrize("zone", ["", "Z", "+02:00"])
def test_dates_are_seconds_since_1970(tmp_path: Path, zone: str) -> None:
    rows = [f"2026-11-28T14:00:0{t:.3f}{zone},{r.split(',', 1)[1]}" for t, r in zip(T, ROWS, strict=True)]
    text = "\n".join([NAMES.replace("t,", "stamp,", 1), *rows])
    (tmp_path / "run.csv").write_text(text + "\n", encoding="utf-8")
    (stream,) = open_table(tmp_path / "run.csv").streams
    began = 1795874400.0 - (7200.0 if zone == "+02:00" else 0.0)
    np.testing.assert_allclose(stream.t, began + T, rtol=0.0, atol=1e-6)
    assert np.array_equal(stream.fields["q"], Q)


def test_rows_of_a_clock_that_ticks_slower_are_spread_and_none_is_lost(tmp_path: Path) -> None:
    rows = [f"{np.floor(t * 5) / 5:.1f},{r.split(',', 1)[1]}" for t, r in zip(T, ROWS, strict=True)]
    (tmp_path / "run.csv").write_text("\n".join([NAMES, *rows]) + "\n", encoding="utf-8")
    log = open_table(tmp_path / "run.csv")
    (stream,) = log.streams
    np.testing.assert_allclose(np.diff(stream.t), 0.05, rtol=1e-2)
    assert np.array_equal(stream.fields["q"], Q)
    assert "40 rows have 10 times in 't'" in log.notes[0]


def test_words_in_a_column_of_numbers_are_missing(tmp_path: Path) -> None:
    cells = [[*row.split(","), "land" if k % 3 else "hover"] for k, row in enumerate(ROWS)]
    cells[3][1], cells[4][1], cells[30][2] = "NA", "n/a", "ERR"
    text = "\n".join([NAMES + ",mode", *map(",".join, cells)])
    (tmp_path / "run.csv").write_text(text + "\n", encoding="utf-8")
    log = open_table(tmp_path / "run.csv")
    fields = log.streams[0].fields
    assert list(fields) == ["q", "q_dot", "force"]
    assert np.flatnonzero(np.isnan(fields["q"])).tolist() == [3, 4]
    assert np.flatnonzero(np.isnan(fields["q_dot"])).tolist() == [30]
    assert log.notes == ["cells of 'q_dot' that are no number are missing: 1, the first 'ERR' in line 32"]
    found = nsde_torch.inspect(tmp_path, system="mass_spring_damper", physics=False)
    assert (found.kind, found.usable) == ("table", True)
    assert any("'q_dot' holds 'ERR'" in note for note in found.notes)
    (tmp_path / "mapping.yaml").write_text(found.yaml, encoding="utf-8")
    assert nsde_torch.read(tmp_path, system="mass_spring_damper").runs


@pytest.mark.parametrize(
    "cell", ['"[{0}, {1}]"', "[{0} {1}]", "[{0}, {1}]", '"array([{0}, {1}], dtype=float32)"', '"({0}; {1})"']
)
def test_lists_in_cells_are_columns(tmp_path: Path, cell: str) -> None:
    rows = [row.split(",") for row in ROWS]
    lines = ["t,state,force", *(f"{t},{cell.format(q, v)},{f}" for t, q, v, f in rows)]
    (tmp_path / "run.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    read = _columns(tmp_path / "run.csv")
    assert list(read) == ["t", "state[0]", "state[1]", "force"]
    assert np.array_equal(np.column_stack(list(read.values())), np.column_stack([T, Q, V, F]))


def _elements(*elements: dict[str, object]) -> np.ndarray:
    out = np.zeros((1, len(elements)), dtype=[(key, object) for key in elements[0]])
    for k, element in enumerate(elements):
        for key, value in element.items():
            out[0, k][key] = value
    return out


def _signal(label: str, values: np.ndarray) -> dict[str, object]:
    return {"values": values[:, None], "dimensions": 1.0, "label": label}


@pytest.mark.parametrize(
    "form", ["with time", "one each", "timeseries", "samples last", "logsout", "to file"]
)
def test_what_simulink_logs(tmp_path: Path, form: str) -> None:
    clock, named = T[:, None], {"q": Q, "q_dot": V, "force": F}
    series = {name: {"Time": clock, "Data": v[:, None], "Name": name} for name, v in named.items()}
    content: dict[str, object] = {
        "with time": {
            "out": {"time": clock, "signals": _elements(*(_signal(f"<{n}>", v) for n, v in named.items()))}
        },
        "one each": {name: {"time": clock, "signals": _signal("", v)} for name, v in named.items()},
        "timeseries": {"out": {"tout": clock, "logsout": series}},
        "samples last": {name: {"Time": clock, "Data": v[None, None, :]} for name, v in named.items()},
        "logsout": {"logsout": _elements(*({"Name": n, "Values": s} for n, s in series.items()))},
        "to file": {"ans": np.vstack([T, Q, V, F])},
    }[form]
    savemat(tmp_path / "out.mat", content)
    found = nsde_torch.inspect(tmp_path, system="mass_spring_damper", physics=False)
    assert found.usable, found.missing
    (tmp_path / "mapping.yaml").write_text(found.yaml, encoding="utf-8")
    run = nsde_torch.read(tmp_path, system="mass_spring_damper").runs[0]
    assert np.allclose(run.x, np.column_stack([Q, V]))
    assert np.allclose(run.u[:, 0], F)


def test_objects_of_matlab_are_refused_with_what_to_save(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    savemat(tmp_path / "out.mat", {"q": Q})
    monkeypatch.setattr("scipy.io.whosmat", lambda path: [("logsout", (1, 1), "opaque")])
    with pytest.raises(DataError, match=r"logsout.*Structure With Time"):
        open_table(tmp_path / "out.mat")


def test_runs_of_which_some_logged_more_are_no_streams_of_one_run(tmp_path: Path) -> None:
    (tmp_path / "run_1.csv").write_text("\n".join([NAMES, *ROWS]), encoding="utf-8")
    more = [f"{NAMES},q_des", *(f"{row},0.0" for row in ROWS)]
    (tmp_path / "run_2.csv").write_text("\n".join(more), encoding="utf-8")
    assert [file.name for file in log_files("table", tmp_path)] == ["run_1", "run_2"]
    (tmp_path / "run_2.csv").rename(tmp_path / "steps.csv")  # another experiment, in a word
    assert [file.name for file in log_files("table", tmp_path)] == ["run_1", "steps"]
    (tmp_path / "steps.csv").write_text("\n".join(["t,q_des", "0.0,0.0", "0.5,1.0"]), encoding="utf-8")
    assert [file.path for file in log_files("table", tmp_path)] == [tmp_path]


def test_an_array_among_others_has_its_clock_in_front_and_what_is_missing_is_left_blank(
    tmp_path: Path,
) -> None:
    savemat(tmp_path / "run.mat", {"gain": 2.0, "other": F, "data": np.column_stack([T, Q, V])})
    found = nsde_torch.inspect(tmp_path, system="mass_spring_damper", physics=False)
    assert "time: {from: 'data[0]', unit: s}" in found.yaml
    assert "q: {from: []}" in found.yaml
    assert not found.usable


def test_a_flight_in_a_table_without_names_is_found_by_what_holds_between_columns(tmp_path: Path) -> None:
    run = leaning_flight(12.0)
    x, u = run.x, run.u
    noise = np.random.default_rng(0).normal(size=(len(x), 3))
    columns = [run.t[:, None], noise, x[:, 10:13], x[:, [7, 8, 9, 6]], x[:, 3:6], x[:, :3], 30.0 * np.sqrt(u)]
    savemat(tmp_path / "flight.mat", {"flight": np.hstack(columns)})
    found = nsde_torch.inspect(tmp_path, system="quadrotor", physics=False)
    assert not found.missing
    assert "p: {from: [column_15, column_16, column_17]}" in found.yaml
    assert "v: {from: [column_12, column_13, column_14], axes: world}" in found.yaml
    assert "q: {from: [column_8, column_9, column_10, column_11], order: xyzw}" in found.yaml
    assert "w: {from: [column_5, column_6, column_7], unit: rad/s}" in found.yaml
    assert "u: {from: [column_18, column_19, column_20, column_21]" in found.yaml


HEADER = "t,q,q_dot,force"
GOOD = [f"{0.01 * k:.2f},{math.sin(0.01 * k)!r},{math.cos(0.01 * k)!r},{k % 3}" for k in range(60)]


def folder(tmp_path: Path, text: str, name: str = "run.csv") -> str:
    (tmp_path / name).write_text(text, encoding="utf-8")
    return str(tmp_path)


def lines(header: str = HEADER, rows: list[str] = GOOD) -> str:
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


def test_bom_spaces_crlf_quotes_and_any_column_order_are_read(tmp_path: Path) -> None:
    rows = [",".join(reversed(r.split(","))) for r in GOOD]
    text = "\ufeff" + lines('force, "q_dot" , q ,t', rows).replace("\n", "\r\n")
    (tmp_path / "run.csv").write_bytes(text.encode())
    np.testing.assert_allclose(read("csv", MSD, path=str(tmp_path))[0].x[5], [np.sin(0.05), np.cos(0.05)])


@pytest.mark.parametrize("cell", ["", "nan", "N/A", "NA", "null", "-"])
def test_cells_that_say_nothing_are_missing_values(tmp_path: Path, cell: str) -> None:
    rows = list(GOOD)
    rows[20], rows[40] = f"0.20,{cell},1.0,0", f"0.40,{cell},{cell},0"
    data = read("csv", MSD, path=folder(tmp_path, lines(rows=rows)))
    assert data[0].x[20, 0] == pytest.approx(np.sin(0.2), abs=1e-4)
    assert data[0].x[40, 0] == pytest.approx(np.sin(0.4), abs=1e-4)
    assert [f.kind for f in data.summary.findings] == ["missing_values"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (lines("t,q,qdot,force"), r"run.csv:1: the columns \['q_dot'\] .* is 'qdot' meant as 'q_dot'\?"),
        (lines("T,q,q_dot,force"), r"\['t'\].*is 'T' meant as 't'\?"),
        (lines("t,q,q,q_dot"), r"run.csv:1: the columns \['q'\] occur more than once"),
        (lines("t,q,,q_dot"), "column 3 of the header has no name"),
        (lines(HEADER.replace(",", ";"), [r.replace(",", ";") for r in GOOD]), "separated by semicolons"),
        (lines(rows=[*GOOD[:7], "0.07,abc,1,0", *GOOD[8:]]), r"run.csv:9: column 'q' holds 'abc'; expected"),
        (lines(rows=[*GOOD[:7], "0.07,1,1", *GOOD[8:]]), r"run.csv:9: the row has 3 cells, the header 4"),
        (lines(rows=[*GOOD[:7], "0.07,inf,1,0", *GOOD[8:]]), r"run.csv:9: column 'q' is infinite"),
        (lines(rows=[*GOOD[:7], "0.07,1,-1e151,0", *GOOD[8:]]), r"run.csv:9: 'q_dot' reads -1e\+151, which no sensor"),
        ("\n".join(GOOD), "first row holds numbers; expected a header row"),
        (HEADER + "\n", "has a header and no rows"),
        (lines(rows=GOOD[:1]), "has 1 row; a run needs at least two"),
        ("", "is empty"), ("\x00\x01\x02", "not text"),
        (lines(rows=["nan,1,2,3"] * 5), r"0 row\(s\) with a time"),
    ],
)  # fmt: skip
def test_a_faulty_file_is_refused_with_place_and_remedy(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read("csv", MSD, path=folder(tmp_path, text))


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


def test_unknown_kinds_and_options_list_the_choices_and_values_out_of_range_say_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"must be one of .*csv, .*published, .*ulog; got 'excel'"):
        read("excel", MSD, path=str(tmp_path))
    with pytest.raises(ConfigError, match="unexpected keyword argument 'speling'"):
        read("csv", MSD, path=str(tmp_path), speling=1)
    with pytest.raises(ConfigError, match="`clock` must be one of rescale, trust, refuse; got 'maybe'"):
        read("csv", MSD, path=folder(tmp_path, lines()), clock="maybe")
    with pytest.raises(ConfigError, match="`gap` must be longer than the step"):
        read("csv", MSD, path=str(tmp_path), gap=0.001)
    with pytest.raises(ConfigError, match=r"`dt` must be at least 1/1000 of the data's step of 0.01 s"):
        read("csv", MSD, path=str(tmp_path), dt=1e-9)


def test_tables_of_the_package_are_in_seconds_whatever_their_steps_look_like(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for k in range(2):
        rows = np.column_stack((2.0 * np.arange(200), rng.normal(size=(200, 3))))
        np.savetxt(tmp_path / f"run_{k}.csv", rows, delimiter=",", header="t,q,q_dot,force", comments="")
    found = nsde_torch.inspect(tmp_path, system="mass_spring_damper", kind="csv", physics=False)
    assert [row.rate for row in found.columns] == [0.5] * 3
