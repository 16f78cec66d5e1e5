"""What holds for every effect of the catalogue, on the first machine that can have it, and for some in other places."""

from typing import Any

from torch import Tensor

from nsde_torch.effects import EFFECTS
from nsde_torch.systems import system_class
from tests.helpers.effect_contract import EffectContract, contract
from tests.helpers.two_joints import HOME

ROOM, BOAT = "tests.helpers.own_machines:Room", "tests.helpers.own_machines:Ship"
MACHINES = ("mass_spring_damper", HOME, "cartpole", "hexacopter", ROOM, BOAT)
PLACES = {
    HOME: (
        *("coulomb_friction[q2]", "added_inertia[q2]", "stop_above[q2]", "asymmetric_lag[tau1]"),
        *("actuator_lag[tau2]", "input_delay[tau1]", "input_play[tau2]"),
    ),
    "cartpole": ("hidden_mass[pole]", "position_bias[pole]"),
    "quadrotor": ("motor_efficiency_loss", "axial_inflow"),
}
STATES = {
    **dict.fromkeys(("actuator_lag", "asymmetric_lag", "actuator_rate_limit", "input_play"), 1),
    **dict.fromkeys(("hysteresis", "relaxation", "viscoelasticity"), 1),
    **dict.fromkeys(("input_delay", "actuator_resonance", "hidden_mass"), 2),
    **{"motor_lag": 6, "slung_load": 4},
}
TRIED: dict[str, dict[str, Any]] = {
    **{name: {"signed": True} for name in ("asymmetric_deadband", "asymmetric_saturation")},
    **{name: {"size": 0.01} for name in ("coulomb_friction", "asymmetric_friction")},
    **{f"{name}_friction": {"size": 0.1} for name in ("stribeck", "position_dependent", "load")},
    "asymmetric_lag": {"values": {"rising": 0.03, "falling": 0.11}},
    "actuator_rate_limit": {"values": {"rate": 4.0}},
    "actuator_resonance": {"values": {"period": 0.5, "damping": 0.3}},
    "periodic_force": {"values": {"sine": 0.3, "cosine": -0.2, "frequency": 1.7}},
    "run_periodic_force": {"values": {"waves": [0.3, -0.2], "frequency": 1.7}, "time": 0.07},
    "ripple": {"values": {"sine": 0.2, "cosine": 0.1, "order": 3.0}},
    "stop_above": {"values": {"stiffness": 2.0, "damping": 0.5, "end": 0.1}},
}


def _tried(name: str, system: str) -> type[EffectContract]:
    effect = name.partition("[")[0]
    return contract(name, system, memory=STATES.get(effect, 0), **TRIED.get(effect, {}))


class OfRuns:
    def rows(self, n: int, *, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
        x, u, memory = super().rows(n, seed=seed)  # type: ignore[misc]
        u[:, -1] = 0.0  # the number of the run
        return x, u, memory


class WithoutForce:
    def test_its_memory_starts_at_rest(self: Any) -> None:
        """Without force, whatever it moves at: what moved before the log is not known, and was to and fro."""
        effect, (x, u, _) = self.make(), self.rows(4)
        assert effect(0.0, x, u, effect.memory_start(x, u)).tolist() == [[0.0]] * 4


OTHERWISE = {"run_periodic_force": OfRuns, "viscoelasticity": WithoutForce}
for effect in EFFECTS:
    able = [(n, s) for s in MACHINES for n in system_class(s).able_effects() if n.partition("[")[0] == effect]
    own = [base for name, base in OTHERWISE.items() if name == effect]
    globals()[f"Test_{effect}"] = type(effect, (*own, _tried(*able[0])), {})
for system, names in PLACES.items():
    globals().update({f"Test_{name}_{system}": _tried(name, system) for name in names})


def test_keys_are_names() -> None:
    assert all(key == cls.name for key, cls in EFFECTS.items())
