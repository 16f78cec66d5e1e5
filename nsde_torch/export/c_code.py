"""The controller as plain C: a source file and its header.

What is written by hand meets the solver and the estimator of `control.codegen` in `templates/controller.c`: the plan,
its checks and its fallback are those of `step`, as loops over arrays of fixed sizes.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

from nsde_torch.control.autopilots import Estimator
from nsde_torch.control.codegen import scalar
from nsde_torch.control.codegen.code import Networks, function, number
from nsde_torch.control.codegen.sources import estimator, put, scalars, solver, template
from nsde_torch.control.options import EstimatorOptions, ProblemOptions
from nsde_torch.control.reference import at_rest
from nsde_torch.errors import ConfigError, ExportError
from nsde_torch.export.step import ExportedStep

_TEMPLATES = Path(__file__).parent / "templates"
_FLIGHT = """\
    nsde_real rates[3];                    /* body rates that the plan expects one step ahead [rad/s] */
    nsde_real thrust;                      /* mean of the first commands */
    nsde_real lift[NSDE_STEPS];            /* thrust over mass along the body's z axis, by step [m/s2] */
"""


def sources(
    step: ExportedStep, name: str, about: Mapping[str, Any], options: EstimatorOptions
) -> tuple[str, str]:
    """Source and header named so, whose last lines await the record `about` in the place of `@RECORD@`.

    A ConfigError refuses a plan over several paths, or names and times that cannot be; an ExportError a model with an
    operation that is not known in C.
    """
    if step.sizes.particles > 1:
        raise ConfigError(
            f"`format=c` plans along the mean path; got mpc.particles={step.sizes.particles}. Take mpc.particles=1, or "
            "format=torchscript."
        )
    if not re.fullmatch(r"\w+", name):
        raise ConfigError(f"a C file is named by letters, digits and _; got {name!r}.")
    times = Estimator(step.sample, options, period=about["period_s"])
    try:
        with scalar.of_their_own():
            networks = Networks()
            parts = solver(step.method, networks)
            for_step = _functions(step, networks)
            parts |= estimator(times, step.sample, networks)
    except ExportError as error:
        raise ExportError(f"{error} Take format=torchscript.") from error
    s, system = step.sizes, step.predictor.system
    units = {entry["name"]: entry["unit"] for entry in about["step"]["inputs"]}
    status = [f"   {k:2d}  {word.replace(':', ', ')}" for k, word in enumerate(about["status"])]
    values: dict[str, Any] = {
        **about,
        **parts,
        **vars(s),
        **{k: number(float(v)) for k, v in vars(step.safety).items()},
        "unit": number(float(step.safety.quaternion)),
        "quaternion": -1 if step.quaternion is None else step.quaternion.start,
        "flies": int(s.flies),
        "flight": _FLIGHT if s.flies else "",
        "origin": ", ".join(map(number, at_rest(system, step.dtype).tolist())),
        "at_rest": about["status"][-1].partition(":")[2],
        "anew": step.loops.anew,
        "tolerance": number(step.loops.tolerance),
        "PREDICTION": "\n".join((*for_step, parts["PREDICTION"])),
        "NAME": name,
        "VERSION": about["versions"]["nsde_torch"],
        "keep_s": step.safety.keep,
        "hover": ", ".join(map(number, about["hover"])),
        "iterations": step.loops.iterations,
        "system": system.name,
        "memory": s.nz - s.nx,
        "model_sha256": about["model"]["weights_sha256"],
        "past": times.past,
        "ahead": times.ahead,
        "state_doc": _listed(f"{n} [{unit}]" for n, unit in zip(system.state_names, system.state_units, strict=True)),
        "input_doc": _listed(_boxed(step.options, system.input_names)),
        "push_doc": _listed(
            f"{port.value}, {width} {'axis' if width == 1 else 'axes'}" for port, width in step.predictor.ports.items()
        )
        + f" [{units['push']}]",
        "status_doc": "\n".join(status),
    }  # fmt: skip
    source, header = (template(_TEMPLATES / f"controller.{end}", values) for end in "ch")
    return source, header


def _functions(step: ExportedStep, networks: Networks) -> list[str]:
    """What the step asks of the model beside the solver."""
    p, sizes = step.predictor, {"x": step.sizes.nx, "u": step.sizes.nu}
    (augmented,) = scalars(lambda x, u: (p.augment(x, u),), sizes, step.dtype)[1]
    augment = "static void augment(const real *x, const real *u, real *out)"
    made = [function(augment, put("out", augmented), networks)]
    if (flown := step.multirotor) is not None:
        (lift,) = scalars(lambda x, u: (flown.quantity("thrust", x, u),), sizes, step.dtype)[1]
        made.append(function("static real lift(const real *x, const real *u)", [("", lift[0])], networks))
    return [*networks.code(), *made]


def _boxed(options: ProblemOptions, names: Sequence[str]) -> list[str]:
    """Inputs with their bounds, which are said once where they are those of all."""
    ends = zip(*(options.of_inputs(k, names) for k in ("low", "high")), strict=True)
    within = [f"within [{low:g}, {high:g}]" for low, high in ends]
    if len(set(within)) == 1:
        return [*names[:-1], f"{names[-1]}, {within[0]}"]
    return [f"{name} {words}" for name, words in zip(names, within, strict=True)]


def _listed(words: Iterable[str]) -> str:
    return fill(", ".join(words), width=100, subsequent_indent=" " * 14)
