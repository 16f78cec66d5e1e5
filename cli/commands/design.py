"""`nsde design`: plan the most informative experiment, or report the evidence of one that was flown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nsde_torch.design.options import DesignOptions
from nsde_torch.errors import ConfigError
from nsde_torch.whole_files import json_text

from ..hydra_command import Config, HydraCommand, Job
from ..keys import key, mirrors
from ..quoted import as_typed

OBTAINED = "obtained.json"


@mirrors(DesignOptions)
class DesignConfig:
    run: str = key(
        "???",
        "folder of a diagnosis (nsde diagnose), whose indistinguishable effects or hidden parameters are asked for",
        file=True,
    )
    runs: str | None = key(None, "where the runs of the diagnosis are now; null: where they were", file=True)
    members: Any = key(
        None,
        "what may be true, each a list of effects beside the declared physics: [[coulomb_friction,constant_force],"
        "[asymmetric_friction]]; null: the first indistinguishable ones of the diagnosis",
    )
    flown: str | None = key(
        None,
        "runs of a flown experiment: report its evidence, and plan none (file or folder, as the runs of the diagnosis)",
        file=True,
    )
    plan: str | None = key(
        None, "with flown=: folder of its plan (nsde design), for what was expected", file=True
    )
    baselines: bool = key(
        True, "measure usual inputs beside the plan: multisine, chirp, doublets, the longest run again"
    )
    threads: int = key(1, "CPU threads of torch", low=1)
    out_dir: str = key("???", "folder to write into", file=True)


COMMAND = HydraCommand(
    name="design",
    schema=DesignConfig,
    folder="designs/${now:%Y-%m-%d}/${now:%H-%M-%S}",
    result=("design.json", "a plan"),
    examples=(
        ("run=diagnosis/ out_dir=experiment/", "which experiment would distinguish them?"),
        (
            "run=diagnosis/ 'members=[[coulomb_friction,constant_force],[asymmetric_friction]]'",
            "between these",
        ),
        ("run=diagnosis/ 'parameters=[quadratic_damping.damping]' duration=10", "how large is this?"),
        ("run=diagnosis/ 'limits={q: [-0.5,0.5], force: [-1,1]}'", "within these limits"),
        ("run=diagnosis/ flown=log/ plan=experiment/ out_dir=obtained/", "what does the experiment show?"),
    ),
)


def run(config: Config, job: Job) -> None:
    from nsde_torch.design import design, question_of
    from nsde_torch.progress import Stages

    from .. import build
    from ..known_machine import diagnosed

    members = build.options(config)["members"] or []
    if not (isinstance(members, list) and all(isinstance(m, list) and m for m in members)):
        raise ConfigError(f"`members` takes lists of effects, [[EFFECT,...],[EFFECT,...]]; got {members!r}.")
    options = DesignOptions(**build.shared(DesignOptions, config))
    known = diagnosed(Path(config.run), config.runs)
    if config.flown is not None:
        _read(config, job, known, options)
        return
    question = question_of(known.content, known.system, options)
    stages = Stages()
    made = design(question=question, options=options, **known.given, baselines=config.baselines, say=stages)
    stages.close()
    made.save(job.run_dir)
    print(made.report)
    plan = {"plan": job.run_dir}
    print(
        f"\n{job.took}; wrote {job.run_dir}: design.json, plan.csv, design.png\n"
        f"give the machine plan.csv (simulated: {as_typed('nsde', 'simulate', 'pilot=plan', paths=plan)}), then: "
        f"{as_typed('nsde', 'design', 'flown=LOG', paths={'run': config.run, **plan})}"
    )


def _read(config: Config, job: Job, known: Any, options: DesignOptions) -> None:
    from dataclasses import replace

    from nsde_torch.design import obtained, question_of
    from nsde_torch.design.experiment import read_design

    from ..known_machine import flown_runs

    expected: list[Any] = []
    if config.plan is not None:
        planned = read_design(config.plan)
        expected, asked = planned["expected"], planned["question"]
        if options.members is None and options.parameters is None:
            tie = tuple(map(tuple, asked["members"])) if asked["kind"] == "tie" else None
            parameters = None if tie else tuple(asked["parameters"])
            options = replace(options, members=tie, parameters=parameters)
    found = obtained(
        flown=flown_runs(known, config.flown),
        question=question_of(known.content, known.system, options),
        **known.given,
        expected=expected,
    )
    (job.run_dir / OBTAINED).write_text(json_text(found.content()) + "\n", encoding="utf-8")
    print(found.report)
    print(
        f"wrote {job.run_dir / OBTAINED}; diagnose it with the other runs: nsde diagnose data.path=FOLDER_OF_ALL"
    )
