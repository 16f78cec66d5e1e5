"""The controller in C: built without a warning, equal to the one in Python, or refused with the reason."""

import functools
import math
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from nsde_torch.control.autopilots import EstimatorOptions, PredictivePilot
from nsde_torch.control.codegen import scalar
from nsde_torch.control.compiled import compiler
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.reference import Reference
from nsde_torch.effects.registry import effects_of
from nsde_torch.errors import ExportError
from nsde_torch.export import c_file, verify
from nsde_torch.export.exported import ExportedController
from nsde_torch.export.step import STATUS
from nsde_torch.export.write import controller_of
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.systems import Multirotor, System, make_system
from tests.helpers.exported import all_kinds, flight, made_with, word_of, written
from tests.helpers.hexacopters import VALUES

needs_compiler = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Werror")
ESTIMATOR = EstimatorOptions(latency=0.04, force_time=0.3, moment_time=0.2)
MADE_WITH = made_with()


def _run(*words: str) -> str:
    """What a program prints that ends well."""
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def _compared(
    known: NeuralSDE | System, folder: Path, path: Reference, states: int, **options: object
) -> verify.Verification:
    """What C and Python make of states along a path."""
    file, out = folder / "controller.c", verify.Verification()
    given = made_with(**options)  # type: ignore[arg-type]
    controller = controller_of(known, **given)
    exported = ExportedController(written(known, file, kind="c", estimator=ESTIMATOR, **given))
    verify.compare(exported, controller, verify.along(exported, path, states, period=0.02), out, elapsed=0.02)
    return out


@pytest.fixture(scope="module")
def file(declared: System, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A controller on declared physics in double precision."""
    path = tmp_path_factory.mktemp("c") / "controller.c"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", "0")
        return written(declared, path, kind="c", estimator=ESTIMATOR, **MADE_WITH)


# ---- expressions ----------------------------------------------------------------------------------------


def _valued(outputs: Sequence[scalar.Number], tables: dict[str, Tensor]) -> list[float]:
    """Values of scalars at given inputs."""
    made: dict[int, float] = {}

    def value(x: scalar.Number) -> float:
        return x if isinstance(x, float) else made[id(x)]

    plain = {"add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b}
    more = {"div": lambda a, b: a / b, "neg": lambda a: -a, "clamped": lambda x, a, b: min(max(x, a), b)}
    rules = {**plain, **more, "where": lambda c, a, b: a if c else b}
    for x in scalar.in_order(outputs):
        if x.op == "input":
            made[id(x)] = float(tables[x.data[0]].flatten()[x.data[1]])
        else:
            rule = rules.get(x.op, functools.partial(scalar.call, x.op))
            made[id(x)] = rule(*map(value, x.args))
    return [value(x) for x in outputs]


@pytest.mark.parametrize(
    "effect", sorted(set(effects_of("hexacopter", Multirotor.ports)) - {"battery_voltage"})
)
def test_a_step_and_its_slopes_are_those_of_torch_whatever_the_effect(effect: str) -> None:
    system = make_system("hexacopter", effects=[effect], values=VALUES)
    g = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in system.parameters():
            parameter += 0.2 * torch.rand(parameter.shape, generator=g, dtype=parameter.dtype)
    p = Predictor(system, dt=0.05, dtype=torch.float64)

    def draw(n: int) -> Tensor:
        return 0.1 + 0.8 * torch.rand(1, n, generator=g, dtype=torch.float64)

    tables = {"z": draw(p.nz), "u": draw(p.nu), "d": draw(p.nd)}
    tables["z"][:, 6:10] /= tables["z"][:, 6:10].norm()
    given = [scalar.inputs(name, *t.shape) for name, t in tables.items()]
    (after,) = scalar.run(lambda z, u, d: (p(z, u, d),), given)
    rows = scalar.jacobian(list(after[0]), [*given[0][0], *given[1][0]])
    found = _valued(list(after[0]), tables)
    assert found == pytest.approx(p(*tables.values())[0].tolist(), abs=1e-12)
    n = p.nz + p.nu
    slopes = torch.zeros(p.nz, n, dtype=torch.float64)
    for i, row in enumerate(rows):
        slopes[i, list(row)] = torch.tensor(_valued(list(row.values()), tables), dtype=torch.float64)
    exact = torch.func.jacfwd(lambda x: p(x[None, : p.nz], x[None, p.nz :], tables["d"])[0])(
        torch.cat((tables["z"][0], tables["u"][0]))
    )
    assert torch.allclose(slopes, exact, atol=1e-11)
    assert sum(map(len, rows)) < 0.9 * slopes.numel()


def _with_branches(x: Tensor) -> tuple[Tensor, ...]:
    a, b, c = x.unbind(1)
    chosen = torch.where(a > 0.5, torch.sqrt(a - 0.5), b * c)
    rest = torch.atan2(a, c).abs() - torch.asinh(b) / (1.0 + a * a) + torch.sigmoid(c) ** 2.5
    return (torch.stack((chosen, torch.maximum(a, b), torch.minimum(b, c), a.clamp(0.2, 0.3), rest), 1),)


@pytest.mark.parametrize("row", [[0.2, 0.7, -0.4], [0.9, -0.3, 0.6], [0.4, 0.4, 0.4], [0.3, 0.1, 0.2]])
def test_branches_have_the_slopes_that_torch_gives_them(row: list[float]) -> None:
    x = torch.tensor([row], dtype=torch.float64)
    given = scalar.inputs("x", 1, 3)
    (made,) = scalar.run(_with_branches, [given])
    assert _valued(list(made[0]), {"x": x}) == pytest.approx(_with_branches(x)[0][0].tolist())
    exact = torch.func.jacfwd(lambda v: _with_branches(v[None])[0][0])(x[0])
    rows = scalar.jacobian(list(made[0]), list(given[0]))
    for slopes, wanted in zip(rows, exact.tolist(), strict=True):
        values = dict(zip(slopes, _valued(list(slopes.values()), {"x": x}), strict=True))
        assert [values.get(k, 0.0) for k in range(3)] == pytest.approx(wanted)


# ---- files ----------------------------------------------------------------------------------------------


@needs_compiler
@pytest.mark.parametrize("precision", ["NSDE_DOUBLE", "NSDE_FLOAT"])
def test_a_file_compiles_without_a_warning_and_calls_nothing_but_libm(
    file: Path, tmp_path: Path, precision: str
) -> None:
    made = tmp_path / "controller.o"
    _run(str(compiler()), *c_file.FLAGS, *WARNINGS, f"-D{precision}", "-c", str(file), "-o", str(made))
    if shutil.which("nm"):
        used = {line.split()[-1].partition("@")[0] for line in _run("nm", "-u", str(made)).splitlines()}
        numbers = {name + end for name in ("sqrt", "acos", "exp", "sin", "cos") for end in ("", "f")}
        assert used <= numbers | {"_GLOBAL_OFFSET_TABLE_", "memcpy", "memmove", "memset", "__stack_chk_fail"}


def test_a_file_compiles_for_a_cortex_m7(file: Path, tmp_path: Path) -> None:
    cross = shutil.which("arm-none-eabi-gcc")
    if cross is None:
        pytest.skip("needs arm-none-eabi-gcc")
    chip = ("-mcpu=cortex-m7", "-mthumb", "-mfpu=fpv5-d16", "-mfloat-abi=hard")
    made = str(tmp_path / "c.o")
    _run(cross, *c_file.FLAGS, *WARNINGS, *chip, "-DNSDE_FLOAT", "-c", str(file), "-o", made)


def test_the_header_says_what_a_user_has_to_know_and_the_same_controller_makes_the_same_bytes(
    file: Path, declared: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    header = file.with_suffix(".h").read_text()
    for part in (
        "world ENU, body FLU, quaternion w x y z",
        "p_x [m]",
        "w_z",
        "[rad/s]",
        "u_6, within [0, 1]",
        "body_moment, 3 axes [m/s2, rad/s2]",
        " 0  converged",
        f" {len(STATUS) - 1}  diverged, hover",
        "#define NSDE_STEPS 6",
        "for 0.5 s at most",
    ):
        assert part in header
    record = c_file.read(file)
    assert record["kind"] == "c"
    assert record["model"]["weights_sha256"] in header
    assert record["estimator"]["force_time"] == 0.3
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    again = tmp_path / "controller.c"
    written(declared, again, kind="c", estimator=ESTIMATOR, **MADE_WITH)
    assert again.read_bytes() == file.read_bytes()
    assert again.with_suffix(".h").read_text() == header


def test_files_that_were_changed_or_are_alone_are_refused(file: Path, tmp_path: Path) -> None:
    other = tmp_path / "controller.c"
    shutil.copy(file, other)
    with pytest.raises(ExportError, match=r"no file .*controller\.h"):
        ExportedController(other)
    header = file.with_suffix(".h").read_text()
    for old, new in (("typedef float", "typedef double"), ('"keep": 0.5', '"keep": 9.5')):
        assert old in header
        other.with_suffix(".h").write_text(header.replace(old, new))
        with pytest.raises(ExportError, match="was changed after it was written"):
            ExportedController(other)
    other.with_suffix(".h").write_text("#define NSDE_NX 13\n")
    with pytest.raises(ExportError, match="holds no record"):
        ExportedController(other)
    other.with_suffix(".h").write_text(header)
    other.write_text(file.read_text().replace("R(0.005)", "R(0.5)"))
    with pytest.raises(ExportError, match="was changed after it was written"):
        ExportedController(other)


def test_without_a_compiler_a_file_says_what_it_needs(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no_such_compiler")
    with pytest.raises(ExportError, match=r"needs a C compiler.*apt install gcc"):
        ExportedController(file)


# ---- plans ----------------------------------------------------------------------------------------------


@needs_compiler
def test_sample_after_sample_c_does_what_the_controller_does(
    file: Path, declared: System, path: Reference
) -> None:
    exported, words = ExportedController(file), set()
    controller = controller_of(declared, **MADE_WITH)
    for arguments, plan in flight(controller, path):
        out = exported.step(*arguments)
        words.add(word_of(out, plan, most=1e-8))
        assert math.isinf(float(plan.cost)) or float(out[5]) == pytest.approx(float(plan.cost))
    assert all_kinds(words)


def _lagging() -> System:
    return make_system("hexacopter", effects=["motor_lag", "linear_drag"], values=VALUES)


def _untrained(physics: bool) -> NeuralSDE:
    spec = SDESpec("hexacopter", dt=0.05, horizon=20, step="milstein", physics=physics)
    return NeuralSDE(spec, generator=torch.Generator().manual_seed(1)).eval().requires_grad_(False)


@needs_compiler
@pytest.mark.parametrize(
    ("known", "options", "most"),
    [
        ("model", {}, 1e-8),
        (_lagging, {}, 1e-8),
        (lambda: _untrained(False), {}, 1e-7),
        (lambda: _untrained(True), {"uncertainty_weight": 5.0}, 1e-7),
        ("declared", {"dtype": torch.float32}, verify.SINGLE_TOLERANCE),
    ],
    ids=["networks", "effects that remember", "a black box", "a distance", "single precision"],
)
@pytest.mark.slow
def test_c_plans_as_python(
    known: Any, options: dict[str, Any], most: float, path: Reference, tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:  # fmt: skip
    machine = request.getfixturevalue(known) if isinstance(known, str) else known()
    out = _compared(machine, tmp_path, path, 6, **options)
    assert out.worst < most
    assert not out.differing
    if known == "model":
        source = (tmp_path / "controller.c").read_text()
        assert source.count("static void network_") == 2  # one a port, and no third for the prediction
    if known is _lagging:
        assert "#define NSDE_NZ 19" in (tmp_path / "controller.h").read_text()


@needs_compiler
@pytest.mark.slow
def test_the_estimator_in_c_flies_as_the_one_in_python(file: Path, declared: System, path: Reference) -> None:
    exported, out = ExportedController(file), verify.Verification()
    controller = controller_of(declared, **MADE_WITH)
    pilot = PredictivePilot(controller, declared, path, period=0.02, sample=0.01, estimator=ESTIMATOR)
    states = [x for x, _ in verify.along(exported, path, 20, period=0.02)]
    states[7] = states[7] * torch.nan
    states[12] = states[12] + torch.tensor([5.0, *(0.0,) * 12])
    verify.compare_estimators(exported, pilot, states, out)
    assert out.estimated == 20
    assert out.estimated_worst < 1e-8
    assert not out.differing


@needs_compiler
def test_whatever_it_is_given_an_answer_is_finite_and_within_bounds(file: Path, path: Reference) -> None:
    out = verify.Verification()
    verify.attack(ExportedController(file), path, 400, out)
    assert out.adversarial == 400
    assert not out.unsafe
