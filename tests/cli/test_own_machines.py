"""What a user with a machine of their own meets on the command line: one sentence with the remedy, or it works."""

import json
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from nsde_torch.cli.main import main
from nsde_torch.cli.quoted import coordinates_named
from tests.helpers.commands import Said

pytestmark = pytest.mark.usefixtures("elsewhere")


@pytest.fixture(scope="module")
def spring(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of the spring."""
    out = tmp_path_factory.mktemp("spring") / "run"
    words = ["train", "system=mass_spring_damper", "data.durations=[2,2]", "model=sysid", f"run_dir={out}"]
    assert main(words) == 0
    return out


@pytest.mark.slow
def test_a_controller_of_a_spring_is_exported_verified_and_holds_it(
    spring: Path, shown: Said, refused: Said
) -> None:
    assert "Take plant=own" in refused("export", f"run={spring}", "out=c.c")
    limits = ["plant=own", "mpc.low=-1", "mpc.high=1", "mpc.steps=8", "mpc.horizon=0.4"]
    assert "reference=setpoint" in shown("export", f"run={spring}", *limits, "format=c", "out=spring.c")
    given = ["verify", "controller=spring.c", f"run={spring}", "states=60", "adversarial=100"]
    assert "reference=setpoint" in refused(*given)
    assert "passed" in shown(*given, "reference=setpoint", "reference.states={q: 0.2}")
    held = ["track", "controller=spring.c", "reference=setpoint", "reference.states={q: 0.2}", "plant=own"]
    shown(*held, "reference.duration=2", "out_dir=held")
    assert "`mpc.low` is -2" in refused(*held, "reference.duration=2", "mpc.low=-2", "out_dir=no")


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("plant=own", "reference=lemniscate is a flight, and the machine is a mass_spring_damper"),
        ("plant=own reference=setpoint", "give mpc.low and mpc.high"),
        ("reference=setpoint", "Take plant=own"),
        ("plant=own reference=setpoint 'reference.states={x: 1}'", "no state 'x'; it has q, q_dot"),
        ("plant=own reference=setpoint 'start={x: 1}'", "no state 'x'"),
        ("plant=own reference=setpoint reference.states=[1]", "{name: value}"),
        ("plant=own reference=setpoint beside=[pid] mpc.low=-1 mpc.high=1", "flies multirotors"),
        ("plant=own reference=csv reference.path=none.csv", "none.csv"),
        ("plant=own reference=setpoint 'start={q: true}'", "`start` takes {state: value}"),
        ("plant=own reference=setpoint 'start={q: nan}'", "finite"),
        ("plant=own reference=setpoint mpc.low=1 mpc.high=1", "must lie below"),
        ("plant=own reference=setpoint duration=0.001", "shorter than"),
        ("plant=own reference=setpoint mpc.low=-1 mpc.high=1 plant.dt=0.1", "`mpc.period`"),
        (
            "plant=learned reference=setpoint mpc.low=-1 mpc.high=1 plant.effects=[coulomb_friction]",
            "the model itself",
        ),
    ],
)
def test_what_is_wrong_with_a_machine_or_its_reference_is_said(
    typed: str, said: str, spring: Path, refused: Said
) -> None:
    assert said in refused("track", f"run={spring}", *shlex.split(typed), "mpc.compile=off", "out_dir=out")


@pytest.mark.parametrize("command", ["track", "export", "fly"])
def test_a_model_of_ones_own_machine_is_found_without_the_folder_of_its_module(
    command: str, root: Path, spring: Path, tmp_path: Path, refused: Said
) -> None:
    run = tmp_path / "run"
    (run / ".hydra").mkdir(parents=True)
    source = {"provider": "command-line", "schema": "file", "path": str(tmp_path / "modules")}
    record = {"hydra": {"runtime": {"config_sources": [source]}}}
    (run / ".hydra" / "hydra.yaml").write_text(yaml.safe_dump(record))
    (tmp_path / "modules").mkdir()
    text = (root / "examples" / "extend" / "rail.py").read_text().replace('name = "rail"', 'name = "lane"')
    (tmp_path / "modules" / f"lane_of_{command}.py").write_text(text)
    for file in ("config.yaml", "model.safetensors", "metrics.json"):
        (run / file).write_bytes((spring / file).read_bytes())
    content = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(content.replace("mass_spring_damper", f"lane_of_{command}:Rail"))
    assert "no module" not in refused(
        command, f"run={run}", "out=c.ts" if command == "export" else "threads=1"
    )


@pytest.mark.slow
def test_the_command_that_a_diagnosis_advises_trains(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(root / "examples" / "extend")
    own = ["--config-dir", folder, "system.name=rail:Rail"]
    assert main(["simulate", *own, "durations=[6,6]", "out=data"]) == 0
    found = ["data=csv", f"data.path={tmp_path / 'data'}", "retrain=false", "out_dir=found"]
    assert main(["diagnose", *own, *found, "candidates=[coulomb_friction]"]) == 0
    first = Path("found/effects.yaml").read_text().splitlines()[0]
    words = shlex.split(first.partition("nsde train ")[2])
    assert words[:3] == own
    assert main(["train", *words, "model=sysid", "run_dir=trained"]) == 0
    assert "coulomb_friction.size" in Path("trained/metrics.json").read_text()


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("system.effects=[dry[q2],a:B[q1]]", r"system.effects=[dry\[q2\],a:B\[q1\]]"),
        ("plant.effects=[{c_d[q]:{size:1}}]", r"plant.effects=[{c_d\[q\]:{size:1}}]"),
        ("system.effects=['c[q2]']", "system.effects=['c[q2]']"),
        ("system.parameters.c[q2].size=1", "system.parameters.c.q2.size=1"),
        ("data.durations=[4,4]", "data.durations=[4,4]"),
        ("mpc.fence=[[0,1],[0,1],[0,1]]", "mpc.fence=[[0,1],[0,1],[0,1]]"),
        ("--config-dir", "--config-dir"),
    ],
)
def test_a_coordinate_in_brackets_is_written_as_hydra_wants_it(word: str, expected: str) -> None:
    assert coordinates_named(word) == expected


@pytest.fixture
def double(root: Path) -> list[str]:
    """How the double pendulum, whose class says no machine, is simulated."""
    return [
        "simulate", "--config-dir", str(root / "examples" / "double_pendulum"), "system=double_pendulum",
        "durations=[4,4]", "options.inputs=[0.4,0.05]", "options.noise=[0.001,0.001,0.01,0.01]",
    ]  # fmt: skip


@pytest.mark.slow
def test_a_machine_of_ones_own_is_simulated_from_its_class(double: list[str]) -> None:
    effects = "plant.effects=[{coulomb_friction[q2]:{size:0.05}}]"
    assert main([*double, effects, "plant.parameters.a=0.09", "plant.parameters.b=0.02", "out=data"]) == 0
    truth = json.loads(Path("data.truth.json").read_text())
    assert truth["effects"]["coulomb_friction[q2]"]["parameters"]["size"] == 0.05
    assert truth["effects"]["coulomb_friction[q2]"]["units"]["size"] == "N m"
    assert truth["declared"]["a"] == {"value": 0.09, "unit": "kg m2"}
    table = np.loadtxt("data/run_0.csv", delimiter=",", skiprows=1)
    assert Path("data/run_0.csv").read_text().startswith("t,q1,q2,q1_dot,q2_dot,tau1,tau2\n")
    assert len(table) == 401
    assert table[:, 5].std() == pytest.approx(0.4, rel=0.4)
    assert np.abs(table[:, 1]).max() > 0.02
    white = np.diff(table[:, 1], 3).std() / 20**0.5  # of the noise of q1: third differences leave little else
    assert white == pytest.approx(0.001, rel=0.3)


@pytest.fixture
def arm(root: Path) -> list[str]:
    """How the double pendulum, as declared, is held by a controller."""
    home = ["--config-dir", str(root / "examples" / "double_pendulum")]
    return [
        *home,
        "run=declared",
        "plant=own",
        "plant.system=double_pendulum:DoublePendulum",
        "mpc.compile=off",
    ]


ENDS, SMALL = ("mpc.low=[-4,-0.5]", "mpc.high=[4,1]"), ("mpc.steps=6", "mpc.horizon=0.3")
GOAL = ("reference=setpoint", "reference.states={q1: 1, q2: -1}", "reference.duration=0.3")


@pytest.mark.slow
def test_motors_of_an_arm_have_limits_of_their_own(arm: list[str], shown: Said, refused: Said) -> None:
    shown("track", *arm, *ENDS, *SMALL, *GOAL, "machines=2", "at_once=2", "out_dir=out")
    rows = np.loadtxt("out/log/flight_0.csv", delimiter=",", skiprows=1)[:, 5:]
    assert bool(((rows >= [-4.0, -0.5]) & (rows <= [4.0, 1.0])).all())
    assert rows[:, 0].max() == 4.0  # beyond what the second motor gives
    shown("export", *arm, *ENDS, *SMALL, "format=c", "out=arm.c")
    verified = ["verify", "arm.c", *arm[:3], *GOAL, "states=20", "adversarial=20"]
    assert "passed" in shown(*verified)
    flown = ["track", "controller=arm.c", *arm[:2], *arm[3:], *GOAL, "out_dir=no"]
    assert "`mpc.low` is (-4.0, -1.0)" in refused(*flown, "mpc.low=[-4,-1]")


def test_a_controller_from_a_small_file_closes_the_loop(double: list[str]) -> None:
    assert main([*double, "options.controller=hold:hold", "out=held"]) == 0
    assert main([*double, "out=free"]) == 0
    held, free = (np.loadtxt(f"{name}/run_0.csv", delimiter=",", skiprows=1) for name in ("held", "free"))
    answer = held[:, 5:7] - free[:, 5:7]  # the same sums of sines in both
    np.testing.assert_allclose(answer, -1.0 * held[:, 1:3] - 0.05 * held[:, 3:5], atol=1e-4)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("options.inputs=null", ["options.inputs=[...]", "tau1 [N m], tau2 [N m]", "options.noise=[...]"]),
        ("options.controller=hold:drop", ["no function 'drop'"]),
        ("options.controller=wrong_of_a_test:one", ["must return inputs (2, 2)", "tau1, tau2", "(2, 1)"]),
        ("plant.parameters.mass=1", ["'mass'", "neither a parameter", "a, b, d"]),
        ("plant.effects=[coulomb_friction]", ["coulomb_friction[q1], coulomb_friction[q2]"]),
    ],
)
def test_a_simulation_that_cannot_be_says_what_is_missing(
    change: str, words: list[str], double: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "wrong_of_a_test.py").write_text("def one(t, x):\n    return x[:, :1]\n")
    sys.path.insert(0, str(tmp_path))
    try:
        assert main([*double, change, "out=data"]) == 2
    finally:
        sys.path.remove(str(tmp_path))
    error = capsys.readouterr().err
    for word in words:
        assert word in error
