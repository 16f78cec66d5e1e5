"""Effects by expression: the same as a class written by hand, in every use, and the same after a file."""

from pathlib import Path

import pytest
import torch
import yaml
from torch import Tensor

import nsde_torch
from nsde_torch.effects import Effect, Parameter, Port, effect_class, files, key_of
from nsde_torch.errors import ConfigError
from nsde_torch.export.graph import graph_of
from nsde_torch.rotation import rotate_back
from nsde_torch.systems import System, make_system
from nsde_torch.systems.options import system_options
from nsde_torch.systems.vocabulary import seen_by
from tests.helpers.exported import small_controller, step_of
from tests.helpers.hexacopters import declared

__all__ = ["declared"]
STOP = "force = c1 q q_dot - c2 max(q - k1, 0)"
TWIST = "body_moment[y] = c1 v_body_x w_z + c2 up_x collective^2"


class ByHand(Effect):
    """The same as `TWIST`."""

    name, port, formula, source = "by_hand", Port.BODY_MOMENT, "see TWIST", "this test"
    PARAMETERS = {"c1": Parameter(0.0, "1/m"), "c2": Parameter(0.0, "rad/s2")}

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        q = x[:, 6:10]
        up = torch.zeros_like(x[:, :3])
        up[:, 2] = 1.0
        forward, tilt = rotate_back(q, x[:, 3:6])[:, 0], rotate_back(q, up)[:, 0]
        out = torch.zeros_like(x[:, :3])
        out[:, 1] = self.value("c1") * forward * x[:, 12] + self.value("c2") * tilt * u[:, :6].sum(1) ** 2
        return out


def states(system: System, rows: int = 50) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(rows, system.nx, generator=generator, dtype=torch.float64)
    if system.quaternion is not None:
        x[:, system.quaternion] /= x[:, system.quaternion].norm(dim=1, keepdim=True)
    return x, torch.rand(rows, system.nu, generator=generator, dtype=torch.float64)


def test_a_law_as_text_is_the_effect_that_a_class_of_ten_lines_would_be() -> None:
    values = {"c1": 0.44, "c2": -0.3}
    ours = make_system("hexacopter", effects=[TWIST], values={f"{TWIST}.{k}": v for k, v in values.items()})
    theirs = make_system("hexacopter").with_effects(ByHand(values))
    x, u = states(ours)
    rates = [system.double().drift(0.0, x, u) for system in (ours, theirs)]
    assert torch.allclose(*rates, rtol=1e-6, atol=1e-6)
    assert (rates[0] - make_system("hexacopter").double().drift(0.0, x, u))[:, 11].abs().max() > 0.1


def test_a_law_reads_states_inputs_and_columns_of_the_log_and_has_derivatives() -> None:
    law = "force = c1 sign(q_dot, k1) logged(load) - c2 min(q, 0)^2 cos(k2 q) force"
    law += " + c3 peak(q_dot, k3) expm1(k4 q) time"
    values = {"c1": 0.5, "c2": 0.2, "c3": 0.3, "k1": 0.1, "k2": 3.0, "k3": 0.7, "k4": 0.9}
    system = make_system("mass_spring_damper", effects=[law]).double()
    for name, value in values.items():
        system.effects[-1].set_value(name, torch.tensor([value]))  # type: ignore[operator]
    assert system.exogenous == ("load",)
    x, u = states(system)
    u = torch.cat((u, torch.linspace(0.0, 2.0, len(u), dtype=torch.float64)[:, None]), 1)
    q, v = x[:, 0], x[:, 1]
    expected = 0.5 * torch.tanh(v / 0.1) * u[:, 1] - 0.2 * q.clamp(max=0) ** 2 * torch.cos(3.0 * q) * u[:, 0]
    expected = expected + 1.5 * 0.3 * 1.4 * v / (v**2 + 0.49) * (torch.exp(0.9 * q) - 1.0)
    effect = system.effects[-1]
    assert isinstance(effect, Effect)
    found = effect(1.5, x, seen_by(system, effect, 1.5, x, u), x[:, :0])[:, 0]
    assert torch.allclose(found, expected, rtol=1e-6, atol=1e-7)
    system.drift(1.5, x, u).square().sum().backward()  # type: ignore[no-untyped-call]
    assert all(p.grad is not None and bool(p.grad.abs() > 0) for p in effect.parameters())


def test_the_name_says_it_all_in_any_process() -> None:
    cls = make_system("mass_spring_damper").effect_class("force=c1*q*q_dot - c2*max(q-k1,0)")
    assert cls.name == key_of(cls) == STOP
    assert effect_class(STOP).name == STOP
    assert (cls.amplitudes, cls.null) == (("c1", "c2"), {"c1": 0.0, "c2": 0.0})
    assert make_system("mass_spring_damper").effect_class(STOP) is cls
    with pytest.raises(ConfigError, match="is of no machine"):
        effect_class(STOP)()(0.0, torch.ones(2, 2), torch.ones(2, 1), torch.ones(2, 0))


def test_a_file_holds_laws_and_gives_them_back(tmp_path: Path) -> None:
    path = tmp_path / "effects.yaml"
    files.write(path, "mass_spring_damper", {STOP: {"c1": 0.3, "c2": 1.5, "k1": 0.4}}, "a test")
    system = system_options("mass_spring_damper", effects=path).make()
    assert system.effect_names[-1] == STOP
    found = {k: float(v) for k, (v, _) in system.all_declared().items() if k.startswith(STOP)}
    assert found == pytest.approx({f"{STOP}.c1": 0.3, f"{STOP}.c2": 1.5, f"{STOP}.k1": 0.4})
    hostile = {"effects": {"force = c1 __import__('os')": {"c1": 1.0}}}
    path.write_text(yaml.safe_dump(hostile), encoding="utf-8")
    with pytest.raises(ConfigError, match="is not of the grammar"):
        system_options("mass_spring_damper", effects=path).make()


def test_values_outlive_another_first_value() -> None:
    saved = make_system("mass_spring_damper", effects=[STOP], values={f"{STOP}.c1": 7.0, f"{STOP}.c2": 1e-3})
    fresh = make_system("mass_spring_damper", effects=[STOP])
    fresh.load_state_dict(saved.state_dict())
    for name, (value, _) in saved.all_declared().items():
        assert torch.allclose(fresh.all_declared()[name][0], value), name


@pytest.mark.slow
def test_a_plant_can_have_a_law_and_a_model_with_it_is_trained_saved_and_evaluated(tmp_path: Path) -> None:
    law = "force = c1 q q_dot"
    data = nsde_torch.simulate("mass_spring_damper", effects={law: {"c1": 0.3}}, durations=(6.0,) * 4, seed=3)
    run = tmp_path / "run"
    trained = nsde_torch.train(data, system="mass_spring_damper", model="sysid", effects=[law], run_dir=run)
    value = trained.system.all_declared()[f"{law}.c1"][0]
    assert float(value) == pytest.approx(0.3, abs=0.02)
    again = nsde_torch.load(run).system.all_declared()[f"{law}.c1"][0]
    assert torch.allclose(again, value)


@pytest.mark.slow
def test_a_controller_with_a_law_is_exported_as_it_is(declared: System) -> None:
    effect = declared.make_effect(TWIST, {"c1": 0.44, "c2": -0.3})
    system = declared.with_effects(effect.to(next(declared.parameters()).dtype))
    step = step_of(small_controller(system, particles=2, steps=3), system)
    for name, example in step.examples().items():
        graph, plain = graph_of(step.stage(name), example), step.stage(name)(*example)
        for ours, theirs in zip(graph(*example), plain, strict=True):
            assert torch.allclose(ours, theirs, rtol=1e-9, atol=1e-9, equal_nan=True), name
