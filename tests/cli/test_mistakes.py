"""A mistake in what was typed is one clean message with the remedy, whatever the command, and nothing is made."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from tests.helpers.commands import Said

COMMON = {
    "track": ("out_dir=out", "mpc.compile=off"),
    "close-loop": ("out_dir=out",),
    "vehicle": ("duration=5",),
}
"""Words that come behind the command, where a mistake that is not seen would cost more than a moment."""

MISTAKES = [
    ("train", "trainer.stps=3", "`trainer.stps` is not a key of `nsde train`. Did you mean `trainer.steps`?"),
    ("train", "sytem=cartpole", "`sytem` is not a key of `nsde train`. Did you mean `system`?"),
    ("train", "+trainer.stps=3", "Did you mean `trainer.steps`?"),
    ("train", "lr=0.1", "Did you mean `trainer.lr`?"),
    ("train", "system=cartpol", "Did you mean `system=cartpole`?"),
    (
        "train",
        "data=/logs/monday",
        "`data=/logs/monday`: `data` is a kind of data, and a path goes into `data.path`",
    ),
    ("train", "data=logs/monday", "a path goes into `data.path`: data.path=logs/monday"),
    ("train", "'data=ünï (1)'", "a path goes into `data.path`: 'data.path=ünï (1)'"),
    (
        "train",
        "'logs (1)'",
        "`logs (1)` is not KEY=VALUE. A path goes into `data.path`: 'data.path=logs (1)'.",
    ),
    ("train", "data.path logs", "`data.path` has no value: write data.path=VALUE"),
    ("train", "loss=my/own", "`loss=my/own`: no such choice."),
    ("train", "hydra/launcher=joblob", "`hydra/launcher=joblob`: no such choice."),
    (
        "train",
        "data=simulated data.path=x",
        "`data.path` is a key of data=csv or data=ulog or data=published",
    ),
    ("train", "data=csv", "`data.path` must be given: file or folder to read. Add data.path=..."),
    (
        "train",
        "data=csv data.durations=[1]",
        "`data.durations` is a key of data=simulated, but data=csv is chosen.",
    ),
    ("train", "trainer.steps=many", "`trainer.steps` must be a whole number; got 'many'."),
    ("train", "system.dt=0.1s", "`system.dt` must be a number, without its unit; got '0.1s'."),
    (
        "train",
        "data.path=nowhere",
        "`data.path`: nowhere does not exist; expected a log or a folder of logs.",
    ),
    ("train", "data.path=", "`data.path` is empty"),
    ("train", "data.path=null", "`data.path` must be given; it cannot be null."),
    ("train", "seed=ü", "`seed=ü` is not in Hydra's grammar."),
    ("train", "hydra.output_subdir=../../x", "`hydra.output_subdir` must be a name in the folder of the run"),
    ("train", "+hydra.output_subdir=/tmp/x", "`hydra.output_subdir` must be a name in the folder of the run"),
    ("train", "'hydra={output_subdir: ../../x}'", "`hydra` is set key by key: hydra.KEY=VALUE"),
    ("train", "'++hydra.sweep={subdir: ../x}'", "`hydra.sweep` is set key by key"),
    ("train", "\"hydra.job.name='../x'\"", "`hydra.job.name` must be a name in the folder of the run"),
    ("train", "hydra.run.dir=/tmp/x", "`hydra.run.dir` is set by the command: name the folder with run_dir"),
    (
        "train",
        "-m hydra.sweep.dir=x",
        "`hydra.sweep.dir` is set by the command: name the folder with sweep_dir",
    ),
    ("train", "-m hydra.sweep.subdir=../x", "`hydra.sweep.subdir` must be a name in the folder of the run"),
    (
        "train",
        "data=own data.kind=os:system data.path=x",
        "A reader is a function `read(system, *, path, ...)`.",
    ),
    ("train", "data=own data.kind=builtins:max data.path=x", "A reader is a function"),
    ("train", "data=own data.kind=:read data.path=x", "expected `module:function`"),
    ("train", "run_dir=/dev/null/x", "/dev/null/x: Not a directory. Name another folder or file."),
    ("train", f"run_dir={'x' * 300}", "File name too long. Name another folder or file."),
    ("train", "trainer.steps=-1", "`trainer.steps` must be at least 1; got -1."),
    ("train", "dtype=float16", "`dtype` must be float32 | float64; got 'float16'."),
    ("train", "data.test=1", "A list needs brackets: 'data.test=[...]'."),
    ("train", "seed=0,1", "To sweep over it, add --multirun"),
    ("train", "system=[a", "`system=[a` is not in Hydra's grammar."),
    ("train", "--config-dir nowhere", "`--config-dir nowhere`: no such folder."),
    ("train", "resume=nowhere", "there is no run to continue"),
    ("train", "seed=99999999999999999999", "`seed` must have fewer than 19 digits"),
    ("train", "run_dir=", "`run_dir` is empty; name a folder."),
    ("train", "=1", "`=1` is not KEY=VALUE"),
    ("train", "~seed", "no key can be taken out of the configuration"),
    ("train", "-m run_dir=a", "a sweep takes `sweep_dir=...`"),
    ("train", "-m resume=a", "`resume` continues one run; leave out -m."),
    (
        "track",
        "system=mass_spring_damper",
        "`system` is not a group of `nsde track`. The system is that of the model, run=DIR",
    ),
    ("track", "run=declared reference.speed=9", "tilts to"),
    ("track", "run=declared reference=waypoints reference.points=[[0,0,1]]", "two or more"),
    ("track", "run=declared mpc.fence=[1,2]", "mpc.fence"),
    ("track", "run=declared mpc.fence=[[1,-1],[0,1],[0,1]]", "`mpc.fence` takes"),
    ("track", "run=declared mpc.fence=[[a,b],[0,1],[0,1]]", "`mpc.fence` takes"),
    ("track", "run=nowhere", "no run directory"),
    ("track", "run=pid", "run directory"),
    ("track", "run=declared beside=[declared]", "twice"),
    ("track", "run=declared plant=learned", "plant.system"),
    ("track", "run=declared mpc.period=0.015", "multiple"),
    ("track", "run=declared mpc.speeed_limit=2", "speed_limit"),
    ("vehicle", "plant=learned", "plant=hexacopter or plant=quadrotor"),
    ("vehicle", "plant.dt=0.01", "without plant.dt"),
    ("vehicle", "plant.system=cartpole", "must be a multirotor"),
    ("vehicle", "plant.effects=[linear_drg]", "linear_drag"),
    ("vehicle", "plant.latency=-1", "`plant.latency` must be at least 0"),
    ("vehicle", "parameters.FOO=1", "COM_OF_LOSS_T"),
    ("vehicle", "sensors.gps=[1]", "`sensors.gps` takes three numbers"),
    ("vehicle", "sensors.gps_delay=2", "`sensors.gps_delay` must be from 0 to 1"),
    ("vehicle", "parameters.COM_OF_LOSS_T=soon", "takes a number"),
    ("vehicle", "link.url=udpin:127.0.0.1:x", "expected udpin"),
    ("vehicle", "link.url=udpin:0.0.0.0:14999", "link.expose=true"),
    ("vehicle", "link.key_file=nope", "nope does not exist"),
    ("vehicle", "sed=1", "Did you mean `seed`"),
    ("vehicle", "-m seed=1,2", "has no sweeps"),
    ("vehicle", "hil=udpin:127.0.0.1:4560", "`hil` takes tcpin"),
    ("vehicle", "hil=tcpin:0.0.0.0:4560", "`hil`: 'tcpin:0.0.0.0:4560' would listen"),
    ("close-loop", "plant=learned", "plant=hexacopter or plant=quadrotor"),
    ("close-loop", "by=link truth=true", "known of simulated machines alone"),
    ("close-loop", "by=glider", "`by`"),
    ("close-loop", "plant.dt=0.01", "without plant.dt"),
    ("close-loop", "plant.system=cartpole plant.effects=[]", "plant=hexacopter or plant=quadrotor"),
    ("close-loop", "plant=own plant.system=cartpole", "plant=hexacopter or plant=quadrotor"),
    ("close-loop", "plant.effects=[linear_drg]", "linear_drag"),
    ("close-loop", "reference.speed=20", "reference.check=false"),
    ("close-loop", "experiments=1 experiment.fence=[[3,-3],[-3,3],[0.4,4]]", "`experiment.fence` takes"),
    ("close-loop", "experiments=1 experiment.fence=[[wall,3],[-3,3],[0.4,4]]", "`experiment.fence` takes"),
    ("close-loop", "flights=0", "`flights` must be at least 1"),
    ("close-loop", "flihgts=2", "Did you mean `flights`"),
    ("fly", "run=pid link.url=foo:1", "expected udpin"),
    ("fly", "run=pid link.url=udpin:0.0.0.0:14999", "link.expose=true"),
    ("simulate", "out=data plant.effects=[track_tilt]", "track_tilt"),
    ("simulate", "out=data plant.effect=[linear_drag]", "plant.effects"),
    ("simulate", "out=data recording.dropout=2", "recording.dropout"),
    ("simulate", "", "`out` must be given"),
    ("simulate", "out=data system=cartpole recording.frame_misalignment=[1,0,0]", "frame_misalignment"),
    ("effects", "sytem=cartpole", "Did you mean `system=`"),
    ("effects", "system=cartpol", "Did you mean 'cartpole'"),
    ("effects", "format=yaml", "text, json"),
    ("export", "system=mass_spring_damper", "it has to be a multirotor (hexacopter, quadrotor)"),
    ("design", "system=mass_spring_damper", "The system is that of the model, run=DIR. Its groups: none."),
    (
        "diagnose",
        "system=mass_spring_damper data.path=nowhere also=[os:system]",
        "'os:system' must be a subclass",
    ),
]


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize(("command", "typed", "said"), MISTAKES)
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
