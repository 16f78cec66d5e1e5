"""Diagnose blind cases, and judge the answers by the truth.

    python benchmarks/blind/generate.py --seed 1 --count 300 --out blind/
    python benchmarks/blind/run.py --cases blind/ --jobs 2

Each case is diagnosed from its files alone; its answer is kept in `blind/answers/NAME.json`, so that an interrupted
study goes on where it stopped. Then the truth is opened: an oracle that is told the effects fits the same physics and
predicts the same runs left out, and `blind/table.md` says how often the answers are right.
"""

from functools import partial
from math import prod
from pathlib import Path

import study
from study import Json, answered, held, line, markdown, shares, truth_of

MOVES = 1.1
"""Ratio of errors without and with the true effect from which a case counts as visible."""
NEAR = 1.05
KINDS = ("single", "pair", "recording", "outside", "null")


def diagnose_case(folder: Path, name: str) -> Json:
    """Diagnose one case and measure what an oracle would reach."""
    from outside import OUTSIDE

    import nsde_torch
    from nsde_torch.diagnosis.cross_validation import by_likelihood, held_out
    from nsde_torch.diagnosis.reading import with_channels
    from nsde_torch.models.identified import SysidSpec
    from nsde_torch.systems import make_system

    truth = truth_of(folder, name)
    system = make_system(truth["system"])
    data = nsde_torch.read(folder / "data" / name, system=system)
    found, answer = study.diagnosed(data, truth["system"])
    content = found.content()
    answer |= {key: content[key] for key in ("findings", "errors")}
    classes = {cls.name: f"outside:{cls.__name__}" for every in OUTSIDE.values() for cls in every}
    effects = {classes.get(key, key): of["parameters"] for key, of in truth["effects"].items()}
    joint = found.outcome.joint
    if effects and joint is not None:
        told = found.system.with_effects(*(system.make_effect(key, v) for key, v in effects.items()))
        spec = SysidSpec(system.name, dt=joint.final.at.of.space.logged_h, horizon=system.defaults.horizon)
        how = {"fitted": by_likelihood([joint.declared, joint.final]), "steps": joint.final.at.of.space.steps}
        machines, runs = (found.outcome.declared_system, told), with_channels(system, found.recorded.runs)
        oracle = held_out(machines, spec, runs, clock=found.recorded.clock, seed=0, **how)
        answer["oracle"] = oracle.content["after"]
    return answer


def worth(first: Json, other: Json) -> float:
    """Geometric mean over quantities of the ratio of two tables of errors, at the last horizon up to 1 s."""
    ratios = []
    for quantity, by in first.items():
        horizons = [h for h in by if float(h) <= 1.0]
        if horizons and by[horizons[-1]] and other[quantity][horizons[-1]]:
            ratios.append(by[horizons[-1]] / other[quantity][horizons[-1]])
    return prod(ratios) ** (1 / len(ratios)) if ratios else 1.0


def judge(truth: Json, answer: Json) -> Json:
    case, recording = truth["case"], truth.get("recording", {})
    names = [key.rpartition(":")[2] if ":" in key else key for key in truth["effects"]]
    names += [k.removesuffix("_s").removesuffix("_deg") for k in recording]
    added = answer["added"]
    if "theta" in recording.get("sensor_bias", {}):  # of a state that is no rate: an effect
        added = ["sensor_bias" if name == "position_bias[pole]" else name for name in added]
    of_added = [tie for tie in answer.get("ties", []) if tie["effects"][0] in added]
    parts = {part for tie in of_added for name in tie["effects"] for part in name.split(" + ")}
    effects = {key: of["parameters"] for key, of in truth["effects"].items()}
    out: Json = {
        "kind": case["kind"],
        "system": truth["system"],
        "noise": case["noise"],
        "true": names,
        "added": added,
        "verdict": answer["verdict"],
        "first": bool(added) and added[0] in names,
        "exact": sorted(added) == sorted(names),
        "in_tie": {*names} <= {*added, *parts},
        "lead": any(f["lead"] for f in answer.get("findings", [])) or bool(answer.get("ties")),
        "inside": held(effects, answer.get("parameters", {})),
        "seconds": answer.get("seconds", 0.0),
    }
    errors = answer.get("errors", {})
    if errors.get("before"):
        out["gain"] = worth(errors["before"], errors["after"])
        if "oracle" in answer:
            out["moves"] = worth(errors["before"], answer["oracle"])
            out["beside_oracle"] = worth(errors["after"], answer["oracle"])
    return out


def _good(j: Json) -> bool:
    """Whether an answer to an effect outside the catalogue is the law, unexplained, or a lead that helps."""
    helps = bool(j["added"]) and j.get("gain", 1.0) > 1.0 and j["lead"]
    laws = all("=" in n for n in j["added"]) and j["verdict"] != "no_effect" and j["beside_oracle"] < NEAR
    return j["verdict"] == "unexplained" or helps or laws


def table(judged: dict[str, Json]) -> str:
    """Shares of right answers by system, and every case that went wrong."""
    kinds = {kind: [j for j in judged.values() if j["kind"] == kind] for kind in KINDS}
    visible, pairs = ([j for j in kinds[k] if j.get("moves", 1.0) > MOVES] for k in ("single", "pair"))
    out, first = kinds["outside"], [j for j in visible if j["first"]]
    seen = [j for j in out if j.get("gain", 1.0) > MOVES or j["verdict"] != "no_effect"]
    near = [j for j in first if "beside_oracle" in j]
    asked = [
        ("single effect that moves errors by 10 %: named first", visible, lambda j: j["first"]),
        ("the same: named first or tied", visible, lambda j: j["first"] or j["in_tie"]),
        ("the same: named, and nothing else", visible, lambda j: j["exact"]),
        ("pairs: both found", pairs, lambda j: set(j["true"]) <= set(j["added"])),
        ("nothing missing: silent", kinds["null"], lambda j: j["verdict"] == "no_effect"),
        ("outside the catalogue: the law, unexplained, or a lead that helps", out, _good),
        ("the same, where it moves errors by 10 %", seen, _good),
        ("recording chain: named", kinds["recording"], lambda j: j["first"] or j["in_tie"]),
        ("error within 5 % of the oracle's", near, lambda j: j["beside_oracle"] < NEAR),
        ("90 % intervals that hold", first, lambda j: j["inside"]),
    ]
    seconds = sorted(j["seconds"] for j in judged.values()) or [0.0]
    lines = [*shares(asked, "system"), "", f"seconds a case, median: {seconds[len(seconds) // 2]:.0f}", ""]
    head = ("case", "kind", "system", "noise", "true", "answer", "verdict", "moves", "gain")
    lines += markdown(head, [])
    for name, j in sorted(judged.items()):
        silent = j["kind"] == "null" and j["verdict"] == "no_effect"
        if not silent and (j["kind"] in ("outside", "null") or not j["exact"]):
            numbers = [f"x{j[k]:.2f}" if k in j else "" for k in ("moves", "gain")]
            said = ", ".join(j["true"]), ", ".join(j["added"]), j["verdict"]
            lines.append(line([name, j["kind"], j["system"], j["noise"], *said, *numbers]))
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = study.options(__doc__, "cases", jobs=1)
    parser.add_argument("--limit", type=int, default=10**6, help="answer this many at most")
    given = parser.parse_args()
    todo = study.missing(given.cases, "answers")[: given.limit]
    study.pooled(given.jobs, {name: partial(study.kept, given.cases, name, diagnose_case) for name in todo})
    judged = {name: judge(truth, answer) for name, truth, answer in answered(given.cases)}
    study.report(given.cases, judged, table(judged))


if __name__ == "__main__":
    main()
