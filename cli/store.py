"""What Hydra composes a command's configuration from: its schema, the schemas of choices, its groups and its folder.

The YAML files of `conf/` choose values within groups, and a choice that is its schema needs
none; a command's own defaults list is made here, of its object.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .groups import without_file
from .schemas import CHOICES, NAMES

if TYPE_CHECKING:
    from .hydra_command import HydraCommand


_TOLD: list[Any] = []  # what holds the choices of this module's own schemas


def store(command: HydraCommand) -> None:
    """Tell Hydra of a command; schemas stand apart from the choices, in the group `schema`."""
    from hydra.core.config_store import ConfigStore

    known = ConfigStore.instance()
    known.store(group="schema", name=command.name, node=command.schema)
    known.store(name=command.name, node=primary(command))
    if _TOLD and _TOLD[0] is known.repo:
        return  # these are of no command alone, and take Hydra a tenth of a second
    _TOLD[:] = [known.repo]
    launcher = {"_target_": "hydra_plugins.nsde_torch.Batched", "n_jobs": 0}  # see `cli.batched`
    known.store(group="hydra/launcher", name="batched", node=launcher, provider="nsde_torch")
    for group_name in {**CHOICES, **NAMES}:
        for choice, node in without_file(group_name).items():
            known.store(group=group_name, name=choice, node=node)
    for group_name, choices in CHOICES.items():
        for choice, schema in choices.items():
            known.store(group=f"schema/{group_name}", name=choice, node=schema)


def primary(command: HydraCommand) -> dict[str, Any]:
    """The content of a command's primary config: defaults list, values, and where Hydra writes."""
    chosen = [{group: choice} for group, choice in command.groups.items() if choice is not None]
    # a group without a choice comes last: what is chosen for it wins over the command's own values
    open_groups = [{group: None} for group, choice in command.groups.items() if choice is None]
    defaults: list[Any] = [f"/schema/{command.name}@_here_", *chosen, "_self_", *open_groups]
    hydra: dict[str, Any] = {"job": {"name": command.name, "chdir": False}}
    content: dict[str, Any] = {"defaults": defaults, **command.values, "hydra": hydra}
    if command.folder is None:
        # no configuration and no log: beside data of a simulation they would say what is in them
        defaults.append({"override hydra/job_logging": "stdout"})
        hydra |= {"output_subdir": None, "run": {"dir": "."}}
        return content
    content[command.folder_key] = command.folder
    hydra["run"] = {"dir": f"${{{command.folder_key}}}"}
    if "sweep_dir" in command.schema.__dataclass_fields__:  # type: ignore[attr-defined]
        content["sweep_dir"] = "multirun/${now:%Y-%m-%d}/${now:%H-%M-%S}"
        hydra["job"]["config"] = {"override_dirname": {"exclude_keys": list(command.unnamed)}}
        # The overrides name the job; slashes, brackets and quotes would not make a good folder.
        subdir = "${hydra.job.num}_${nsde.folder:${hydra:job.override_dirname}}"
        hydra["sweep"] = {"dir": "${sweep_dir}", "subdir": subdir}
        hydra["callbacks"] = {"nsde_sweep_watch": {"_target_": "nsde_torch.cli.jobs.SweepWatch"}}
    return content
