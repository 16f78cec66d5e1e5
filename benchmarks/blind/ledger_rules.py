"""Rules of a diagnosis that rewrite an outcome, and how each is switched off (`corpus`).

A rule is switched off by what replaces names of modules at run time, so that the package has no switches of its own. A
replacement takes the function that was there and its arguments. A rule fires where its result is not what would be
there without it.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import replace
from importlib import import_module
from typing import Any, NamedTuple

Function = Callable[..., Any]


class Rule(NamedTuple):
    name: str
    purpose: str
    where: tuple[str, ...]  # `module.name` in `nsde_torch.diagnosis`; with `inference.` before it, there
    off: Function  # what is there without it, by the function itself and its arguments
    fires: Function  # whether a result, with the arguments, is not what would be there without the rule


def constant(value: Any) -> Function:
    """A function of this value, whatever its arguments."""
    return lambda original, *args, **kwargs: value


def argument(number: int) -> Function:
    """A function that returns one of its arguments."""
    return lambda original, *args, **kwargs: args[number]


def marked(number: int) -> Function:
    """Whether a finding became a lead for this reason, or the verdict another."""

    def fires(result: Any, *args: Any, **kwargs: Any) -> bool:
        before = args[number]
        pairs = zip(result.found, before.found, strict=True)
        return result.verdict != before.verdict or any(a.provisional != b.provisional for a, b in pairs)

    return fires


def _names(found: Iterable[Any]) -> list[str]:
    return [f.name for f in found]


def _no_second_look(original: Function, search: Any, place: Any, *before: Any) -> Any:
    nothing = import_module("nsde_torch.diagnosis.joint_selection").Instead
    return place, {n: nothing() for n in place.system.effect_names if n in search.added(place.system)}


def _all_rows(original: Function, log: Any, search: Any, *rest: Any) -> Any:
    there = search.decisions
    search.decisions = replace(there, apart_s=0.0)
    try:
        return original(log, search, *rest)
    finally:
        search.decisions = there


def _lead(name: str, purpose: str, number: int = 0) -> Rule:
    """A rule of the pipeline that makes leads, or changes the verdict, of the outcome that is one of its arguments."""
    return Rule(name, purpose, (f"pipeline.{name}",), argument(number), marked(number))


def _found(name: str, purpose: str, where: str, nothing: Any) -> Rule:
    """A rule that fires where it finds anything: not None, empty or False."""
    return Rule(name, purpose, (where,), constant(nothing), lambda result, *args, **kwargs: bool(result))


def _changed(name: str, purpose: str, *where: str) -> Rule:
    """A rule that fires where it returns another object than its first argument."""
    return Rule(name, purpose, where, argument(0), lambda r, *a, **k: r is not a[0])


SEARCH = "joint_selection.JointSearch"
RULES = (
    # ---- of the whole log
    _found("late_columns", "a column that is late is moved before the search", "pipeline.late_columns", []),
    _changed("without_standstill", "rows of standstill are left out", "pipeline.without_standstill"),
    # ---- findings that become leads, and the verdict
    _lead("doubted", "nothing is sure where simple fits speak against the final physics"),
    _lead("sized", "an effect whose interval holds nothing is a lead"),
    _lead("judged_on_runs_left_out", "an effect that runs left out speak against is a lead"),
    _lead("not_sure", "no change at a moment is sure where the residual depends on time", 1),
    _lead("judged_by_the_ceiling", "what functions explain is structure: leads, and the verdict"),
    _found(
        "structure where it acts", "a lead where much is left in its channels", "decision._too_much", False
    ),
    _found("bent shape", "an effect whose shape ends at a bound is a lead", "decision._bent", ""),
    _found(
        "a law of many", "a lead beside laws, or where inputs know more than the log", "decision._of_many", ""
    ),
    _found(
        "tests beyond feedback", "what feedback may hide is no structure", "decision.allowances_of_tests", {}
    ),
    # ---- feedback
    Rule(
        "set_aside",
        "effects that explain no more than feedback may hide are not named",
        ("pipeline.set_aside",),
        lambda original, search, chosen, log: replace(chosen, test=log.loop(chosen.final)),
        lambda result, search, chosen, log: _names(result.found) != _names(chosen.found),
    ),
    # ---- selection
    Rule(
        "looked_at_again",
        "each effect is looked at again beside the others: dropped or exchanged",
        (f"{SEARCH}.looked_at_again",),
        _no_second_look,
        lambda result, search, place, *before: set(result[1]) != search.added(place.system),
    ),
    _found("_in_parts", "two effects that are as likely as one are a tie with it", f"{SEARCH}._in_parts", ()),
    Rule(
        "_nearer_law",
        "a likelier law of one term stands beside an effect, or takes its place",
        (f"{SEARCH}._nearer_law",),
        constant(("", None)),
        lambda result, *args: bool(result[0]),
    ),
    _found(
        "_more_once_fitted",
        "a candidate whose linearised step says less than a fit is fitted to the end, and held against blocks left out",
        f"{SEARCH}._more_once_fitted",
        None,
    ),
    _found("below_a_step", "a time shorter than half a step is declared", f"{SEARCH}._below_a_step", False),
    Rule(
        "order of candidates",
        "simpler candidates come before what is likeliest",
        ("joint_selection._in_order",),
        lambda original, search, look, *rest: [p for p in look if p.accepted],
        lambda result, search, look, *rest: _names(result) != _names(p for p in look if p.accepted),
    ),
    Rule(
        "rows apart",
        "rows further apart are looked at where innovations of all rows can be predicted",
        ("pipeline._selected",),
        _all_rows,
        lambda result, *args, **kwargs: result[1].final.at.of.apart_s > 0,
    ),
    _changed(
        "behind smoothers",
        "behind a smoother effects with memory on inputs are no candidates, and make all else a lead",
        "pipeline.behind_smoothers",
        "pipeline.with_suspects",
    ),
    _found(
        "outliers",
        "measurements eight standard deviations off are left out, where they are rare",
        "inference.estimate.LogLikelihood.without_outliers",
        None,
    ),
    Rule(
        "own_of_runs",
        "one run's own dependence counts only where nothing in all runs explains more",
        ("residual_tests.own_of_runs",),
        lambda original, tests: list(tests),
        lambda result, tests: any(a.p != b.p for a, b in zip(result, tests, strict=True)),
    ),
    # ---- laws beyond the catalogue
    _found(
        "laws for two of one variable",
        "laws are tried in the place of two laws of one quantity",
        "beyond_catalogue.of_one_variable",
        False,
    ),
    _found(
        "laws named by the catalogue",
        "a law that is an effect of the catalogue takes its name",
        "beyond_catalogue.same_effect",
        None,
    ),
    # ---- estimates
    Rule(
        "errors of predictions",
        "where rates are inferred, estimates by prediction errors are printed",
        ("pipeline._identified",),
        lambda original, log, outcome: (outcome, None),
        lambda result, log, outcome: result[0] is not outcome,
    ),
)


def _holder(where: str) -> tuple[Any, str]:
    """The module or class that has a name of a rule, and the name within it."""
    package, dot, rest = where.partition(".")
    folder, rest = (package, rest) if package == "inference" else ("diagnosis", package + dot + rest)
    module, *path = rest.split(".")
    out = import_module(f"nsde_torch.{folder}.{module}")
    for part in path[:-1]:
        out = getattr(out, part)
    return out, path[-1]


def counted(fired: dict[str, int]) -> AbstractContextManager[None]:
    def wrapped(rule: Rule, original: Function) -> Function:
        def run(*args: Any, **kwargs: Any) -> Any:
            result = original(*args, **kwargs)
            if rule.fires(result, *args, **kwargs):
                fired[rule.name] = fired.get(rule.name, 0) + 1
            return result

        return run

    return _replaced(RULES, wrapped)


def without(rule: Rule) -> AbstractContextManager[None]:
    def wrapped(rule: Rule, original: Function) -> Function:
        return lambda *args, **kwargs: rule.off(
            original, *args, **kwargs
        )  # binds to a class, unlike a partial

    return _replaced((rule,), wrapped)


@contextmanager
def _replaced(rules: Sequence[Rule], wrapped: Callable[[Rule, Function], Function]) -> Iterator[None]:
    with ExitStack() as stack:
        for rule in rules:
            for holder, name in map(_holder, rule.where):
                original = getattr(holder, name)
                stack.callback(setattr, holder, name, original)
                setattr(holder, name, wrapped(rule, original))
        yield
