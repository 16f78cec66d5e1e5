"""Question: what does `mujoco.sysid` make of springs with dry friction that the model does not have?

    python benchmarks/blind/mujoco_sysid.py --count 10          # needs mujoco[sysid]==4.0.0

A mass on a spring, four runs of 10 s, the last left out. `mujoco.sysid` fits stiffness, damping and gear of an MJCF
model, once without and once with `frictionloss`; the diagnosis gets the declared physics alone. The figure is the rms
error of open-loop predictions one second ahead, over that of the declared physics fitted by least squares.
"""

from __future__ import annotations

import json
from typing import Any

import mujoco
import mujoco.rollout
import mujoco.sysid
import numpy as np
import torch
from study import options

import nsde_torch
from nsde_torch.data import Run, Windows
from nsde_torch.diagnosis.cross_validation import as_model
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.pipeline import diagnose
from nsde_torch.diagnosis.search import Search, fitted_system
from nsde_torch.evaluation.metrics import start_grid
from nsde_torch.evaluation.scores import rollout_squares
from nsde_torch.models.identified import SysidSpec
from nsde_torch.systems import make_system

DT, STEPS = 0.01, 100
MJCF = f"""
<mujoco><option timestep="{DT}" gravity="0 0 0" integrator="implicitfast"/>
<worldbody><body><joint name="q" type="slide" axis="1 0 0" stiffness="1" damping="0.5"/>
<geom type="sphere" size="0.1" mass="1"/></body></worldbody>
<actuator><motor name="u" joint="q" gear="1"/></actuator>
<sensor><jointpos name="pos" joint="q"/><jointvel name="vel" joint="q"/></sensor></mujoco>
"""


def spec() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(MJCF)


def parameters(*, friction: bool) -> Any:
    """Stiffness, damping and gear, with the friction or without."""
    out = mujoco.sysid.ParameterDict()

    def stiffness(s: mujoco.MjSpec, p: Any) -> None:
        s.joint("q").stiffness = np.array([p.value[0], 0.0, 0.0])[: np.size(s.joint("q").stiffness)]

    def damping(s: mujoco.MjSpec, p: Any) -> None:
        s.joint("q").damping = np.array([p.value[0], 0.0, 0.0])[: np.size(s.joint("q").damping)]

    def gear(s: mujoco.MjSpec, p: Any) -> None:
        s.actuator("u").gear = np.array([p.value[0], 0, 0, 0, 0, 0], dtype=float)

    def loss(s: mujoco.MjSpec, p: Any) -> None:
        s.joint("q").frictionloss = float(p.value[0])

    given = [
        ("stiffness", 1.0, 0.0, 20.0, stiffness),
        ("damping", 0.5, 0.0, 5.0, damping),
        ("gear", 1.0, 0.1, 5.0, gear),
    ]
    given += [("frictionloss", 0.05, 0.0, 2.0, loss)] if friction else []
    for name, first, low, high, modifier in given:
        out.add(mujoco.sysid.Parameter(name, first, low, high, modifier=modifier))
    return out


def fitted(runs: list[Run], *, friction: bool) -> Any:
    """The parameters that `mujoco.sysid` finds."""
    model = spec().compile()
    states, controls, sensors = [], [], []
    for run in runs:
        t = run.t - run.t[0]
        states.append(mujoco.sysid.create_initial_state(model, run.x[0, :1], run.x[0, 1:2]))
        controls.append(mujoco.sysid.TimeSeries(t, run.u[:, :1]))
        sensors.append(mujoco.sysid.TimeSeries.from_names(t, run.x, model, names=["pos", "vel"]))
    names = [r.name for r in runs]
    sequences = mujoco.sysid.ModelSequences("spring", spec(), names, states, controls, sensors)
    residual = mujoco.sysid.build_residual_fn(models_sequences=[sequences])
    found, _ = mujoco.sysid.optimize(parameters(friction=friction), residual, verbose=False)
    return found


def predicted(found: Any, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """States (B, 2) a second after the starts x under the inputs u (B, steps)."""
    s = spec()
    for p in found.values():
        p.modifier(s, p)
    model = s.compile()
    starts = np.stack([mujoco.sysid.create_initial_state(model, q[:1], q[1:]) for q in x])
    states, _ = mujoco.rollout.rollout(model, mujoco.MjData(model), starts, u[:, :, None])
    return np.asarray(states[:, -1, 1:3])


def judged(seed: int) -> dict[str, Any]:
    size = float(np.random.default_rng(seed).uniform(0.1, 0.5))
    effects = [{"coulomb_friction": {"size": size}}]
    made = nsde_torch.simulate("mass_spring_damper", effects=effects, durations=[10.0] * 4, seed=seed)
    data = nsde_torch.read(made, system="mass_spring_damper")
    training, test = list(data.runs[:3]), [data.runs[3]]
    system = make_system("mass_spring_damper")
    own = SysidSpec(system.name, dt=data.dt, horizon=system.defaults.horizon)
    windows = Windows(test, data.dt, STEPS, dtype=torch.float64)
    starts = start_grid(windows)
    x, u, _ = windows.batch(starts)

    def ours(machine: Any) -> np.ndarray:
        squares = rollout_squares(as_model(own, machine, 1.0), windows, starts, [STEPS])
        return squares[:, 0].mean(0).sqrt().numpy()

    found = diagnose(system, own, data, training, Options())
    errors = {
        "declared": ours(fitted_system(Search(system, training, 1.0, Options()).quick(system))),
        "diagnosis": ours(found.outcome.system),
    }
    for name, friction in (("mujoco.sysid", False), ("mujoco.sysid, friction in its model", True)):
        end = predicted(fitted(training, friction=friction), x[:, 0].numpy(), u[:, :STEPS, 0].numpy())
        errors[name] = np.sqrt(np.square(end - x[:, STEPS].numpy()).mean(0))
    ratio = {k: float(np.exp(np.log(v / errors["declared"]).mean())) for k, v in errors.items()}
    return {"seed": seed, "size": size, "added": found.added, "ratio": ratio}


def main() -> None:
    given = options(__doc__, seed=1, count=10).parse_args()
    rows = [judged(given.seed + k) for k in range(given.count)]
    for row in rows:
        print(json.dumps(row), flush=True)
    for key in rows[0]["ratio"]:
        print(f"{key}: median ratio {np.median([r['ratio'][key] for r in rows]):.2f}")


if __name__ == "__main__":
    main()
