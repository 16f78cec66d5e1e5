"""BAM: a servo that swings a pendulum, whose friction models are compared by simulated trajectories (ICRA 2025).

The recordings of that paper are not in its repository. These are of another bench that follows its pipeline: a Feetech
STS3250 at eight loads, six gains and five trajectories, with the six friction models fitted and their scores published.
Declared are the motor with its controller, the weight and the inertias (see `servo`). Terms of the catalogue are tried
one after another by output error: one is taken where the simulation of recordings at a gain that was held out is better
by more than `GAIN`, the best first. All training recordings then give the values.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, final

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import DataError

from .benchmark import BenchmarkMetric, BenchmarkOutcome, PublicBenchmark, PublishedRow, Trace
from .files import Work, found, long_enough
from .named import diagnosed, ladder, words_of
from .output_error import Stretches, machine, output_error, simulated, times, with_units
from .servo import STEP, ServoPendulum, swing

HOME = "data/feetech/STS_3250"
REPOSITORY = "kscalelabs/sysid"
COMMIT = "140d9c5"
MODELS = ("m1", "m2", "m3", "m4", "m5", "m6")
LOGS = {"training": 462, "validation": 353}
PARTS = ("training", "validation", "validation_whole")
ROWS = 621  # of the shortest recording, to which the set cuts all of them
DUTY_PER_GAIN = 0.16383  # duty cycle per radian and unit of the gain, as the set measured it
VOLTS = 15.0  # what its recordings state, and its models were fitted with
HELD_OUT = 8  # gain
THINNED = 6  # of the recordings at other gains, one in so many chooses terms
DIAGNOSED = 20  # of all recordings for training, one in so many is diagnosed
ROWS_OF_A_STEP = 2  # of a diagnosed log: what was measured has 10 ms, and was interpolated
GAIN = 0.02
ITERATIONS = (8, 12)
WIDTH = 0.05  # speed [rad/s] at which dry friction is 76 % developed: two steps of the logged speed
CANDIDATES: dict[str, dict[str, float]] = {
    "input_delay": {"delay": 0.02},
    "coulomb_friction": {"size": 0.05, "width": WIDTH},
    "load_friction": {"coefficient": 0.1, "width": WIDTH},
    "viscous_friction": {"damping": 0.02},
    "quadratic_damping": {"damping": 0.01},
    "hysteresis": {"size": 0.05, "reach": 0.02},
}
"""Terms that are tried, and first values."""
_FIRST = {"stall_torque": 10.0, "speed_constant": 0.2}
Logs = Sequence[Mapping[str, Any]]
_TYPICAL = 0.03  # error [rad]
_SCORES = (0.0329, 0.0328, 0.0307, 0.0304, 0.0303, 0.0299)


@final
class Bam(PublicBenchmark):
    name = "bam"
    title = "BAM: a position-controlled servo that swings a pendulum"
    repository = REPOSITORY
    files = (
        f"{HOME}/processed/*.json",
        f"{HOME}/processed/validation/*.json",
        *(f"{HOME}/friction_params/{model}.json" for model in MODELS),
    )
    protocol = (
        f"At commit {COMMIT}: identified on the {LOGS['training']} recordings in processed/, simulated from the first "
        f"angle and speed with the controller in the loop; mean absolute error of the angle over the first {ROWS} "
        "samples (3.1 s), as the published scores are. Then the same of the recordings in validation/, and over the "
        "whole of these."
    )
    metrics = tuple(BenchmarkMetric(part, "mrad", digits=1) for part in PARTS)
    published = tuple(
        PublishedRow(f"{m.upper()}, as published", {"training": 1e3 * v}, f"{REPOSITORY}, {HOME}/README.md")
        for m, v in zip(MODELS, _SCORES, strict=True)
    )
    minutes = 7

    def paths(self, folder: Path) -> list[Path]:
        home = folder / HOME if (folder / HOME).is_dir() else folder
        if folder.is_dir() and not (home / "processed").is_dir():
            raise DataError(
                f"`data.path={folder}` holds no {HOME}/processed. Name a checkout of {self.repository} at commit "
                f"{COMMIT}: newer ones hold the recordings in archives."
            )
        out = []
        for part, count in LOGS.items():
            inside = home / "processed" / ("" if part == "training" else part)
            logs = sorted(inside.glob("*.json"))
            if folder.is_dir() and len(logs) != count:
                raise DataError(
                    f"{inside} holds {len(logs)} recordings and not {count}. Check out {COMMIT} of {self.repository} "
                    "again."
                )
            out += logs
        models = [f"friction_params/{model}.json" for model in MODELS]
        return [*out, *found(home, models, repository=self.repository)]

    def run(self, paths: Sequence[Path], work: Work) -> BenchmarkOutcome:
        logs = []
        for k, path in enumerate(paths[: -len(MODELS)]):
            work.say("reading", k, len(paths))
            logs.append(_read(path))
        training, validation = logs[: LOGS["training"]], logs[LOGS["training"] :]
        others = [log for log in training if log["kp"] != HELD_OUT][::THINNED]
        held_out = [log for log in training if log["kp"] == HELD_OUT]

        named = work.stage("diagnosis", lambda: _diagnosed(training[::DIAGNOSED], work))

        def tried(effects: tuple[str, ...], first: Mapping[str, Any]) -> dict[str, Any]:
            def make() -> dict[str, Any]:
                values = _fitted(effects, first, others, ITERATIONS[0], work)
                error = _error(effects, values, held_out)
                return {"effects": list(effects), "values": values, "held_out": error}

            return work.stage("_".join(["model", *effects]), make)

        rungs = ladder(tried, CANDIDATES, first=_FIRST, error="held_out", gain=GAIN)
        taken = tuple(rungs[-1]["effects"])
        rows: dict[str, dict[str, float]] = {}
        parts = dict(zip(PARTS, ((training, ROWS), (validation, ROWS), (validation, None)), strict=True))
        for model, path in zip(MODELS, paths[-len(MODELS) :], strict=True):
            p = _parameters(path)
            rows[f"{model.upper()}, published values, simulated here"] = {
                key: 1e3 * _mean(_batches(part, count), _swung(p)) for key, (part, count) in parts.items()
            }
        for made in (rungs[0], rungs[-1]):
            effects = tuple(made["effects"])

            def all_logs(effects: tuple[str, ...] = effects, first: Any = made["values"]) -> dict[str, Any]:
                return {"values": _fitted(effects, first, training, ITERATIONS[1], work)}

            last = work.stage("_".join(["final", *effects]), all_logs)["values"]
            name = " + ".join(["motor and weight", *effects])
            rows[f"ours, {name}"] = {
                key: 1e3 * _error(effects, last, part, count) for key, (part, count) in parts.items()
            }
        errors = [{"effects": m["effects"], "mrad": 1e3 * m["held_out"]} for m in rungs]
        return BenchmarkOutcome(
            rows,
            taken,
            with_units(_machine(taken, last), last),
            [
                *words_of(taken, "the motor with its controller and the weight"),
                f"Named by a diagnosis of {len(training[::DIAGNOSED])} recordings, their logged speeds with them "
                f"({named['verdict']}): {', '.join(named['named']) or 'nothing'}.",
            ],
            _traces(taken, last, validation),
            {"diagnosis": named, "held_out": errors},
        )


def _read(path: Path) -> dict[str, Any]:
    """States (n, 2), inputs (n - 1, 5), gain and trajectory of a recording."""
    try:
        log = json.loads(path.read_text(encoding="utf-8"))
        rows = log["entries"]
        long_enough(len(rows), ROWS, path)
        x = np.array([[row["position"], row["speed"]] for row in rows], dtype=np.float64)
        moving = np.array([[r["goal_position"], r["torque_enable"]] for r in rows[:-1]], dtype=np.float64)
        same = [float(log["kp"]) * DUTY_PER_GAIN, float(log["mass"]), float(log["length"])]
        step, kind = float(log["dt"]), str(log["trajectory"])
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path} is no recording of a servo, or is cut off ({error!r}). Fetch it again."
        ) from None
    if abs(step - STEP) > 1e-9 or not (np.isfinite(x).all() and np.isfinite(moving).all()):
        raise DataError(
            f"{path} has steps of {step} s or holds what is no number; it is to be on {STEP} s. Fetch it again."
        )
    gain, mass, length = np.broadcast_to(np.array(same)[:, None], (3, len(moving)))
    u = np.stack([moving[:, 0], gain, moving[:, 1], mass, length], 1)
    return {"x": x, "u": u, "kp": int(log["kp"]), "kind": kind}


def _diagnosed(logs: Logs, work: Work) -> dict[str, Any]:
    """What a diagnosis finds missing in the declared physics."""
    step = ROWS_OF_A_STEP * STEP
    runs = []
    for k, log in enumerate(logs):
        x, u = log["x"][: ROWS - 1 : ROWS_OF_A_STEP], log["u"][: ROWS - 1 : ROWS_OF_A_STEP]
        runs.append(RawRun(f"recording {k}", times(len(x), step), x, u))
    seen = diagnosed(runs, system=ServoPendulum, parameters=_FIRST, say=work.say)
    named = [
        f"{name} {entry['value']:.4g} {entry['unit']}"
        for name, entry in seen["parameters"].items()
        if name.split(".")[0] in seen["added"]
    ]
    return {"verdict": seen["verdict"], "named": named or list(seen["added"])}


def _parameters(path: Path) -> dict[str, float]:
    """Parameters of a friction model of the set."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        p = {str(key): float(value) for key, value in content.items() if not isinstance(value, str)}
        missing = {"kt", "R", "armature", "q_offset", "friction_base", "friction_viscous"} - set(p)
    except (ValueError, TypeError, AttributeError) as error:
        raise DataError(
            f"{path} holds no parameters of a friction model ({error}). Fetch it again."
        ) from None
    if missing:
        raise DataError(f"{path} lacks {', '.join(sorted(missing))}. Fetch it again.")
    return p


def _batches(logs: Logs, count: int | None) -> list[tuple[Array, Array]]:
    """States and inputs of recordings of like length, the first `count` rows of each."""
    lengths = sorted({len(log["x"]) for log in logs}) if count is None else [count]
    out = []
    for n in lengths:
        like = [log for log in logs if count is not None or len(log["x"]) == n]
        out.append((np.stack([log["x"][:n] for log in like]), np.stack([log["u"][: n - 1] for log in like])))
    return out


def _mean(batches: Sequence[tuple[Array, Array]], path: Callable[[Array, Array], Array]) -> float:
    """Mean over recordings of the mean absolute error of each simulated angle [rad]."""
    return float(np.concatenate([np.abs(path(x, u) - x[..., 0]).mean(1) for x, u in batches]).mean())


def _swung(p: Mapping[str, float]) -> Callable[[Array, Array], Array]:
    return lambda x, u: swing(p, x[:, 0], u, VOLTS)


def _machine(effects: tuple[str, ...], values: Mapping[str, Any]) -> Any:
    first = {f"{name}.{key}": value for name in effects for key, value in CANDIDATES[name].items()}
    return machine(ServoPendulum, effects, {**first, **values})


def _fitted(
    effects: tuple[str, ...], first: Mapping[str, Any], logs: Logs, iterations: int, work: Work
) -> dict[str, Any]:
    """Values whose simulations have the smallest mean absolute error of the angle."""
    ((x, u),) = _batches(logs, ROWS)
    estimate = output_error(
        _machine(effects, first),
        Stretches(x, u, STEP),
        weights=np.array([1.0 / _TYPICAL, 0.0]),
        fixed=tuple(f"{name}.width" for name in effects if "width" in CANDIDATES[name]),
        groups=((0,),),
        side_by_side=True,
        iterations=iterations,
        stage=f"fitting {' + '.join(['motor and weight', *effects])}",
        say=work.say,
    )
    return dict(estimate.values)


def _error(
    effects: tuple[str, ...],
    values: Mapping[str, Any],
    logs: Logs,
    count: int | None = ROWS,
) -> float:
    """Mean absolute error of simulated angles [rad]."""
    system = _machine(effects, values)
    return _mean(_batches(logs, count), lambda x, u: simulated(system, x[:, 0], u, dt=STEP)[..., 0])


def _traces(effects: tuple[str, ...], values: Mapping[str, Any], logs: Logs) -> list[Trace]:
    """One recording of each trajectory, the first one of the middle gain."""
    out = []
    for kind in sorted({log["kind"] for log in logs}):
        like = sorted((log for log in logs if log["kind"] == kind), key=lambda log: abs(log["kp"] - 16))[0]
        ((x, u),) = _batches([like], None)
        path = simulated(_machine(effects, values), x[:, 0], u, dt=STEP)
        title = f"{kind.replace('_', ' ')}, gain {like['kp']}, validation"
        out.append(Trace(title, "angle [rad]", times(x.shape[1], STEP), x[0, :, 0], path[0, :, 0]))
    return out
