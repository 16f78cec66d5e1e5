"""Interventions on a plant: states of flights, commands of other times, nothing else."""

from typing import Any

import pytest
import torch

from nsde_torch.errors import ConfigError, ShapeError
from nsde_torch.recording.chain import Recording
from nsde_torch.simulation import Replay, make_plant, simulate

BRIEF = {"durations": [3.0, 2.5], "options": {"variants": 2, "rounds": 1}}
QUIET = {"process_noise": 0.0, "sensor_noise": 0.0}


def test_a_plant_resumes_with_its_memory_its_latency_and_its_clock() -> None:
    effects = {"thrust_sag": {"rate": 0.02}}
    g = torch.Generator().manual_seed(0)
    late = {"effects": effects, "latency": 0.025, "step": 0.005, **QUIET}
    plants = [make_plant("quadrotor", generator=g, **late) for _ in "ab"]
    x = torch.zeros(2, 13, dtype=torch.float64)
    x[:, 6] = 1.0
    commands = 0.4 + 0.1 * torch.rand(60, 2, 4, generator=g, dtype=torch.float64)
    plants[0].reset(x, commands[0])
    for u in commands[:40]:
        plants[0].step(u)
    # as if the two machines had begun 0.4 s and 0.4 s ago, each told so by itself
    t0 = torch.tensor([0.4, 0.4], dtype=torch.float64)
    plants[1].resume(plants[0].whole_state, commands[30:40].transpose(0, 1), t0=t0)
    for u in commands[40:]:
        expected, found = plants[0].step(u), plants[1].step(u)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    with pytest.raises(ShapeError, match="`before` must be"):
        plants[1].resume(plants[0].whole_state, commands[30:40])


@pytest.mark.parametrize(
    ("system", "given", "said"),
    [
        ("cartpole", {}, r"'cartpole' is not flown; it takes hexacopter, quadrotor.*policy=random"),
        (
            "hexacopter",
            {"replay": Replay(duration=0.0)},
            r"`replay.duration` must be a sample of 0.01 s or longer",
        ),
        (
            "hexacopter",
            {"recording": Recording(input_smoothing=0.1)},
            "`recording.input_smoothing` do not go",
        ),
        ("hexacopter", {"replay": Replay(duration=3.0), **BRIEF}, "too short for 50 rows before"),
    ],
)
def test_what_has_no_interventions_is_refused_by_name(system: str, given: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        simulate(system, **{"seed": 0, "replay": Replay(), **given})
