"""`nsde figures`: make the supplement's figures anew, each with its claim and what was measured.

Models that are missing are trained first, by `nsde train` in processes of their own.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsde_torch.cli.hydra_command import HydraCommand, Job
from nsde_torch.cli.keys import key
from nsde_torch.errors import ConfigError, NsdeError

from ..training import train_all
from . import figure_table
from .figure_table import Settings

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from . import ExperimentOutcome

log = logging.getLogger(__name__)


@dataclass
class FiguresConfig:
    """`nsde figures`."""

    figures: list[str] = key(["all"], "figures to make: all, or of fig5, fig9, fig10 ... fig16")
    settings: str = key(
        "fast",
        "fast: a look in minutes; full: for the record (default trainings, all folds)",
        choices=("fast", "full"),
    )
    published: str | None = key(
        None,
        "folder of the authors' files (hexacopter/, cartpole/, ...); null: data of our own plants",
        file=True,
    )
    seeds: int | None = key(None, "models of each kind; null: 1 with fast, 3 with full settings", low=1)
    jobs: int = key(2, "trainings at a time, one thread each", low=1)
    policies: str | None = key(
        None,
        "folder of a study by benchmarks/bench_policy.py, for fig13 and fig14; null: not drawn",
        file=True,
    )
    seed: int = key(0, "seed of the particles", low=0)
    threads: int = key(1, "CPU threads of torch", low=1)
    out_dir: str = key(
        "???",
        "folder of figures, captions and trained models; finished models in it are used again",
        file=True,
    )


COMMAND = HydraCommand(name="figures", schema=FiguresConfig, folder="figures")


def run(config: DictConfig, job: Job) -> None:
    """Make the figures that the configuration names; NsdeError where one could not be drawn."""
    names = chosen(list(config.figures))
    fast = config.settings == "fast"
    settings = Settings(
        fast=fast,
        published=_folder(config.published, "published"),
        seeds=config.seeds or (1 if fast else 3),
        models=job.run_dir / "models",
        policies=_folder(config.policies, "policies"),
        seed=config.seed,
    )
    needed = {
        f"{name}_seed{seed}": [*words, f"seed={seed}", *(figure_table.FAST if fast else ())]
        for figure in names
        for name, words in figure_table.FIGURES[figure].trainings(settings).items()
        for seed in range(settings.seeds)
    }
    _check_files(needed, config.published)
    lost = train_all({settings.models / name: words for name, words in needed.items()}, at_once=config.jobs)
    outcomes: dict[str, ExperimentOutcome] = {}
    failed: dict[str, str] = {}
    for name in names:
        trainings = figure_table.FIGURES[name].trainings(settings)
        without = [t for t in lost if t.rsplit("_seed", 1)[0] in trainings]
        if without:
            failed[name] = lost[without[0]]
            continue
        try:
            outcomes[name] = figure_table.FIGURES[name].draw(settings)
        except NsdeError as error:
            failed[name] = str(error)
            log.error("%s: %s", name, error)
    write(job.run_dir, outcomes, failed, settings)
    for name, outcome in outcomes.items():
        print(f"\n{name}: {outcome.title}")
        for check in outcome.checks:
            print(f"  [{check.word}] {check.claim}: {check.measured}")
    print(f"\n{job.took}; wrote {job.run_dir / 'figures.md'}")
    if failed:
        raise NsdeError(f"not drawn: {'; '.join(f'{k} ({v})' for k, v in failed.items())}")


def chosen(words: Sequence[str]) -> list[str]:
    """Names of figures in the order of the table; `all` is every one. ConfigError: there is no such figure."""
    unknown = sorted({w for w in words if w != "all" and w not in figure_table.FIGURES})
    if unknown or not words:
        raise ConfigError(
            f"`figures` must be `all` or of {', '.join(figure_table.FIGURES)}; got {unknown or 'none'}."
        )
    return [name for name in figure_table.FIGURES if "all" in words or name in words]


def _folder(path: str | None, key: str) -> Path | None:
    if path is None:
        return None
    folder = Path(path).expanduser().resolve()
    if not folder.is_dir():
        raise ConfigError(f"`{key}={path}`: no such folder.")
    return folder


def _check_files(needed: Mapping[str, Sequence[str]], published: str | None) -> None:
    """Refuse a folder without the authors' files before anything is trained."""
    keys = ("data.path=", "data.test_path=")
    paths = {w.partition("=")[2] for words in needed.values() for w in words if w.startswith(keys)}
    missing = sorted(path for path in paths if not Path(path).is_file())
    if missing:
        raise ConfigError(
            f"`published={published}` must be the folder of the authors' files; it has no {', '.join(missing)}."
        )


def write(
    folder: Path, outcomes: Mapping[str, ExperimentOutcome], failed: Mapping[str, str], settings: Settings
) -> None:
    """Pictures, `figures.json` and the page `figures.md`."""
    from nsde_torch import plots

    kind = "fast settings, for a look" if settings.fast else "full settings, for the record"
    data = "the authors' data" if settings.published else "data of the package's own plants"
    seeds = f"{settings.seeds} model{'s' * (settings.seeds > 1)} of each kind"
    lines = ["# Figures of the supplement, made anew", "", f"Made with {kind}: {seeds}, {data}.", ""]
    content: dict[str, Any] = {"settings": kind, "data": data, "seeds": settings.seeds, "figures": {}}
    for name, outcome in outcomes.items():
        lines += [f"## {name}: {outcome.title}", ""]
        pictures = []
        for part, figure in outcome.figures.items():
            words = "".join(c if c.isalnum() else "_" for c in part)
            picture = plots.save(figure, folder / f"{name}_{words}.png")
            pictures.append(picture.name)
            lines += [f"![{part}]({picture.name})", ""]
        lines += [f"The supplement says: {outcome.source}", "", "| claim | measured | |", "|---|---|---|"]
        lines += [f"| {c.claim} | {c.measured} | **{c.word}** |" for c in outcome.checks]
        lines += ["", *(f"- {note}" for note in outcome.notes), ""]
        content["figures"][name] = {
            "title": outcome.title,
            "supplement": outcome.source,
            "pictures": pictures,
            "checks": [{"claim": c.claim, "measured": c.measured, "result": c.word} for c in outcome.checks],
            "values": outcome.values,
            "notes": outcome.notes,
        }
    content["not_drawn"] = dict(failed)
    lines += [f"{name} was not drawn: {reason}" for name, reason in failed.items()]
    (folder / "figures.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    (folder / "figures.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
