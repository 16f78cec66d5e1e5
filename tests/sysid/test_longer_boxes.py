"""A fit whose noise model learned a friction is made again over longer boxes, and says so; others stay as they are."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, filtfilt

import nsde_torch
from nsde_benchmarks.public.emps import PositioningDrive
from nsde_torch.data import DataSet, RawRun
from nsde_torch.errors import DataError
from nsde_torch.recording import assemble
from nsde_torch.sysid import Identification, identify_in_loop
from nsde_torch.sysid.guard import Guarded, Objection, asks_for_longer_boxes
from nsde_torch.sysid.identify import in_longer_boxes

STEP = 1e-3
GAIN, VISCOUS, DRY, PUSH = 0.02, 2.0, 0.3, 0.05


def axis(seconds: float, slip: float, seed: int) -> DataSet:
    """A carriage under a controller, whose friction gives way over `slip` [m] (Dahl), logged as users do."""
    rng = np.random.default_rng(seed)
    inner, n = 20, round(seconds / STEP)
    h, q, v, share = STEP / inner, 0.0, 0.0, 0.0
    legs = rng.uniform(0.3, 1.0, 2 * round(seconds)) * 0.15 * np.resize((1, 1, -1, -1), 2 * round(seconds))
    wanted = np.cumsum(np.repeat(legs, 500)[:n]) * STEP
    log = np.empty((n, 3))
    for k in range(n):
        force = 60.0 / GAIN * (30.0 * (wanted[k] - q) - v)
        log[k] = q, v, force
        for _ in range(inner):
            share += h * v / slip * (1.0 - share * np.sign(v))
            v += h * (GAIN * force - VISCOUS * v - DRY * share + PUSH)
            q += h * v
    place = filtfilt(*butter(4, 0.2), np.round(log[:, 0] / 1e-6) * 1e-6)
    x = np.stack((place, np.gradient(place, STEP)), 1)[50:-50]
    run = RawRun("axis", STEP * np.arange(len(x)), x, log[50:-50, 2:])
    return assemble([run], PositioningDrive(), kind="simulated")


def identified(data: DataSet, **further: Any) -> Identification:
    system = PositioningDrive(["coulomb_friction", "constant_force"])
    return identify_in_loop(system, data.runs, **further)


def test_a_friction_that_the_noise_model_learned_comes_out_of_longer_boxes() -> None:
    found = identified(axis(14.0, slip=5e-4, seed=3))
    assert found.finer.guard is not None
    label = found.vector.labels.index
    dry = label("coulomb_friction.size")
    true = {label("force_gain"): GAIN, label("viscous_friction.damping"): VISCOUS, dry: DRY}
    true[label("constant_force.acceleration")] = PUSH
    errors = {j: abs(found.values[j] / value - 1.0) for j, value in true.items()}
    assert abs(found.finer.values[dry] / DRY - 1.0) > 0.3 > 0.15 > max(errors.values())
    assert np.isnan(found.finer.half_widths(0.9)).all()
    assert found.box_s == pytest.approx(0.05)
    assert found.believed
    assert (found.half_widths(0.9)[found.shown.known] > found.doubt[found.shown.known]).all()
    (warning,) = found.warnings
    assert "means over 0.05 s are fitted" in warning
    assert "least squares" in warning
    told = found.as_dict()["finer"]
    assert told["box_s"] == pytest.approx(0.01)
    assert told["guard"]["objections"][0]["kind"] == "least_squares"


def test_a_friction_that_is_as_declared_needs_none() -> None:
    assert identified(axis(8.0, slip=1e-5, seed=4)).finer is None


def _objecting(*kinds: str) -> Guarded:
    return Guarded(tuple(Objection(kind, "this is so", "do that") for kind in kinds))


@pytest.mark.parametrize(
    ("kinds", "asks"),
    [((), False), (("least_squares",), True), (("gone",), True), (("reading",), False), (("worse",), False)],
)
def test_what_is_wrong_with_the_log_is_not_mended_by_longer_boxes(kinds: tuple[str, ...], asks: bool) -> None:
    assert asks_for_longer_boxes(_objecting(*kinds)) is asks


def test_longer_boxes_are_refused_where_they_are_not_believed_either_or_do_not_fit() -> None:
    sound = identified(axis(8.0, slip=1e-5, seed=4))
    doubted = replace(sound, guard=_objecting("least_squares"))
    assert in_longer_boxes(doubted, lambda box_s: doubted) is doubted

    def too_short(box_s: float) -> Identification:
        raise DataError("no stretch is long enough")

    assert in_longer_boxes(doubted, too_short) is doubted
    taken = in_longer_boxes(doubted, lambda box_s: replace(sound, values=sound.values * (1.0 + box_s)))
    assert taken.finer is doubted
    assert taken.doubt is not None
    assert taken.doubt == pytest.approx(
        0.15 * np.abs(sound.values) + (0.0 if sound.doubt is None else sound.doubt)
    )


@pytest.mark.slow
def test_a_diagnosis_looks_at_rows_further_apart_where_only_these_are_as_predicted() -> None:
    names = ("coulomb_friction", "constant_force", "asymmetric_friction", "cubic_stiffness")
    found = nsde_torch.diagnose(
        axis(28.0, slip=5e-4, seed=3), system=PositioningDrive, candidates=list(names)
    )
    assert found.added == ["coulomb_friction", "constant_force"]
    joint = found.outcome.joint
    assert joint.final.at.of.space.every == [10, 10]  # rows of 5 ms, as taken together
    assert not joint.final.best.misfit
    content = found.content()
    assert content["guard"]["objections"] == []
    # a friction that gives way is no function of the speed: its size is rough, and a lead
    assert content["parameters"]["coulomb_friction.size"]["value"] == pytest.approx(DRY, rel=0.5)
    assert all(f["lead"] for f in content["findings"])
