"""Laws that no catalogue has, by the joint likelihood: terms in the variables of functions that explain more.

    functions beside the physics  ->  their variables  ->  terms of these as columns  ->  the best are fitted  ->  again

Functions of one and of two variables (`nsde_torch.inference.functions`) say on which row of a port something is left,
and of which variables. Every term of the library (`laws`) of these is one more column of the likelihood's Gram
matrices, under the noise levels that the functions leave. The few that explain most of folds left out are fitted to the
end; the best joins the physics if it is needed after correction for the size of the library, and explains a good share
of the functions' evidence: beside much that nobody knows, any term straightens a little. In the end each effect and
each law is looked at again, as in the selection.

Laws are tried first in the place of effects that may only imitate one: where one term is likelier (`Selected.law`), and
where two effects are laws of one variable (a friction and a quadratic damping for a cubic one). A law that is the same
function as an effect of the catalogue, at the states and inputs of the data, takes that effect's name: `force = c1 x^3`
is a cubic stiffness. Where sizes of the effect make it the law, it is fitted in its place: the law may have been the
likelier of the two by its spelling alone (docs/content/theory/evidence.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from itertools import combinations, product
from math import isfinite, log

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.diagnosis.candidates import (
    Start,
    candidate_names,
    effect_of,
    joined,
    values_of,
    variable_of,
)
from nsde_torch.diagnosis.ceiling import functions_beside
from nsde_torch.diagnosis.evidence import folds_of, sum_error
from nsde_torch.diagnosis.gram_table import GramTable
from nsde_torch.diagnosis.joint_selection import (
    FittedPhysics,
    JointSearch,
    JointSelection,
    coordinate_of,
    sure_nats,
)
from nsde_torch.diagnosis.laws import Term, law_on, tables, terms_on, with_places
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.periodicity import COUNTS, PARTS, best_repeat
from nsde_torch.diagnosis.regressors import machine_variables
from nsde_torch.effects import Effect, Law, Parameter, Port, effect_class
from nsde_torch.effects.by_run import RUN
from nsde_torch.effects.expression import Expression
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.effects.law import AND
from nsde_torch.errors import ConfigError
from nsde_torch.inference.force_scores import force_scores
from nsde_torch.inference.functions import Functions
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.steps import Steps
from nsde_torch.systems import System
from nsde_torch.systems.vocabulary import seen_by, vocabulary

# variables of which products of three are tried, and laws before the catalogue has ended: a multirotor has thirty, and
# 4,000 products
_COUPLED = 10
# products of which the likeliest is fitted: by scores alone `sail wind^2` went before that with the boat's heading
_PRODUCTS = 10
_FEW = 6  # variables, of all of which laws are tried: those of the arm and of the cylinder that took minutes
_CLOSE = 0.3  # share of the nats of the best term below which no further one is fitted


def with_laws(
    search: JointSearch,
    joint: JointSelection,
    outcome: Outcome,
    conclude: Callable[[JointSelection], Outcome],
    *,
    of_functions: bool,
) -> Outcome:
    """The outcome with laws that no catalogue has, where functions explain more and such laws do too.

    `joint` is the selection that was concluded from, and `of_functions` says whether functions of what was measured say
    anything of such a log.
    """
    settings = search.search
    if not search.tries_laws:
        return outcome
    laws, before = LawSearch(search, of_functions), set(joint.selected)
    joint = laws.named_by_the_catalogue(joint)  # laws that took the place of effects
    if joint.selected.keys() != before:
        outcome = conclude(joint)
    # not where feedback may have made it: that is not named under another name either
    names = [f.name for f in outcome.found if f.name in joint.selected] if of_functions else []
    near = [(name,) for name in names if joint.selected[name].law]
    alike = [pair for pair in combinations(names, 2) if of_one_variable(joint.final.system, pair)]
    for replaced in (*near, *alike):
        settings.say(f"trying laws in the place of {AND.join(replaced)}", 0, 1)
        other = laws.selected(joint, replaced)
        if other is None or len(other.selected) > len(joint.selected) - len(replaced) + 1:
            continue
        # with fewer parameters it need not be surely likelier: damping on one side was a stop without stiffness
        fewer = len(other.final.best.free) < len(joint.final.best.free)
        if other.final.value > joint.final.value + (0.0 if fewer else settings.decisions.alike_nats):
            return conclude(other)
    if of_functions:
        settings.say("functions of what was measured", 0, 1)
    joint = replace(joint, functions=laws.functions(joint.final))
    left = joint.functions is not None and joint.functions.nats
    more = laws.selected(joint, ()) if left or laws.unseen(joint.final) else None
    if more is not None:
        return conclude(_of_one_law(laws, more))
    kept = outcome.joint  # without what feedback may have made
    return (
        replace(outcome, joint=joint) if kept and kept.selected.keys() == joint.selected.keys() else outcome
    )


def _of_one_law(laws: LawSearch, joint: JointSelection) -> JointSelection:
    """The selection, or one with fewer effects, where a law explains what an effect and a law beside it do.

    A torque `wind omega` of a turbine's rotor was a quadratic damping, surely, and a law of the wind beside it.
    """
    beside = [name for name in joint.selected if is_law(name)]
    for name in [name for name in joint.selected if not is_law(name)] if len(beside) == 1 else ():
        other = laws.selected(joint, (name, *beside))
        if other is None or len(other.selected) >= len(joint.selected):
            continue
        if other.final.value > joint.final.value:
            return other
    return joint


class LawSearch:
    """Adds laws to physics; remembers functions beside physics."""

    def __init__(self, search: JointSearch, of_functions: bool) -> None:
        self._search, self._of_functions = search, of_functions
        self._functions: dict[frozenset[str], Functions | None] = {}
        self._unseen: dict[frozenset[str], list[Term]] = {}
        self._waits = False

    def lost(self) -> None:
        """See `Laws`; where functions say which variables laws are tried of, they wait for the catalogue to end."""
        self._waits = not _all_variables(self._search.declared.system)

    def first(self, place: FittedPhysics) -> FittedPhysics | None:
        """See `Laws`; of machines of few variables, whose functions take a second and not half a minute."""
        few = len(vocabulary(type(place.system)).variables) <= _COUPLED
        if self._waits or not few or not self._search.tries_laws or not self._of_functions:
            return None
        return self._with_a_law(place, (), 0.0 if _all_variables(place.system) else None)

    def functions(self, place: FittedPhysics) -> Functions | None:
        """Functions beside some physics; None where they would say nothing."""
        if not self._of_functions:
            return None
        names = frozenset(place.system.effect_names)
        if names not in self._functions:
            self._functions[names] = functions_beside(place.at, self._search.search.budgets.function_groups)
        return self._functions[names]

    def unseen(self, place: FittedPhysics) -> list[Term]:
        """Laws beside some physics that functions of what was measured do not see."""
        names = frozenset(place.system.effect_names)
        if names not in self._unseen:
            self._unseen[names] = [*self._waves(place), *self._drifts(place), *self._couplings(place)]
        return self._unseen[names]

    def _waves(self, place: FittedPhysics) -> list[Term]:
        """Forces on a coordinate that repeat along its position, finer than functions are."""
        system, space, found = place.system, place.at.of.space, list[Term]()
        along = [
            (space.disturbances.index((at.port, at.row)), at.position)
            for at in system.bound_coordinates()
            if at.position is not None and (at.port, at.row) in space.disturbances
        ]
        for port, position in along:
            v = space.steps.x0[:, position].numpy()
            # over many turns a period is a part of one: 31 teeth of what turns ten times are 310 periods
            turns = system.state_units[position] == "rad" and np.ptp(v) > 2.0 * np.pi
            again = best_repeat(force_scores(place.at), port, v, PARTS if turns else None)
            tried = len(PARTS if turns else COUNTS) * len(along)
            if again is not None and again.scores.nats > log(tried / self._search.search.level("effects")):
                name = system.state_names[position]
                parts = f"sin(k1 {name})", f"cos(k1 {name})"
                found.append(law_on(system, place.at, port, parts, {"k1": 2.0 * np.pi / again.period}))
        return found

    def _drifts(self, place: FittedPhysics) -> list[Term]:
        """Forces that grow with the time and a variable, as a spring that tires; constants where no effect is one."""
        system, space = place.system, place.at.of.space
        t, known = space.steps.t.numpy(), {name for name, _, _ in vocabulary(type(system)).variables}
        values = machine_variables(system, space.steps.x0[:, : system.nx], space.steps.u, inputs=True)
        products: dict[str, list[Array]] = {"": [np.ones_like(t)], "time": [t]}
        products |= {f"time {name}": [t, v.numpy()] for name, v in values.items() if name in known}
        return self._beyond_chance(place, products)

    def _couplings(self, place: FittedPhysics) -> list[Term]:
        """Products of three variables, one of them squared or none, as of Coriolis forces and of those of a flow.

        Of an angle the sine or cosine too.

        Functions are of two variables: of a gimbal whose yaw lacked such a force two false laws were provisional, and
        the effects explained all that functions can (tests/diagnosis/test_laws_beyond_the_catalogue.py); of a turbine
        that the product of wind, blade angle and speed brakes, `om^2 beta` was sure.
        """
        system, space = place.system, place.at.of.space
        units = {name: unit for name, unit, _ in vocabulary(type(system)).variables}
        states = dict(zip(system.state_names, space.steps.x0[:, : system.nx].T, strict=True))
        seen = machine_variables(system, space.steps.x0[:, : system.nx], space.steps.u, inputs=True)
        values = {name: v.numpy() for name, v in (states | seen).items() if name in units}
        angles = [name for name in values if units[name] == "rad"]
        known = {f"{f}_{a}" for f in ("sin", "cos") for a in angles}
        values = {name: v for name, v in values.items() if name not in known}
        if len(values) > _COUPLED:
            return []
        # forces of a flow go with the square of its speed: `cos(psi) sail wind^2` was four laws, one of them sure
        of_one = {name: {name: v, f"{name}^2": v * v} for name, v in values.items()}
        waves = {
            a: {
                f"{f}({turn}{a})": getattr(np, f)((2.0 if turn else 1.0) * values[a])
                for f in ("sin", "cos")
                for turn in ("", "2 ")
            }
            for a in angles
        }
        products = dict[str, list[Array]]()
        for factors in [
            *(tuple(of_one[n] for n in names) for names in combinations(values, 3)),
            *(
                (waves[a], of_one[b], of_one[c])
                for a in angles
                for b, c in combinations([name for name in values if name != a], 2)
            ),
        ]:
            for texts in product(*factors):
                if sum("^" in text for text in texts) < 2:
                    products[" ".join(texts)] = [one[text] for one, text in zip(factors, texts, strict=True)]
        return self._beyond_chance(place, products)

    def _beyond_chance(self, place: FittedPhysics, products: Mapping[str, Sequence[Array]]) -> list[Term]:
        """Of some products, by their text, the best few on each row of a port, where scores are beyond chance.

        None is a constant where that is an effect of the catalogue.
        """
        system, space, found = place.system, place.at.of.space, list[Term]()
        constant = {(at.port, at.row) for at in system.bound_coordinates()}
        ports = [k for k, (port, _) in enumerate(space.disturbances) if port in system.residual_ports]
        least = log(max(len(products) * len(ports), 1) / self._search.search.level("effects"))
        for k in ports if products else ():
            scores = force_scores(place.at)
            nats = {
                part: scores.of(np.prod(of, 0)[:, None], k).nats
                for part, of in products.items()
                if part or space.disturbances[k] not in constant
            }
            best = [
                part for part in sorted(nats, key=lambda part: -nats[part])[:_PRODUCTS] if nats[part] > least
            ]
            found += [law_on(system, place.at, k, (part,), {}) for part in best]
        return found

    def selected(self, joint: JointSelection, replaced: Sequence[str]) -> JointSelection | None:
        """A selection with laws, also in the place of some effects; None where it is the same."""
        search = self._search
        place, whole = joint.final, joint.final.best.likelihood
        few = bool(_all_variables(place.system))
        if few and (functions := self.functions(joint.final)) is not None:
            whole += sum(functions.nats.values())
        of_effects = {n: e for n in replaced if isinstance(e := effect_of(place.system, n), Law)}
        for name in replaced:
            place = search.without(place, name)
        laws, most = set[str](), search.search.decisions.most_effects
        while len(laws) < search.search.budgets.laws and len(search.added(place.system)) < most:
            left = max(whole - place.best.likelihood, 0.0) if few else None
            better = self._with_a_law(place, list(of_effects.values()), left)
            if better is None:
                break
            laws |= search.added(better.system) - search.added(place.system)
            place = better
        if not laws:
            return None
        found = self.named_by_the_catalogue(search.concluded(place, before=joint.selected))
        if found.selected.keys() == joint.selected.keys():
            return None
        return replace(found, functions=self.functions(found.final))

    def _with_a_law(
        self, place: FittedPhysics, effects: Sequence[Law], left: float | None
    ) -> FittedPhysics | None:
        """Physics with the law that explains most beside it; None where none is needed.

        Where it is known how many nats are left to be explained, laws are tried of all variables; else functions say
        that, and of which ones. They took 20 s at each of a dozen steps of a hydraulic cylinder.
        """
        if not isfinite(
            place.best.likelihood
        ):  # the filter has diverged: of a ball on a beam a law began at no number
            return None
        search, space, wanted = self._search, place.at.of.space, dict[int, list[str]]()
        functions = self.functions(place) if left is None else None
        nats = {} if functions is None else functions.nats
        for port in sorted(nats, key=lambda p: -nats[p]):
            assert functions is not None
            most = [*functions.importance(port)][: search.search.budgets.law_variables]
            wanted[port] = with_places(place.system, most)
        if left is not None:
            every = with_places(place.system, _all_variables(place.system))
            wanted = {
                k: every
                for k, (port, _) in enumerate(space.disturbances)
                if port in place.system.residual_ports
            }
        for effect in effects:
            at = effect.at.port, effect.at.row
            if at in place.at.of.space.disturbances:
                port = place.at.of.space.disturbances.index(at)
                own = (*wanted.get(port, ()), *coordinate_of(place.system, effect))
                wanted[port] = list(dict.fromkeys(own))
        levels = None if functions is None else functions.levels
        library = tuple(
            t for port, names in wanted.items() for t in terms_on(place.system, place.at, port, names)
        )
        # cogging of order 30 of an arm's shoulder and teeth along a rail had a period and no name, a spring that tires
        # none either
        library += tuple(t for t in self.unseen(place) if t.law not in place.system.effect_names)
        fitted: list[Term] = []
        needed: list[tuple[str, FittedPhysics]] = []
        for term, sizes in self._promising(place, library, levels):
            there = search.tried(joined(place.system, term.law, {**term.start, **sizes}), place)
            fitted.append(term)
            search.chosen(term.law, fitted, library)
            if search.needed(term.law, there, place):
                needed.append((term.law, there))
        if not needed:
            return None
        law, best = self._simplest(needed)
        search.chosen(law, fitted, library)
        least = search.search.decisions.law_share * (sum(nats.values()) if left is None else left)
        return best if best.best.likelihood - place.best.likelihood > least else None

    def _simplest(self, laws: Sequence[tuple[str, FittedPhysics]]) -> tuple[str, FittedPhysics]:
        """The likeliest of some laws, or of those that are not surely less likely one of the fewest variables.

        Of an aeroplane that does not loop, `cos(th) V al^2` stood for `V al^2`.
        """
        _, best = max(laws, key=lambda one: one[1].value)

        def alike(there: FittedPhysics) -> bool:
            sure = sure_nats(self._search.search, sum_error(best.at.blocks - there.at.blocks))
            return best.value - there.value < sure

        def variables(law: str, there: FittedPhysics) -> int:
            effect = effect_of(there.system, law)
            return len(effect.sources) + len(effect.exogenous) if isinstance(effect, Expression) else 1

        some = [(law, there) for law, there in laws if there is best or alike(there)]
        return min(some, key=lambda one: (variables(*one), -one[1].value))

    def _promising(
        self, place: FittedPhysics, library: Sequence[Term], levels: Levels | None
    ) -> list[tuple[Term, dict[str, float]]]:
        """Laws that explain most of folds left out, each once, with their sizes after one linearised step."""
        search, space = self._search.search, place.at.of.space
        folds = folds_of(search.decisions, *space.chunks.places())
        found: list[tuple[float, Term, dict[str, float]]] = []
        for some, held in tables(place.system, place.at, library, levels):
            table = GramTable(held, 1 + place.best.free, folds)
            for term, own in some:
                if all(map(table.is_new, own)):
                    blocks, _, step = table.gain((0, *own))
                    nats = float(blocks.sum()) - table.price(len(own) + len(term.start))
                    found.append((nats, term, dict(zip(term.sizes, step.tolist(), strict=True))))
        best: dict[str, tuple[Term, dict[str, float]]] = {}
        ranked = sorted(found, key=lambda one: -one[0])
        for nats, term, sizes in ranked:
            if len(best) >= search.budgets.laws_fitted or nats < max(_CLOSE * ranked[0][0], 0.0):
                break
            best.setdefault(term.law, (term, sizes))
        return list(best.values())

    def named_by_the_catalogue(self, found: JointSelection) -> JointSelection:
        """The same, laws that the catalogue has under its names."""
        search = self._search
        for name in filter(is_law, list(found.selected)):
            place = found.final
            if name not in place.system.effect_names:  # it was dropped as another law got its name
                continue
            same = same_effect(place.at.of.space.steps, place.system, name)
            if same is None:
                continue
            effect, shapes = same
            there = search.fitted(joined(search.without(place, name).system, effect, shapes), place)
            again = search.concluded(there, before=found.selected)
            # a friction that holds with more than it slides with was a sign of the speed: it is that of Stribeck
            if effect in again.selected or again.final.value > found.final.value:
                found = again
        return found


def _all_variables(system: System) -> list[str]:
    """Variables of a machine of few, the clock aside; none of one of many, whose library would be long."""
    names = [name for name, _, _ in vocabulary(type(system)).variables if name != "time"]
    names += [name for name in system.exogenous if name != RUN]
    return names if len(with_places(system, names)) <= _FEW else []


def of_one_variable(system: System, names: Sequence[str]) -> bool:
    """Whether two effects of a system are functions of the same quantity, at the same place."""
    one, two = (effect_of(system, name) for name in names)
    return one.port is two.port and variable_of(one) is not None and variable_of(one) == variable_of(two)


_MOVED, _ALIKE = 1e-3, 0.02  # of an input's largest value, and of a law that may be more than its zero
_SAME = 1e-6  # of its length: what a law may be away; both are in double precision
_ROWS = 5000  # of the data, evenly chosen


def same_effect(steps: Steps, system: System, law: str) -> tuple[str, Start] | None:
    """An effect of the catalogue that is a law at the states of the data, by its sizes: its name, and its shapes."""
    own = deepcopy(effect_of(system, law)).double()
    if own.port is Port.INPUT:
        return None
    mine = _pushes(steps, system, own)
    found: list[tuple[str, Start]] = []  # a friction of two sizes is one too, where both are alike
    shapes = [value for name, value in values_of(own).items() if name.startswith("k")]
    for name in candidate_names(system):
        cls = system.effect_class(name)
        if cls.port is not own.port or cls.exogenous:
            continue
        # a sign of the speed with its width is a dry friction (tests/diagnosis/test_laws_beyond_the_catalogue.py)
        shaped = dict(zip(cls.shapes, shapes, strict=True)) if len(cls.shapes) == len(shapes) else {}
        sizes = {k: _size(cls.PARAMETERS[k]) for k in cls.amplitudes}
        try:
            other = _made(system, name, {**sizes, **shaped})
            more = [_made(system, name, {**sizes, **shaped, k: 1.5 * v}) for k, v in sizes.items()]
        except ConfigError:  # beyond the bounds of its shapes
            continue
        if other.n_memory:
            continue
        theirs = _pushes(steps, system, other)
        if theirs.shape != mine.shape or not mine @ mine > 0:
            continue
        parts = np.stack([_pushes(steps, system, one) - theirs for one in more], 1)
        weights = np.linalg.lstsq(parts, mine, rcond=1e-12)[0]
        off, whole = mine - parts @ weights, float(mine @ mine)
        if cls.local and float(np.square(parts[:, 0] * weights[0]).sum()) <= _SAME**2 * whole:
            continue  # a stop without stiffness is none
        if float(off @ off) <= _SAME**2 * whole:
            found.append((name, shaped))
    return min(found, key=lambda one: len(effect_class(one[0]).PARAMETERS), default=None)


@torch.no_grad()
def zero_of_an_input(steps: Steps, system: System, law: Effect) -> str | None:
    """That a law does what one of several inputs does whose zero is off, in words; None where it does not.

    A steering that was off by 0.024 rad was `cos(phi) v^2`, a gain of the input that depends on the place.
    """
    if system.nu < 2 or law.exogenous:
        return None
    machine, own = system.double(), deepcopy(law).double()
    t, x, u, z = _some_rows(steps, machine)
    force = {own.port: own(t, x, seen_by(machine, own, t, z, u), z[:, :0])}
    before = machine.drift(t, z, u)[:, : system.nx]
    pushes = machine.drift(t, z, u, force)[:, : system.nx] - before
    for k, (name, unit) in enumerate(zip(system.input_names, system.input_units, strict=True)):
        moved, size = u.clone(), max(_MOVED * float(u[:, k].abs().max()), 1e-12)
        moved[:, k] += size
        does = (machine.drift(t, z, moved)[:, : system.nx] - before) / size
        off = float((does * pushes).sum() / (does * does).sum().clamp_min(1e-300))
        if float((pushes - off * does).norm()) < _ALIKE * float(pushes.norm()):
            return f"a zero that is off: what {off:.3g} {unit} more of {name} would do"
    return None


def _made(system: System, name: str, values: Start) -> Effect:
    """An effect with values in double precision: a phase of many turns asks for it."""
    effect = system.make_effect(name).double()
    for own, value in values.items():
        effect.set_value(own, value)
    return effect


def _size(parameter: Parameter) -> float:
    """Some size that is not nothing, within bounds."""
    low, high = parameter.low or 0.0, parameter.high
    return low + (1.0 if high is None else 0.5 * (high - low))


@torch.no_grad()
def _pushes(steps: Steps, system: System, effect: Effect) -> np.ndarray:
    """What an effect without memory adds at some of the data's states, row after row of its port."""
    machine, own = system.double(), effect.double()
    t, x, u, z = _some_rows(steps, machine)
    return np.asarray(own(t, x, seen_by(machine, own, t, z, u), z[:, :0]).numpy()).ravel()


def _some_rows(steps: Steps, machine: System) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Times, states, inputs, and states with memory of some of the data's rows."""
    some = torch.linspace(0, len(steps) - 1, min(len(steps), _ROWS)).long()
    x, u = steps.x0[some], steps.u[some]
    return steps.t[some], x, u, machine.augment(x, u)
