"""What effects buy on runs left out: their order, the few that matter, and how the others are told."""

import numpy as np
import pytest

from nsde_torch.diagnosis.cross_validation import Own
from nsde_torch.diagnosis.decisions import Options, Wording
from nsde_torch.diagnosis.effect_importance import BY_STEPS, Importance, effect_importance, shown_effects
from nsde_torch.diagnosis.report import WITH, WITHOUT, effect_panels, page
from nsde_torch.diagnosis.text import in_order, lines, small, without_it
from tests.helpers.diagnosed import Diagnosed, diagnosed


def brings(nats: float, **left: tuple[float, float]) -> Own:
    """What an effect brings: nats, and by channel the residual without it and with it."""
    return Own(
        nats, None, None, {}, {}, larger=False, residual={k: ("m/s2", *pair) for k, pair in left.items()}
    )


def test_effects_are_ordered_by_the_log_likelihood_that_is_lost_without_them() -> None:
    brought = {
        "a": brings(20.0, v=(2.0, 1.0)),
        "b": brings(60.0, v=(1.1, 1.0)),
        "c": brings(-5.0, v=(1.0, 1.0)),
    }
    found = effect_importance(brought, inputs=True)
    assert list(found) == ["b", "a", "c"]
    assert [b.share for b in found.values()] == pytest.approx([0.75, 0.25, 0.0])


@pytest.mark.parametrize(
    ("shares", "share", "few", "rest"),
    [
        ({"a": 0.02, "b": 0.9, "c": 0.08}, 0.95, ("b", "c"), ("a",)),
        ({"a": 0.02, "b": 0.9, "c": 0.08}, 0.9, ("b",), ("c", "a")),
        ({"a": 0.0, "b": 0.0}, 0.95, ("a", "b"), ()),  # nobody brings anything: nobody is small
        ({"a": 1.0}, 0.95, ("a",), ()),
    ],
)
def test_the_few_are_the_first_that_together_reach_the_share(
    shares: dict[str, float], share: float, few: tuple[str, ...], rest: tuple[str, ...]
) -> None:
    importance = {k: Importance(k, s, s, s) for k, s in shares.items()}
    found = shown_effects(list(shares), importance, Wording(few_share=share))
    assert (found.few, found.rest) == (few, rest)
    assert found.share == pytest.approx(sum(shares[name] for name in rest))


@pytest.fixture(scope="module")
def found() -> Diagnosed:
    """A spring with much dry friction and a weak steady push."""
    friction, push = {"coulomb_friction": {"size": 0.3}}, {"constant_force": {"acceleration": 0.05}}
    options = Options(candidates=("coulomb_friction", "constant_force"))
    return diagnosed("mass_spring_damper", friction, push, options=options)


@pytest.mark.slow
def test_what_returns_is_said_where_the_effect_is(found: Diagnosed) -> None:
    diagnosis, content = found
    assert content["told"]["by"] == BY_STEPS
    assert content["told"]["few"][0] == "coulomb_friction"
    (friction,) = (f for f in content["findings"] if f["name"] == "coulomb_friction")
    buys = friction["buys"]
    assert buys["nats"] == friction["held_out"]["nats"]
    assert buys["error_with"] < 0.5 * buys["error_without"]
    words = without_it(friction, content)
    assert words.startswith("without it, on runs left out: the residual of q_dot goes from")
    assert any(words in line for line in lines(content))
    pictures = diagnosis.importance
    assert list(pictures) == sorted(pictures, key=lambda n: -pictures[n].gain)


@pytest.mark.slow
def test_small_effects_are_gathered_in_one_line(found: Diagnosed) -> None:
    _, content = found
    few, rest = content["told"]["few"][:1], [n for n in content["added"] if n != "coulomb_friction"]
    sizes = [{"effect": name, "size": "0.05 m/s2"} for name in rest]
    gathered = {**content, "told": {**content["told"], "few": few, "rest": sizes, "rest_share": 0.04}}
    assert [f["name"] for f in in_order(gathered)] == few
    line = f"and {small(len(rest))}, together 4.0% of what all effects improve on runs left out: {rest[0]} (0.05 m/s2)"
    assert any(told_line.startswith(line) for told_line in lines(gathered))
    text = page(gathered, {}, width=0.25)
    assert f"<summary>And {line[4:]}" in text
    assert text.index("<code>coulomb_friction</code>") < text.index(f"<code>{rest[0]}</code>")


def test_each_effect_that_matters_has_a_picture(found: Diagnosed) -> None:
    diagnosis, _ = found
    panels = effect_panels(diagnosis.outcome, diagnosis.shown, diagnosis.importance, diagnosis.runs)
    assert set(panels) == set(diagnosis.shown.few)
    panel = panels["coulomb_friction"]
    assert (panel.channel, panel.variable) == ("q_dot", "q_dot")
    without, left = panel.clouds[WITHOUT], panel.clouds[WITH]
    slow = np.sign(without.centre) * without.mean
    assert slow.mean() < -0.2  # it brakes, whichever way the mass moves
    assert np.abs(left.mean).mean() < 0.1
