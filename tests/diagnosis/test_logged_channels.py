"""Effects may read logged columns beside the inputs, each its own."""

from dataclasses import replace
from typing import final

import numpy as np
import pytest
from torch import Tensor

from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.pipeline import diagnose
from nsde_torch.effects import Effect, Parameter, Port
from nsde_torch.models.identified import SysidSpec
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import recorded


@final
class Supply(Effect):
    name = "supply"
    port = Port.INPUT
    systems = ("mass_spring_damper",)
    exogenous = ("supply_voltage",)
    formula = "u_eff = u (1 + s (V - 24 V))"
    source = "made for this test"
    PARAMETERS = {"sensitivity": Parameter(0.0, "1/V", scale=0.05, help="s")}
    null = {"sensitivity": 0.0}
    amplitudes = ("sensitivity",)
    sentence = "The force follows the voltage by {sensitivity}."

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.value("sensitivity") * (self.channel("supply_voltage", u) - 24.0) * u[:, :1]


def test_an_effect_that_reads_a_logged_column_is_named_and_finds_its_own_column(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("nsde_torch.effects.registry._OWN", {})
    # gain that drifts by 0.05 a second, 1 + 0.05 t, is what a voltage of 24 + t and 0.05 a volt would do
    data = recorded("mass_spring_damper", {"actuator_gain_drift": {"rate": 0.05}})
    rng = np.random.default_rng(0)
    runs = [
        replace(run, extra={"air_temperature": rng.normal(size=len(run.t)), "supply_voltage": 24.0 + run.t})
        for run in data.runs
    ]
    system = make_system("mass_spring_damper")
    spec = SysidSpec(system.name, dt=data.dt, horizon=system.defaults.horizon)
    options = Options(candidates=(), also=(f"{__name__}:Supply",))
    content = diagnose(system, spec, replace(data, runs=runs), runs, options).content()
    assert content["added"] == ["supply"]
    assert content["parameters"]["supply.sensitivity"]["value"] == pytest.approx(0.05, rel=0.2)
