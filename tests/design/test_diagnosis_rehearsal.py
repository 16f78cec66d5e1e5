"""A diagnosis rehearsed: what was found is simulated and found again, and all of it is told."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.design.diagnosis_rehearsal import Rehearsal, following, rehearse
from nsde_torch.design.members import Branch, Rollouts, as_run, open_loop
from nsde_torch.design.rehearsal import fit_all
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.report import page
from nsde_torch.diagnosis.result import Diagnosis
from nsde_torch.diagnosis.text import rehearsal_lines, sentences
from nsde_torch.errors import ConfigError
from nsde_torch.inference.posterior import LogWithPrior
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import diagnosed
from tests.helpers.ties import DT, Tie


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    options = Options(candidates=("coulomb_friction", "quadratic_damping"))
    return diagnosed("mass_spring_damper", {"coulomb_friction": {"size": 0.5}}, options=options, dt=0.04)[0]


@pytest.fixture(scope="module")
def rehearsal(found: Diagnosis) -> Rehearsal:
    return rehearse(found, logs=2, seed=1)


@pytest.mark.slow
def test_what_was_found_is_found_again_with_values_and_nothing_of_nothing(
    found: Diagnosis, rehearsal: Rehearsal
) -> None:
    own = rehearsal.content()
    assert (own["why_not"], own["logs"], own["inputs"], own["others"]) == (None, 2, "as logged", [])
    assert own["effects"] == {"coulomb_friction": {"sure": 2, "lead": 0, "tied": 0}}
    assert own["of_nothing"] == []
    size = own["parameters"]["coulomb_friction.size"]
    assert size["value"] == pytest.approx(found.parameters["coulomb_friction.size"]["value"], rel=1e-6)
    np.testing.assert_allclose(size["again"], size["value"], rtol=0.15)
    assert len(set(size["again"])) == 2  # noise of its own in each
    assert (size["intervals"], size["unit"]) == (2, "m/s2")


@pytest.mark.slow
def test_it_is_told_in_the_terminal_and_on_the_page(found: Diagnosis, rehearsal: Rehearsal) -> None:
    content = {**found.content(), "rehearsal": rehearsal.content()}
    told = "\n".join(rehearsal_lines(content))
    assert "2 logs were simulated of what was found (inputs as logged) and diagnosed again." in told
    assert "coulomb_friction: found again, surely, in 2 of 2." in told
    assert "Of the declared physics alone nothing is named." in told
    assert "coulomb_friction.size" in told
    section = page(content, {}, width=0.25).partition("<h2>Rehearsed</h2>")[2].partition("<details>")[0]
    assert "<td>coulomb_friction.size</td>" in section
    assert rehearsal_lines({}) == []
    assert "Rehearsed" not in page(found.content(), {}, width=0.25)


@pytest.mark.slow
def test_what_is_named_wrongly_and_what_could_not_be_made_is_told(rehearsal: Rehearsal) -> None:
    none: dict[str, Any] = {"verdict": "no_effect", "findings": [], "added": [], "ties": []}
    none |= {"parameters": {}, "not_shown": []}
    wrong = {**none, "added": ["b"], "findings": [{"name": "b", "kind": "effect", "lead": False}]}
    tied = {**wrong, "ties": [{"effects": ["b", "a + c"]}]}
    own = Rehearsal({"a.size": 1.0}, ("a",), False, (none, tied), wrong).content()
    assert own["effects"] == {"a": {"sure": 0, "lead": 0, "tied": 1}}
    text = " ".join(sentences(own))
    assert "a: found again, surely, in 0 of 2, indistinguishable from another in 1." in text
    assert "Named there, surely, and not simulated: b." in text
    assert "these data would name b: be careful with that name" in text
    failed = replace(rehearsal, again=(), nothing=None, why_not="it leaves")
    assert sentences(failed.content()) == ["rehearsed: not possible: it leaves."]


def test_where_a_fit_is_not_to_be_simulated_it_says_so(
    found: Diagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nsde_torch.design.diagnosis_rehearsal._stays", lambda seen, states, logs: False)
    own = rehearse(found, logs=1)
    assert own.again == ()
    assert "leaves the range of the log" in own.why_not
    with pytest.raises(ConfigError, match="`logs` must be at least 1; got 0"):
        rehearse(found, logs=0)


def test_inputs_that_follow_keep_a_pole_up_which_replayed_ones_lose() -> None:
    system, dt, moving = make_system("cartpole"), 0.02, np.array([[0.1, 0.2, 0.1, 0.5]])
    states = [np.zeros((300, 4)), np.concatenate((moving, -moving))]  # the second says what matters
    inputs = [np.zeros((300, 1)), np.array([[1.0], [-1.0]])]
    rollouts = Rollouts(system, dt=dt)
    theta, start = np.tile(rollouts.vector.start, (2, 1)), np.array([[0.0, 0.0, 0.05, 0.0], [0.0] * 4])
    ways = following(system, states, inputs, dt=dt, copies=1), open_loop(np.zeros((2, 299, 1)))
    follow, replay = (abs(rollouts.run(theta, start, drive, 299)[0][0, -1, 2]) for drive in ways)
    assert follow < 0.01
    assert replay > 0.5


HOLD = np.repeat([[0.1], [-0.1], [0.0]], 25, 0)


def _flown(tie: Tie, seed: int) -> Run:
    """An experiment of the first member in the noise of its sensors."""
    member, rng = tie.members[0], np.random.default_rng(seed)
    rollouts, drive = Rollouts(member.system, dt=DT), open_loop(HOLD[None])
    x, _, u = rollouts.run(member.theta[None], np.zeros((1, 2)), drive, len(HOLD))
    return as_run(x[0] + [0.005, 0.01] * rng.standard_normal(x[0].shape), u[0], DT)


def test_the_density_is_the_likelihood_averaged_over_what_is_known(tie: Tie) -> None:
    """By quadrature over one parameter, the others known."""
    member, run = tie.members[0], _flown(tie, 1)
    own, theta = member.posteriors, member.branches[0].theta
    j = member.vector.labels.index("constant_force.acceleration")
    std = 0.05
    known = np.diag(1.0 / np.square(np.where(np.arange(len(theta)) == j, std, 1e-7 * member.vector.scale)))
    begun = replace(member, branches=(Branch(theta + 0.3 * std * (np.arange(len(theta)) == j), known, 0.0),))
    (fit,) = fit_all([begun], [run])
    grid = np.linspace(-5.0, 5.0, 401)
    values = np.tile(begun.branches[0].theta, (len(grid), 1))
    values[:, j] += std * grid
    known = np.zeros((len(theta), len(theta)))
    log = [here.nats for here in own.at_centres([LogWithPrior((run,), each, known) for each in values])]
    log = np.array(log) - 0.5 * grid**2 - 0.5 * np.log(2 * np.pi)
    whole = log.max() + np.log(np.sum(np.exp(log - log.max())) * (grid[1] - grid[0]))
    assert fit.brought[0] == pytest.approx(whole, abs=0.05)


@pytest.mark.parametrize("truth", [0, 1])
def test_no_rehearsal_speaks_against_what_it_simulates_on_average(tie: Tie, truth: int) -> None:
    """Of an experiment that tells nothing, too: the last term of the density is what keeps it so."""
    told = tie.rehearsed(truth, np.zeros((20, 1)), count=8, seed=3)
    assert told.evidence.mean() > -0.5
