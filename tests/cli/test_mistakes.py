"""A mistake in what was typed is one clean message with the remedy, whatever the command, and nothing is made."""

import shlex
from pathlib import Path

import pytest

from tests.helpers.commands import Said

COMMON = {
    "track": ("out_dir=out", "mpc.compile=off"), "close-loop": ("out_dir=out",), "vehicle": ("duration=5",),
    "diagnose": ("system=mass_spring_damper", "retrain=false"), "serve": ("port=0", "out_dir=served"),
}  # fmt: skip
"""Words that come behind the command, where a mistake that is not seen would cost more than a moment."""

MISTAKES = {
    "train": [
        ("trainer.stps=3", "`trainer.stps` is not a key of `nsde train`. Did you mean `trainer.steps`?"),
        ("sytem=cartpole", "`sytem` is not a key of `nsde train`. Did you mean `system`?"),
        ("lr=0.1", "Did you mean `trainer.lr`?"),
        ("system=cartpol", "Did you mean `system=cartpole`?"),
        ("data=logs/monday", "a path goes into `data.path`: data.path=logs/monday"),
        ("'logs (1)'", "`logs (1)` is not KEY=VALUE. A path goes into `data.path`: 'data.path=logs (1)'."),
        ("data.path logs", "`data.path` has no value: write data.path=VALUE"),
        ("loss=my/own", "`loss=my/own`: no such choice."),
        ("hydra/launcher=joblob", "`hydra/launcher=joblob`: no such choice."),
        ("data=simulated data.path=x", "`data.path` is a key of data=csv or data=ulog or data=published"),
        ("data=csv", "`data.path` must be given: file or folder to read. Add data.path=..."),
        ("system.dt=0.1s", "`system.dt` must be a number, without its unit; got '0.1s'."),
        ("data.path=nowhere", "`data.path`: nowhere does not exist; expected a log or a folder of logs."),
        ("data.path=", "`data.path` is empty"),
        ("system=mass_spring_damper data.durations=[2]", "or set `data.test` to []"),
        ("data.path=null", "`data.path` must be given; it cannot be null."),
        ("seed=ü", "`seed=ü` is not in Hydra's grammar."),
        ("hydra.output_subdir=../../x", "`hydra.output_subdir` must be a name in the folder of the run"),
        ("+hydra.output_subdir=/tmp/x", "`hydra.output_subdir` must be a name in the folder of the run"),
        ("'hydra={output_subdir: ../../x}'", "`hydra` is set key by key: hydra.KEY=VALUE"),
        ("'++hydra.sweep={subdir: ../x}'", "`hydra.sweep` is set key by key"),
        ("\"hydra.job.name='../x'\"", "`hydra.job.name` must be a name in the folder of the run"),
        ("hydra.run.dir=/tmp/x", "`hydra.run.dir` is set by the command: name the folder with run_dir"),
        ("-m hydra.sweep.subdir=../x", "`hydra.sweep.subdir` must be a name in the folder of the run"),
        ("data=own data.kind=os:system data.path=x", "A reader is a function `read(system, *, path, ...)`."),
        ("data=own data.kind=:read data.path=x", "expected `module:function`"),
        ("run_dir=/dev/null/x", "/dev/null/x: Not a directory. Name another folder or file."),
        (f"run_dir={'x' * 300}", "File name too long. Name another folder or file."),
        ("trainer.steps=-1", "`trainer.steps` must be at least 1; got -1."),
        ("dtype=float16", "`dtype` must be float32 | float64; got 'float16'."),
        ("data.test=1", "A list needs brackets: 'data.test=[...]'."),
        ("seed=0,1", "To sweep over it, add --multirun"),
        ("--config-dir nowhere", "`--config-dir nowhere`: no such folder."),
        ("resume=nowhere", "there is no run to continue"),
        ("seed=99999999999999999999", "`seed` must have fewer than 19 digits"),
        ("run_dir=", "`run_dir` is empty; name a folder."),
        ("=1", "`=1` is not KEY=VALUE"),
        ("~seed", "no key can be taken out of the configuration"),
        ("-m run_dir=a", "a sweep takes `sweep_dir=...`"),
        ("-m resume=a", "`resume` continues one run; leave out -m."),
        (
            "device=gpu system=mass_spring_damper data.durations=[2,2,2]",
            "`device` must be cpu, cuda or cuda:N",
        ),
        ("model=sysid solver=heun system=mass_spring_damper", "`model=sysid` has no diffusion"),
        ("model=sysid model.method=magic", "`model.method` must be weak | differences"),
        ("model=blackbox_nsde solver=rk4 system=cartpole data.durations=[3,3]", "solver="),
        ("system.effects=[linear_drag] ++system.parameters.linear_drag.wrong=0.2", "wrong"),
    ],
    "track": [
        ("system=mass_spring_damper", "`system` is not a group of `nsde track`. The system is that of"),
        ("run=declared reference.speed=9", "tilts to"),
        ("run=declared reference=waypoints reference.points=[[0,0,1]]", "two or more"),
        ("run=declared mpc.fence=[[1,-1],[0,1],[0,1]]", "`mpc.fence` takes"),
        ("run=nowhere", "no run directory"),
        ("run=pid", "run directory"),
        ("run=declared beside=[declared]", "twice"),
        ("run=declared plant=learned", "plant.system"),
        ("run=declared mpc.period=0.015", "multiple"),
        ("run=declared mpc.speeed_limit=2", "speed_limit"),
    ],
    "vehicle": [
        ("plant=learned", "plant=hexacopter or plant=quadrotor"),
        ("plant.system=cartpole", "must be a multirotor"),
        ("plant.latency=-1", "`plant.latency` must be at least 0"),
        ("parameters.FOO=1", "COM_OF_LOSS_T"),
        ("sensors.gps=[1]", "`sensors.gps` takes three numbers"),
        ("sensors.gps_delay=2", "`sensors.gps_delay` must be from 0 to 1"),
        ("parameters.COM_OF_LOSS_T=soon", "takes a number"),
        ("link.url=udpin:127.0.0.1:x", "expected udpin"),
        ("link.url=udpin:0.0.0.0:14999", "link.expose=true"),
        ("link.key_file=nope", "nope does not exist"),
        ("-m seed=1,2", "has no sweeps"),
        ("hil=udpin:127.0.0.1:4560", "`hil` takes tcpin"),
        ("hil=tcpin:0.0.0.0:4560", "`hil`: 'tcpin:0.0.0.0:4560' would listen"),
    ],
    "close-loop": [
        ("plant=learned", "plant=hexacopter or plant=quadrotor"),
        ("by=link truth=true", "known of simulated machines alone"),
        ("by=glider", "`by`"),
        ("plant.dt=0.01", "without plant.dt"),
        ("plant.effects=[linear_drg]", "linear_drag"),
        ("reference.speed=20", "reference.check=false"),
        ("experiments=1 experiment.fence=[[3,-3],[-3,3],[0.4,4]]", "`experiment.fence` takes"),
        ("flights=0", "`flights` must be at least 1"),
    ],
    "fly": [("run=pid link.url=udpin:0.0.0.0:14999", "link.expose=true"), ("", "`run` must be given")],
    "serve": [
        ("port=70000", "`port` must be from 0 to 65535"),
        ("upload=0", "`upload` must be above 0"),
        ("host=0.0.0.0", "`host` is not a key"),
        ("system=boat", "no such choice"),
    ],
    "simulate": [
        ("out=data plant.effects=[track_tilt]", "track_tilt"),
        ("out=data recording.dropout=2", "recording.dropout"),
        ("", "`out` must be given"),
        ("out=data system=cartpole recording.frame_misalignment=[1,0,0]", "frame_misalignment"),
    ],
    "effects": [
        ("system=cartpol", "Did you mean `system=cartpole`"),
        ("format=yaml", "text | json"),
    ],
    "export": [("system=mass_spring_damper", "it has to be a multirotor (hexacopter, quadrotor)")],
    "design": [("system=mass_spring_damper", "The system is that of the model, run=DIR. Its groups: none.")],
    "diagnose": [
        ("data.path=nowhere also=[os:system]", "'os:system' must be a subclass"),
        ("data.path=nowhere", "nowhere"),
        ("alpha=0.9", "`alpha`"),
        ("max_effects=-1", "`max_effects`"),
        ("candidates=[coulomb_fiction]", "coulomb_fiction"),
        ("candidates=[linear_drag]", "linear_drag"),
    ],
}


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize(
    ("command", "typed", "said"), [(command, *row) for command, rows in MISTAKES.items() for row in rows]
)
def test_a_mistake_is_one_clean_message(
    command: str, typed: str, said: str, refused: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NSDE_TRACEBACK", raising=False)
    error = refused(command, *COMMON.get(command, ()), *shlex.split(typed))
    assert said in error
    assert error.startswith(f"nsde {command}: ")
    assert "https://" not in error
    made = {p.name for p in Path().rglob("*.*") if p.suffix in (".csv", ".json", ".png")}
    assert made <= {"failed.json", "settings.json"}
