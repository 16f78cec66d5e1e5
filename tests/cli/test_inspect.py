"""`nsde inspect`: from a log to a mapping to a model."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

import nsde_torch
from nsde_torch.cli.main import main
from nsde_torch.data.quaternion import attitude_to_enu, swap_body, swap_world
from tests.helpers import log_writers
from tests.helpers.commands import Said, own_machine
from tests.helpers.leaning import leaning_flight
from tests.helpers.ulog_bytes import write_ulog


@pytest.fixture(scope="module")
def springs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs of a spring with positions in millimetres, times in milliseconds and a reversed force."""
    folder = tmp_path_factory.mktemp("springs")
    made = nsde_torch.simulate("mass_spring_damper", durations=[12.0, 12.0], seed=0)
    for run in made.runs:
        scaled = {
            "time_ms": 1e3 * run.t,
            "position [mm]": 1e3 * run.x[:, 0],
            "speed [mm/s]": 1e3 * run.x[:, 1],
        }
        log_writers.write_table(folder / f"{run.name}.csv", {**scaled, "force": run.u[: len(run.t), 0]})
    return folder


@pytest.mark.slow
def test_from_a_folder_of_logs_to_a_model(springs: Path, tmp_path: Path, shown: Said) -> None:
    out = shown("inspect", str(springs), "system=mass_spring_damper")
    assert "position [mm]" in out
    assert f"wrote {springs / 'mapping.yaml'}" in out
    written = yaml.safe_load((springs / "mapping.yaml").read_text(encoding="utf-8"))
    assert written["columns"]["q"] == {"from": "position [mm]", "unit": "mm"}
    assert written["time"] == {"from": "time_ms", "unit": "ms"}
    assert "holds this mapping" in shown("inspect", str(springs), "system=mass_spring_damper")
    data = ["data=log", f"data.path={springs}"]
    trained = ["system=mass_spring_damper", "model=sysid", f"run_dir={tmp_path / 'run'}"]
    assert main(["train", *trained, *data]) == 0
    truth = nsde_torch.simulate("mass_spring_damper", durations=[12.0, 12.0], seed=0)
    read = nsde_torch.read(springs, system="mass_spring_damper", kind="log")
    assert np.abs(read.runs[0].x - truth.runs[0].x).max() < 1e-9


def test_what_was_found_is_written_as_json_for_a_program(
    springs: Path, tmp_path: Path, refused: Said
) -> None:
    words = [str(springs), "system=mass_spring_damper", "physics=false", "out=none"]
    assert main(["inspect", *words, f"json={tmp_path / 'found.json'}"]) == 0
    found = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    assert (found["usable"], found["system"], len(found["runs"])) == (True, "mass_spring_damper", 2)
    assert yaml.safe_load(found["mapping"])["columns"]["q"] == {"from": "position [mm]", "unit": "mm"}
    assert {row["column"]: row["rows"] for row in found["columns"]}["force"] == 1201
    assert all(check["passed"] for check in found["checks"])
    assert "`json`" in refused("inspect", *words, f"json={tmp_path / 'no' / 'found.json'}")


def test_a_quadrotor_is_recognised_and_its_mapping_checked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], shown: Said
) -> None:
    columns = log_writers.ned_columns(leaning_flight(20.0))
    log_writers.write_table(tmp_path / "run.csv", columns)
    out = shown("inspect", str(tmp_path), "physics=false", f"out={tmp_path / 'm.yaml'}")
    assert "taken for 'quadrotor'" in out
    assert "axes are NED and FRD" in out
    assert f"data.mapping={tmp_path / 'm.yaml'}" in out
    written = yaml.safe_load((tmp_path / "m.yaml").read_text(encoding="utf-8"))
    assert written["frames"] == {"world": "NED", "body": "FRD"}
    assert written["columns"]["w"]["unit"] == "deg/s"
    assert written["columns"]["q"]["order"] == "xyzw"
    wrong = (tmp_path / "m.yaml").read_text(encoding="utf-8").replace("order: xyzw", "order: wxyz")
    (tmp_path / "m.yaml").write_text(wrong, encoding="utf-8")
    assert main(["inspect", str(tmp_path), "system=quadrotor", f"mapping={tmp_path / 'm.yaml'}"]) == 1
    out = capsys.readouterr().out
    assert "NO  attitude and rates" in out
    assert "order: xyzw" in out
    assert "nsde train" not in out


@pytest.mark.slow
def test_the_numbers_of_motors_are_found_by_the_physics(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], shown: Said
) -> None:
    made = nsde_torch.simulate("quadrotor", durations=[8.0], seed=3)
    log_writers.write_table(tmp_path / "run.npz", log_writers.ned_columns(made.runs[0]))
    assert "motors are numbered as in betaflight" in shown("inspect", str(tmp_path), "system=quadrotor")
    written = (tmp_path / "mapping.yaml").read_text(encoding="utf-8")
    assert "numbering: betaflight" in written
    wrong = written.replace("numbering: betaflight", "numbering: px4")
    (tmp_path / "wrong.yaml").write_text(wrong, encoding="utf-8")
    assert main(["inspect", str(tmp_path), "system=quadrotor", f"mapping={tmp_path / 'wrong.yaml'}"]) == 1
    out = capsys.readouterr().out
    assert "NO  numbering of the motors" in out
    assert "`numbering: betaflight`" in out


def test_what_csv_files_of_the_package_hold(tmp_path: Path, shown: Said) -> None:
    assert main(["simulate", "system=mass_spring_damper", f"out={tmp_path / 'd'}", "durations=[6,6]"]) == 0
    out = shown("inspect", str(tmp_path / "d"), "system=mass_spring_damper")
    assert "needs no mapping" in out
    assert not (tmp_path / "d" / "mapping.yaml").exists()


def test_a_px4_log_is_listed_and_read_by_its_own_reader(tmp_path: Path, shown: Said) -> None:
    run = leaning_flight(12.0)
    p, v, w = swap_world(run.x[:, :3]), swap_world(run.x[:, 3:6]), swap_body(run.x[:, 10:])
    one = np.ones(len(run.t))
    odometry = {"timestamp": 50.0 + run.t, "position": p, "q": attitude_to_enu(run.x[:, 6:10]), "velocity": v}
    odometry |= {"angular_velocity": w, "pose_frame": one, "velocity_frame": one}
    motors = {"timestamp": 50.0 + run.t, "control": run.u}
    write_ulog(tmp_path / "flight.ulg", {"vehicle_odometry": odometry, "actuator_motors": motors})
    out = shown("inspect", str(tmp_path), "physics=false")
    assert "data=ulog, 1 run (flight)" in out
    assert "actuator_motors/control[0]" in out
    assert "ok  lean and acceleration" in out
    assert not (tmp_path / "mapping.yaml").exists()


def test_faults_of_the_user_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.npz").write_bytes(b"PK")
    for words, message in (
        (["nowhere"], "does not exist"),
        ([str(tmp_path / "x.npz")], "is not a readable .npz file"),
        ([str(tmp_path), "sistem=quadrotor"], "Did you mean `system`"),
        ([str(tmp_path), "system=quadrotr"], "Did you mean `system=quadrotor`"),
        ([str(tmp_path), "system=quadrotr:Quad"], "no module 'quadrotr'"),
        ([str(tmp_path), "physics=maybe"], "must be true or false"),
        ([str(tmp_path), "kind=os:system"], "`kind` must be csv | ulog"),
        ([str(tmp_path), "nowhere"], "one log or folder at a time"),
        ([str(tmp_path), "kind=ulog"], "holds no file of the kind 'ulog' (.ulg)"),
        ([], "name a log, `nsde inspect LOG`"),
    ):
        assert main(["inspect", *words]) == 2
        said = capsys.readouterr()
        assert message in said.err + said.out
        assert "Traceback" not in said.err


def test_the_mapping_beside_the_logs_is_checked_as_reading_takes_it(
    springs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Said, shown: Said
) -> None:
    logs = tmp_path / "logs"
    shutil.copytree(springs, logs, ignore=shutil.ignore_patterns("mapping.yaml"))
    words = ["inspect", str(logs), "system=mass_spring_damper", "physics=false"]
    (logs / "mapping.yaml").write_text("columns: [\n")
    assert "mapping.yaml, line 2: no plain YAML" in refused(*words)
    exchanged = "{q: {from: 'speed [mm/s]', unit: mm}, q_dot: {from: 'position [mm]', unit: mm/s}}"
    (logs / "mapping.yaml").write_text(f"time: {{from: time_ms, unit: ms}}\ncolumns: {exchanged}\n")
    assert main(words) == 1
    assert "next: mend this first" in capsys.readouterr().out
    assert f"wrote {logs / 'mapping.yaml'}" in shown(*words, "overwrite=true")
    assert "is there and was not replaced" in shown(*words, f"out={logs / 'run_0.csv'}")


def test_a_folder_of_ones_own_machines_stays_in_the_command_that_comes_next(
    springs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], shown: Said, refused: Said
) -> None:
    own, logs = tmp_path / "own", tmp_path / "logs"
    own_machine(own, "name: nsde_torch.systems.one_dof:MassSpringDamper\n")
    words = ["system=mine", "physics=false", "out=none"]
    for where in ([f"--config-dir={own}", str(springs)], [str(springs), "--config-dir", str(own)]):
        assert f"next: nsde train --config-dir {own} system=mine data=" in shown("inspect", *where, *words)
    logs.mkdir()
    log_writers.write_table(logs / "a.csv", {"t": np.arange(50) / 10, "x_des": np.sin(np.arange(50))})
    assert main(["inspect", f"--config-dir={own}", str(logs), *words]) == 1
    out = capsys.readouterr().out
    assert "missing: a column for q (columns that are called as setpoints are none: x_des)" in out
    assert f"then nsde inspect {logs} --config-dir {own} system=mine mapping=FILE" in out
    assert "no such folder" in refused("inspect", str(logs), "--config-dir", str(tmp_path / "nowhere"))


def test_options_of_the_machine_are_those_of_training(tmp_path: Path, refused: Said, shown: Said) -> None:
    run = leaning_flight(12.0)
    columns = {f"x{k}": v for k, v in enumerate(np.column_stack([run.x, run.u]).T)}
    log_writers.write_table(tmp_path / "flight.csv", {"t": run.t, **columns})
    places = {"p": range(3), "v": range(3, 6), "q": range(6, 10), "w": range(10, 13), "u": range(13, 17)}
    content = {name: {"from": [f"x{k}" for k in ks]} for name, ks in places.items()}
    (tmp_path / "mapping.yaml").write_text(yaml.safe_dump({"system": "quadrotor", "columns": content}))
    words = ["inspect", str(tmp_path), "system=quadrotor", "physics=false"]
    assert "system=quadrotor system.options.yaw_direction=-1 data=" in shown(
        *words, "system.options.yaw_direction=-1"
    )
    assert "`yaw_direction` must be 1 or -1" in refused(*words, "system.options.yaw_direction=2")
    assert "is not in Hydra's grammar" in refused(*words, "system.options.yaw_direction=[1")


def test_what_a_log_of_a_machine_holds_is_said_without_one(
    tmp_path: Path, refused: Said, shown: Said
) -> None:
    said = shown("inspect", "system=cartpole")
    assert "states  x [m], x_dot [m/s], theta [rad], theta_dot [rad/s]" in said
    assert "may be absent: x_dot, theta_dot" in said
    assert "theta is 0 where it stands upright" in said
    (row,) = (line.split() for line in said.splitlines() if line.startswith("half_length"))
    assert row[:3] == ["half_length", "0.5", "m"]
    assert "motors numbered as PX4 does" in shown("inspect", "system=hexacopter")
    assert "name a log, `nsde inspect LOG`, or a machine" in refused("inspect")
