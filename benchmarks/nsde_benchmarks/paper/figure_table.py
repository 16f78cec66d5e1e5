"""The supplement's figures by name: which models each needs, and what draws it.

A training is named once, so that figures share it; its words are those of `nsde train`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nsde_torch.cli.schemas import CHOICES

if TYPE_CHECKING:
    from nsde_torch.data import Split
    from nsde_torch.models import Model

    from . import ExperimentOutcome

# Words of `nsde train` for a look in minutes; `full` takes the defaults.
FAST = ("trainer.steps=400", "trainer.polish=100")


@dataclass(frozen=True)
class Settings:
    """What all figures of one call have in common."""

    fast: bool  # for a look in minutes, instead of for the record
    published: Path | None  # folder of the authors' files; None makes the data with our own plants
    seeds: int  # models of each kind
    models: Path  # folder of the trained models
    policies: Path | None  # folder of a policy study, or None
    seed: int

    def run_dirs(self, *names: str) -> list[list[Path]]:
        """The run directories of each training name, one per seed."""
        return [[self.models / f"{name}_seed{s}" for s in range(self.seeds)] for name in names]

    def models_of(self, *names: str) -> list[list[Model]]:
        """The models of each training name, one per seed."""
        from nsde_torch.models import load

        return [[load(folder) for folder in folders] for folders in self.run_dirs(*names)]


@dataclass(frozen=True)
class Figure:
    # words of `nsde train` by name; the seed is added
    trainings: Callable[[Settings], Mapping[str, list[str]]]
    draw: Callable[[Settings], ExperimentOutcome]  # makes pictures and checks once these models are there


_SPRING_SETS = {
    "fig5": ("TopRight", "[[0.05,0.15],[0.05,0.15]]", "five runs of one corner"),
    "fig9": ("FullSpace", "[[-0.1,0.1],[-0.1,0.1]]", "five runs of the whole region"),
}


_KINDS = ("sde", "ode", "ensemble")


def _spring(name: str) -> Figure:
    region, bounds, words = _SPRING_SETS[name]

    def trainings(settings: Settings) -> dict[str, list[str]]:
        base = ["system=mass_spring_damper"]
        if settings.published is None:
            base += [f"data.options.region={bounds}", "data.durations=[5,5,5,5,5,5]"]
        else:
            folder = settings.published / "mass_spring_damper"
            base += ["data=published", f"data.path={folder / f'MSD_MeasHigh_{region}_5.pkl'}"]
            base.append(f"data.test_path={folder / 'MSD_TestData.pkl'}")
        unknown = [*base, "system.declared=[]"]
        return {
            f"spring_{region}_sde": unknown,
            f"spring_{region}_node": [*unknown, "model=node"],
            f"spring_{region}_ensemble": [*base, "model=ensemble"],
            f"spring_{region}_physics_sde": base,
            f"spring_{region}_physics_node": [*base, "model=node"],
        }

    def draw(settings: Settings) -> ExperimentOutcome:
        from .spring import state_evolution, together

        def evolution(title: str, *kinds: str, of: str = "") -> ExperimentOutcome:
            names = [f"spring_{region}_{of}{kind}" for kind in kinds]
            models = dict(zip(_KINDS, settings.models_of(*names), strict=False))
            return state_evolution(models, title=f"spring, {words}; {title}", seed=settings.seed)

        return together(
            evolution("the acceleration is unknown", "sde", "node", "ensemble"),
            evolution("spring and damper are declared", "sde", "node", of="physics_"),
        )

    return Figure(trainings, draw)


_CARTPOLE_SETS = {"learned": ("on_policy", "on-policy data"), "random": ("random", "random data")}
# Twenty of the hundred episodes are held out.
_EPISODES = "data.test=[" + ",".join(str(k) for k in range(80, 100)) + "]"


def _cartpole_words(settings: Settings, policy: str) -> list[str]:
    base = ["system=cartpole", _EPISODES]
    if settings.published is None:
        durations, own = f"data.durations=[{','.join(['4'] * 100)}]", _CARTPOLE_SETS[policy][0]
        noise = ("data.sensor_noise=10", "data.process_noise=0")
        return [*base, durations, f"data.options.policy={own}", *noise]
    return [*base, "data=published", f"data.path={settings.published / 'cartpole' / f'{policy}.pkl'}"]


def _cartpole_map(policy: str) -> Figure:
    name = f"cartpole_{policy}_sde"
    words = _CARTPOLE_SETS[policy][1]

    def draw(settings: Settings) -> ExperimentOutcome:
        from nsde_torch.models import NeuralSDE

        from .cartpole import uncertainty_map

        ((folder, *_),), ((model, *_),) = settings.run_dirs(name), settings.models_of(name)
        split = held_out(folder)
        assert isinstance(model, NeuralSDE)
        return uncertainty_map(model, split.train, split.test, data_name=words, seed=settings.seed)

    return Figure(lambda settings: {name: _cartpole_words(settings, policy)}, draw)


def _cartpole_evolution() -> Figure:
    names = {"sde": "cartpole_learned_sde", "ensemble": "cartpole_learned_ensemble"}

    def draw(settings: Settings) -> ExperimentOutcome:
        from .cartpole import state_evolution

        models = dict(zip(names, settings.models_of(*names.values()), strict=True))
        test = held_out(settings.run_dirs(names["sde"])[0][0]).test
        return state_evolution(models, test, seed=settings.seed)

    return Figure(
        lambda settings: {
            names["sde"]: _cartpole_words(settings, "learned"),
            names["ensemble"]: [*_cartpole_words(settings, "learned"), "model=ensemble"],
        },
        draw,
    )


def _recorded() -> Figure:
    def draw(settings: Settings) -> ExperimentOutcome:
        from nsde_torch.recording import read
        from nsde_torch.simulation import simulated
        from nsde_torch.systems import make_system

        from .flights import recorded

        system = make_system("hexacopter")
        if settings.published is None:
            return recorded(simulated(system), system, data_name="simulated flights")
        data = read("published", system, path=str(settings.published / "hexacopter" / "trajs.pkl"))
        lost = (
            "The published file holds less than the flights that the supplement describes: seconds by its own clock, "
            "which is slow (docs/content/how-to/data.md), and without the rows of two hidden gaps."
        )
        return recorded(data, system, data_name="published flights", note=lost)

    return Figure(lambda settings: {}, draw)


def _identification() -> Figure:
    # Both are integrated alike well: the system's own method takes p + v dt for a position, which is 7 mm off after
    # 0.25 s, more than what the two differ by.
    def flights(settings: Settings) -> tuple[int, ...]:
        return (2,) if settings.fast else (0, 1, 2)

    def trainings(settings: Settings) -> dict[str, list[str]]:
        path, of = settings.published, ["system=hexacopter"]
        of += [] if path is None else ["data=published", f"data.path={path / 'hexacopter' / 'trajs.pkl'}"]
        return {
            f"hexacopter_{kind}_flight{flight}": [*of, f"data.test=[{flight}]", *more]
            for flight in flights(settings)
            for kind, more in (("sde_heun", ["solver=heun"]), ("sysid", ["model=sysid"]))
        }

    def draw(settings: Settings) -> ExperimentOutcome:
        from .flights import against_identification

        names = {
            kind: [f"hexacopter_{of}_flight{k}" for k in flights(settings)]
            for kind, of in (("sde", "sde_heun"), ("sysid", "sysid"))
        }
        models = {kind: [m for of in settings.models_of(*own) for m in of] for kind, own in names.items()}
        folders = [f for of in settings.run_dirs(*names["sde"]) for f in of]
        data, note = "simulated flights", ""
        if settings.published is not None:
            data = "published flights"
            note = (
                "The inputs of the published flights see 0.2 s into the future (a centred moving average); the filter "
                "of the SDE draws on commands up to 0.6 s ahead."
            )
        tests = [held_out(f).test for f in folders]
        return against_identification(models, tests, data_name=data, note=note, seed=settings.seed)

    return Figure(trainings, draw)


def _policies(kinds: tuple[str, ...], title: str, source: str) -> Figure:
    def draw(settings: Settings) -> ExperimentOutcome:
        from . import Check, ExperimentOutcome
        from .policies import learned_in

        if settings.policies is None:
            missing = Check(source, "give policies=DIR of a study by benchmarks/bench_policy.py", None)
            return ExperimentOutcome(title, source, checks=[missing])
        return learned_in(settings.policies, kinds, title=title, source=source)

    return Figure(lambda settings: {}, draw)


def held_out(folder: Path) -> Split:
    """Training and test runs of a run directory, as its configuration says."""
    import yaml
    from omegaconf import OmegaConf

    from nsde_torch.api.reading import split_runs
    from nsde_torch.cli import build

    config = OmegaConf.create(yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))["config"])
    system = build.system_options(config.system).make()
    return split_runs(build.dataset(config.data, system), config.data.test)


FIGURES: dict[str, Figure] = {
    "fig5": _spring("fig5"),
    "fig9": _spring("fig9"),
    "fig10": _cartpole_map("learned"),
    "fig11": _cartpole_map("random"),
    "fig12": _cartpole_evolution(),
    "fig13": _policies(
        ("nsde", "ensemble", "ensemble_redrawn"),
        "Cartpole: policies that learned in models",
        "Policies that learn in the neural SDE earn what those earn that learn on the truth, from 30 times fewer "
        "interactions with it; those that learn in the ensemble do not.",
    ),
    "fig14": _policies(
        ("nsde", "blackbox_nsde", "node"),
        "Cartpole: policies that learned in models with and without physics",
        "Policies that learn in models with physics earn more than those that learn in models without.",
    ),
    "fig15": _recorded(),
}
if "sysid" in CHOICES["model"]:
    FIGURES["fig16"] = _identification()
