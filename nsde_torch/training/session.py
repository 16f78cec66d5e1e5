"""One training from data to run directory: fit, calibrate, score on held-out runs, write what was learned."""

import copy
import math
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from tqdm.auto import tqdm

from nsde_torch.data import DataSet, Run, Split, Windows
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.evaluation import report, seen
from nsde_torch.evaluation.figures import Coverage, extrapolate, falls_short
from nsde_torch.evaluation.metrics import (
    all_horizons,
    decade,
    evaluate,
    horizons_of,
    start_every,
    start_grid,
    thinned,
)
from nsde_torch.evaluation.one_step import one_step_table
from nsde_torch.evaluation.scores import score
from nsde_torch.models.feedback_model import fit_feedback
from nsde_torch.models.kind import model_kind
from nsde_torch.models.model import Model, ModelSpec, is_equation, is_stochastic, learns_sensors
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.models.run_directory import METRICS, save
from nsde_torch.progress import no_bar
from nsde_torch.recall import recall
from nsde_torch.recording.clock_and_biases import of_runs
from nsde_torch.recording.smoothing import smoothing_width
from nsde_torch.sysid.feedback_test import feedback_summary
from nsde_torch.sysid.identify import identify_in_loop
from nsde_torch.training.options import LossOptions, TrainerOptions
from nsde_torch.training.prepare import sensor_std
from nsde_torch.training.task import Fitted, Progress, Task
from nsde_torch.whole_files import json_text

_LEFT_OUT = 3  # training runs that calibration leaves out in turn, at most
_AUXILIARY_SHARE = 0.5  # of the gradient steps
_AUXILIARY_SEED = 1000  # of the first fit without a run


@dataclass(kw_only=True, eq=False)
class Training:
    """One training. `run` does all of it; killed at any moment and run again, it ends in the same numbers."""

    spec: ModelSpec  # the model
    data: DataSet  # the data set
    split: Split  # runs to train on and runs to test on
    loss: LossOptions  # weights of the losses
    options: TrainerOptions  # settings of the optimisation
    validation: float = 0.15  # share of the training runs' time that early stopping looks at
    seed: int  # seed of weights, batches and noise
    run_dir: str | Path  # folder to write into
    values: Mapping[str, Any] | None = None  # initial values of declared parameters
    device: str | torch.device = "cpu"  # where tensors live
    dtype: torch.dtype = torch.float32  # precision
    about: Mapping[str, Any] | None = None  # plain values for `config.yaml`
    say: Callable[[str], None] | Literal[False] = print
    """Where text for people goes; False: nowhere, and no progress bar."""
    other_sensors: bool = False
    """Whether the test runs were recorded by other sensors, whose noise is then estimated."""
    instruments: Sequence[str] = ()  # logged columns from outside the loop: sticks, setpoints
    kept: bool = True  # whether the folder stays after the training
    verbose: bool = False  # whether all tables are said

    def __post_init__(self) -> None:
        self.folder, self.quiet = Path(self.run_dir), self.say is False
        compiles = model_kind(self.spec.kind).compiles
        # a fit by innovations samples too little to pay for it: a minute of compiler for some seconds
        compiles = compiles and (self.options.compile == "on" or self.loss.kind != "innovations")
        self.compile = self.options.compile != "off" and compiles
        self.smoothing = smoothing_width(self.split.train, len(self.data.input_names))
        self.filter_reach = self.spec.filter_reach

    def run(self) -> dict[str, Any]:
        """Train, calibrate, test and write; returns what `metrics.json` holds.

        A DataError where the data cannot be used, a NonFiniteError where the optimisation left the finite numbers.
        """
        if not self.split.train:
            raise DataError("no run to train on.")
        started = time.perf_counter()
        self._say(str(self.data.summary) if self.verbose else self.data.summary.short)
        self._say_split()
        if self.split.test and not horizons_of(self.split.test, self.spec.dt):
            names = ", ".join(run.name for run in self.split.test)
            least = all_horizons(self.split.test[0].pace, self.spec.dt)[0]
            raise DataError(
                f"the test runs ({names}) are too short for a horizon of {least:g} s; hold out longer ones."
            )
        fit: Fitted = model_kind(self.spec.kind).fit(
            self._task(self.split.train, self.seed, "train", self.options)
        )
        model, p = fit.model, fit.progress
        fitted = time.perf_counter()
        ended = "validation no longer fell" if p.stopped else "all steps done"
        self._say(
            fit.said
            or f"fitted: {p.step} steps in {fitted - started:.0f} s ({ended}); kept step {p.best_step}, "
            f"validation {p.best_score:.4f}"
            + (f"; then {p.polished} steps on all windows" if p.polished else "")
        )
        if self.verbose and fit.details:
            self._say(f"\n{fit.details}")
        save(model, self.folder, about={"calibrated": False, **(self.about or {})})
        calibration = self._calibrate(fit)
        loop = {} if "feedback" in fit.facts else self._feedback(model)
        if model.capabilities.knows_feedback:
            loop["replayed_inputs"] = self._learn_feedback(model)
        metrics: dict[str, Any] = {
            "system": self.spec.system,
            "model": self.spec.kind,
            "loss": self.loss.kind,
            "seed": self.seed,
            "steps": p.step,
            "best_step": p.best_step,
            "polish_steps": p.polished,
            "validation": {"score": p.best_score, "unit": "share of the error scale"},
            "seconds": {"fit": fitted - started, "calibration": time.perf_counter() - fitted},
            "calibration": calibration,
            "clock_scale": float(model.clock_scale),
            "input_smoothing_s": self.smoothing,
            "input_filter": {"reach_steps": self.filter_reach, "reach_s": self.filter_reach * self.spec.dt},
            "train_runs": [run.name for run in self.split.train],
            **seen.record(self.split.train),
            "train_sensor_std": self._of_states(sensor_std(self.split.train).tolist()),
            "test_runs": [run.name for run in self.split.test],
            "data_fingerprint": self.data.fingerprint,
            "parameters": fit.parameters(),
            "loss_options": asdict(self.loss),
            "trainer_options": asdict(self.options),
            **loop,
            **fit.facts,
        }
        if learns_sensors(model):
            metrics["sensor_std"] = self._of_states(model.measurement_std.tolist())
        save(model, self.folder, about=self.about)
        if self.split.test:
            metrics["test"] = self._test(model)
        self._write(model, metrics, p)
        metrics["seconds"]["total"] = time.perf_counter() - started
        (self.folder / METRICS).write_text(json_text(metrics))
        self._conclude(metrics)
        return metrics

    # ---- stages ---------------------------------------------------------------------------------------

    def _task(
        self, runs: Sequence[Run], seed: int, name: str, options: TrainerOptions, near: Fitted | None = None
    ) -> Task:
        clock = of_runs(self.data.summary.slopes, [r.name for r in runs], measured=self.data.clock_scale)
        return Task(
            spec=self.spec,
            runs=runs,
            seed=seed,
            name=name,
            loss=self.loss,
            options=options,
            validation=self.validation,
            clock=clock,
            values=self.values or {},
            device=torch.device(self.device),
            dtype=self.dtype,
            checkpoint=self.folder / "checkpoints" / name.replace(" ", "_"),
            log=self._scalars(name),
            instruments=self.instruments,
            quiet=self.quiet,
            near=near,
        )

    def _feedback(self, model: Model) -> dict[str, Any]:
        """What the training runs say of the loop that they were recorded in."""
        if not (model.capabilities.is_equation and model.capabilities.has_physics):
            return {}
        system, clock = copy.deepcopy(model.system).cpu(), float(model.clock_scale)
        if not self.instruments:
            found = feedback_summary(system, self.split.train, clock)
            told, out = found.findings, {"feedback": found.as_dict()}
        else:
            known = identify_in_loop(system, self.split.train, clock=clock, instruments=self.instruments)
            told, out = known.of_the_loop, {"identification_in_loop": known.as_dict()}
            if known.loop is not None:
                out["feedback"] = known.loop.as_dict()
        for sentence in told:
            self._say(f"feedback: {sentence}")
        return out

    def _learn_feedback(self, model: Model) -> dict[str, Any]:
        assert is_equation(model)
        found = learn_feedback(model, self.split.train, seed=self.seed)
        if found["kept"]:
            self._say(
                "learned: how logged inputs answer the state; predictions under them read from it what disturbed the "
                f"machine (CRPS x{1 + found['crps']:.2f} on the training runs)"
            )
        return found

    def _calibrate(self, fit: Fitted) -> dict[str, Any]:
        model = fit.model
        if not self.options.calibrate or self.loss.kind == "paper" or not is_stochastic(model):
            return {"factor": 1.0}
        runs, numbers = self.split.train, self._numbers(fit)
        coverage = Coverage(model, runs, seed=self.seed, compile=self.compile, numbers=numbers)
        fitted, new = coverage.log_factor(), []
        steps = max(1, round(self.options.steps * _AUXILIARY_SHARE))
        short = replace(self.options, steps=steps, decay_steps=None)
        count = min(len(runs), _LEFT_OUT) if len(runs) > 1 and not numbers else 0
        turns = [round(i) for i in torch.linspace(0, len(runs) - 1, count).tolist()]
        bar = tqdm(turns, desc="calibrating", unit="run", disable=no_bar(self.quiet), leave=False)
        for turn, k in enumerate(bar):
            others = [run for i, run in enumerate(runs) if i != k]
            # of seeds of its own: what runs left out say of sigma is the same for all jobs of a sweep
            task = self._task(others, _AUXILIARY_SEED + turn, f"calibrate {turn + 1} of {count}", short, fit)
            key = ("left out", task.identity, task.before_seed, runs[k].content_hash)
            try:
                new.append(recall(key, partial(self._left_out, task, runs[k])))
            except (DataError, NonFiniteError) as error:
                self._say(f"calibration without {runs[k].name!r} left out: {error}")
        total = extrapolate(fitted, new, len(runs))
        with torch.no_grad():
            model.h.log_sigma_max.add_(total)
        factor = math.exp(total)
        self._say(
            f"calibrated: sigma times {factor:.2f} (right on the fitted runs at {math.exp(fitted):.2f}"
            + (", on a run left out at " + ", ".join(f"{math.exp(f):.2f}" for f in new) if new else "")
            + (", each with its own numbers" if numbers else "")
            + ")"
        )
        if falls_short(fitted):
            self._say(
                "warning: by no factor up to that do intervals hold 90 % of the fitted runs: they are too narrow"
            )
        return {"factor": factor, "fitted": math.exp(fitted), "left_out": [math.exp(f) for f in new]}

    def _left_out(self, task: Task, run: Run) -> float:
        """log of the factor at which intervals of a fit to other runs hold as much of a run as they should."""
        auxiliary = model_kind(self.spec.kind).fit(task).model
        assert is_stochastic(auxiliary)
        return Coverage(auxiliary, [run], seed=0, compile=self.compile).log_factor()

    @staticmethod
    def _numbers(fit: Fitted) -> dict[str, list[float]]:
        """What differs in each run, by its name, in standard deviations; empty where nothing does."""
        out: dict[str, list[float]] = {}
        for found in fit.facts.get("between_runs", {}).values():
            for name, each in found["of_runs"].items():
                out.setdefault(name, []).extend(n / s for n, s in zip(each, found["std"], strict=True))
        return out

    def _test(self, model: Model) -> dict[str, Any]:
        std = None
        if self.other_sensors and learns_sensors(model):
            ratio = sensor_std(self.split.test) / sensor_std(self.split.train).clamp_min(1e-12)
            std = model.measurement_std * ratio.to(model.measurement_std)
        result = evaluate(model, self.split.test, seed=self.seed, compile=self.compile, measurement_std=std)
        if std is not None:
            self._say(
                "the test runs come from another file: their sensor noise is taken from their own fourth "
                "differences, nothing else of them is used"
            )
            result["sensor_std"] = self._of_states(std.tolist())
        return result

    def _of_states(self, values: Sequence[float]) -> dict[str, float]:
        return dict(zip(self.data.state_names, values, strict=True))

    def _write(self, model: Model, metrics: dict[str, Any], progress: Progress) -> None:
        from nsde_torch.evaluation.figures import write_figures

        figures = write_figures(
            self.folder / "plots",
            model,
            self.data,
            train=self.split.train,
            test=self.split.test,
            metrics=metrics,
            history=progress.history,
            seed=self.seed,
            note=self.note(),
        )
        from torch.utils.tensorboard import SummaryWriter

        with SummaryWriter(str(self.folder / "tensorboard")) as writer:
            for name in figures:  # as they were drawn: to draw them again takes as long as the first time
                image = _picture(name, self.folder / "plots" / f"{name}.png")
                writer.file_writer.add_summary(image, progress.step)
            for group, by_horizon in metrics.get("test", {}).get("errors", {}).get("model", {}).items():
                for horizon, value in by_horizon.items():
                    writer.add_scalar(f"test/{group}_{horizon}s", value, progress.step)
        (self.folder / "data_summary.json").write_text(self.data.summary.to_json())

    def note(self) -> str:
        """What the inputs of a rollout see of the future, in words; empty if nothing."""
        return report.lookahead(self.smoothing, self.filter_reach * self.spec.dt)

    # ---- text -----------------------------------------------------------------------------------------

    def _say(self, text: str) -> None:
        if self.say is not False:
            self.say(text)

    def _say_split(self) -> None:
        train, test = ([run.name for run in side] for side in (self.split.train, self.split.test))
        self._say(f"training on {report.listed(train)}; testing on {report.listed(test)}")
        if self.note():
            self._say(f"note: {self.note()}")

    def _conclude(self, metrics: Mapping[str, Any]) -> None:
        if metrics["parameters"] and "identification" not in metrics:
            self._say("\n" + report.parameter_table(metrics["parameters"]))
        test = metrics.get("test")
        if test and test["errors"]:
            noisy = any(value > 0 for by in test["spread"].values() for value in by.values())
            starts = (
                f"{report.listed(metrics['test_runs'])}; {test['starts']} starts, {test['diverged']} diverged"
            )
            tables = [f"held out: {starts}\n{report.short_table(test, noisy=noisy)}"]
            if self.verbose:
                tables = [
                    f"Held-out runs: {starts}",
                    one_step_table(test["one_step"]) if test["one_step"] else "",
                ]
                tables.append(report.error_table(test))
                tables.append(report.coverage_table(test) if noisy else report.NO_INTERVALS)
            self._say("\n" + "\n\n".join(filter(None, tables)))
        if self.note():
            self._say(f"\nnote: {self.note()}")
        wrote = f"; wrote {self.folder}" if self.kept else ""
        more = "" if self.verbose else "; verbose=true prints all tables"
        self._say(f"\ntook {metrics['seconds']['total']:.0f} s{wrote}{more}")

    def _scalars(self, name: str) -> Callable[[int, dict[str, float]], None]:
        from torch.utils.tensorboard import SummaryWriter

        writer: list[SummaryWriter] = []

        def log(step: int, row: dict[str, float]) -> None:
            if not writer:
                writer.append(SummaryWriter(str(self.folder / "tensorboard" / name.replace(" ", "_"))))
            for key, value in row.items():
                if key != "step" and math.isfinite(value):
                    writer[0].add_scalar(key, value, step)
            writer[0].flush()

        return log


def _picture(name: str, path: Path) -> Any:
    """A PNG file as tensorboard takes it, which counts colours: red, green, blue and how opaque they are."""
    from tensorboard.compat.proto.summary_pb2 import Summary

    content = path.read_bytes()
    width, height = struct.unpack(">II", content[16:24])  # its header stands first
    image = Summary.Image(height=height, width=width, colorspace=4, encoded_image_string=content)
    return Summary(value=[Summary.Value(tag=name, image=image)])


# ---- the controller of the training runs ---------------------------------------------------------------
#
# Its law is fitted by least squares (`models.feedback_model`). Whether it is kept is decided by what it is for: the
# fair CRPS of predictions of the training runs with it, less that without it, as a share of the latter, must fall by
# more than two standard errors. In open loop, and where setpoints rule all, it does not.

_STARTS, _PARTICLES = 128, 49
_LONGEST_S = 1.0  # predictions from starts that are nearer to one another are not independent either
_SURE = 2.0  # standard errors; the built-in carts, in open loop, have -0.0003 +- 0.0054


@torch.no_grad()
def learn_feedback(model: NeuralSDE, runs: Sequence[Run], *, seed: int) -> dict[str, Any]:
    """Learn the controller of some runs, or take it out of the model.

    What `metrics.json` holds: `kept`, and, where the runs are long enough, `crps`: the change of the score as a share,
    and `standard_error`.
    """
    made, dt = fit_feedback(model, runs, model.spec.feedback), model.spec.dt
    longest = _LONGEST_S * decade(runs[0].pace, dt)
    steps = [round(h / dt) for h in horizons_of(runs, dt) if h <= longest and h > model.spec.feedback * dt]
    asked, like = model.spec, model.clock_scale
    model.feedback, model.spec = None, replace(asked, feedback=0)
    if made is None or not steps:
        return {"kept": False}
    windows = Windows(runs, dt, steps[-1], dtype=like.dtype, device=like.device)
    starts = start_grid(windows)
    if windows.interventional or len(starts) < 2:
        return {"kept": False}
    independent = len(starts) * start_every(windows.pace, windows.dt) / longest
    starts = thinned(starts, _STARTS)
    given: dict[str, Any] = {"seed": seed, "particles": _PARTICLES}
    without = score(model, windows, starts, steps, **given)
    model.feedback = made
    beside = score(model, windows, starts, steps, **given)
    mean = error = 0.0
    if not beside.diverged and not without.diverged:
        scale = without.crps.mean(0).clamp_min(1e-12)
        change = ((beside.crps - without.crps) / scale).mean((1, 2))  # of each start
        mean = float(change.mean())
        error = float(change.std()) / min(len(change), independent) ** 0.5
    kept = mean < -_SURE * error
    model.feedback, model.spec = (made, asked) if kept else (None, model.spec)
    return {"kept": kept, "crps": mean, "standard_error": error}
