"""`nsde simulate` from the command line to files."""

import json
from pathlib import Path

import pytest

from nsde_torch.cli.main import main
from tests.helpers.commands import Said

pytestmark = pytest.mark.usefixtures("elsewhere")


def test_a_data_set_and_its_truth_are_all_that_is_written(shown: Said) -> None:
    words = [
        *("system=mass_spring_damper", "out=data", "seed=3", "durations=[2,1]", "plant.sensor_noise=2"),
        "plant.effects=[{coulomb_friction:{size:0.3}},input_delay]",
        *("recording.sensor_bias.q=0.01", "recording.dropout=0.1"),
    ]
    assert "wrote 2 runs of mass_spring_damper (3 s, " in shown("simulate", *words)
    assert sorted(str(p) for p in Path().rglob("*")) == [
        *("data", "data.truth.json", "data/run_0.csv", "data/run_1.csv")
    ]
    truth = json.loads(Path("data.truth.json").read_text())
    assert set(truth["effects"]) == {"coulomb_friction", "input_delay"}
    assert truth["effects"]["coulomb_friction"]["parameters"]["size"] == 0.3
    assert truth["recording"] == {"sensor_bias": {"q": 0.01}, "dropout": 0.1}
    assert (truth["seed"], truth["sensor_noise"]) == (3, 2.0)


@pytest.mark.parametrize("word", ["plant.effects=law.yaml", "plant.effects=[law.yaml,input_delay]"])
def test_laws_of_a_file_are_what_the_machine_has(word: str) -> None:
    law = "force = c1 q q_dot"
    Path("law.yaml").write_text(f"system: mass_spring_damper\neffects:\n  {law}: {{c1: 0.3}}\n")
    assert main(["simulate", "system=mass_spring_damper", "out=data", "durations=[2]", word]) == 0
    truth = json.loads(Path("data.truth.json").read_text())["effects"]
    assert truth[law]["parameters"]["c1"] == 0.3
    assert ("input_delay" in truth) == ("input_delay" in word)


def test_a_file_of_another_machine_is_refused_by_the_key_that_names_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path("law.yaml").write_text("system: cartpole\neffects:\n  input_delay: {}\n")
    words = ["simulate", "system=mass_spring_damper", "out=data"]
    assert main([*words, "plant.effects=law.yaml"]) != 0
    assert "`plant.effects`: law.yaml was found on system 'cartpole'" in capsys.readouterr().err
    assert main([*words, "plant.effects=[none.yaml]"]) != 0
    assert "`plant.effects`: no file 'none.yaml'" in capsys.readouterr().err


def test_a_second_data_set_does_not_replace_the_first(refused: Said) -> None:
    machine, where = ["system=mass_spring_damper", "durations=[1]"], ["out=data", "truth=elsewhere/what.json"]
    words = ["simulate", *machine, *where]
    assert main(words) == 0
    assert "overwrite=true" in refused(*words)
    assert main([*words, "overwrite=true"]) == 0
    assert Path("elsewhere/what.json").is_file()


def test_an_effect_of_ones_own_is_simulated(root: Path) -> None:
    words = ["plant.effects=[detent:Detent]", "plant.parameters.detent.size=3", "out=data", "durations=[1]"]
    where = ["system=mass_spring_damper", "--config-dir", str(root / "examples" / "extend")]
    assert main(["simulate", *words, *where]) == 0
    truth = json.loads(Path("data.truth.json").read_text())
    assert truth["effects"]["detent"]["parameters"] == {"size": 3, "pitch": pytest.approx(0.05)}


def test_interventions_are_made_of_flights_and_refused_where_nothing_flies(
    refused: Said, shown: Said
) -> None:
    words = ["simulate", "out=data", "pilot=replay"]
    short = ["seed=1", "durations=[3]", "options.variants=12", "options.rounds=1"]
    asked = ["replay.starts=5", "replay.duration=0.5", "replay.before=0.1"]
    assert "(5 interventions on flights of 3 s, 305 rows)" in shown(
        *words, "system=hexacopter", *short, *asked
    )
    header = next(Path("data").glob("*.csv")).read_text().splitlines()[0]
    assert header.endswith("u_6,intervention")
    assert "'mass_spring_damper' is not flown; it takes hexacopter, quadrotor" in refused(
        *words, "system=mass_spring_damper", "overwrite=true"
    )
