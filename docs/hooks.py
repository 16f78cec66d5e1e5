"""Pages of the site that are made from the code, and formulas as MathML.

`mkdocs` calls the functions named `on_...`. Whatever can be read from the package is: commands, configuration keys,
systems, effects, and one page of Python reference for each package, so that a page cannot say something else than the
code does.
"""

from __future__ import annotations

import ast
import html
import re
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "nsde_torch"
PLUG_INS = ROOT / "benchmarks" / "nsde_benchmarks"
_FORMULA = re.compile(r"\\\((?P<inline>.+?)\\\)|\\\[(?P<block>.+?)\\\]", re.DOTALL)


def on_config(config: Any) -> Any:
    """Put the pages of the packages into the navigation."""
    for section in config["nav"]:
        for entry in section.get("Reference", []):
            if isinstance(entry, dict) and "Python" in entry:
                entry["Python"] = [_api_path(name) for name in _packages()]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made from the code."""
    metadata.version("nsde_torch")  # the package must be installed: the pages are its own words
    pages = {
        "reference/commands.md": _commands(),
        "reference/configuration.md": _configuration(),
        "reference/systems.md": _systems(),
        "reference/effects.md": _effects(),
        **{_api_path(name): _api(name) for name in _packages()},
    }
    for path, content in pages.items():
        files.append(File.generated(config, path, content=content))
    return files


def on_page_content(text: str, page: Any, config: Any, files: Files) -> str:
    """Turn formulas, which arithmatex has marked, into MathML, which browsers show without a script."""

    def mathml(match: re.Match[str]) -> str:
        block = match["block"] is not None
        source = html.unescape(match["block"] if block else match["inline"])
        made: str = convert(source.strip(), display="block" if block else "inline")
        if "\\" in made or ">&<" in made:
            raise PluginError(f"{page.file.src_path}: no MathML for the formula {source!r}")
        return made

    return re.sub(
        r'(<(span|div) class="arithmatex">)(.*?)(</\2>)',
        lambda m: m[1] + _FORMULA.sub(mathml, m[3]) + m[4],
        text,
        flags=re.DOTALL,
    )


# --- commands and configuration ---------------------------------------------------------------------------------------


def _commands() -> str:
    from nsde_torch.cli import groups
    from nsde_torch.cli.registry import all_commands, hydra_commands

    lines = [
        "# Commands",
        "",
        "`nsde COMMAND --help` prints the keys of a command with unit, range and default.",
        "Exit status: 0 done, 1 some jobs of a sweep failed, 2 a fault of the user's input, 130 interrupted.",
        "`NSDE_TRACEBACK=1` shows the traceback of an error.",
        "",
        "| command | what it does | config groups | sweeps with `-m` |",
        "|---|---|---|---|",
    ]
    configured = hydra_commands()
    for name, command in all_commands().items():
        known = name in configured
        chosen = ", ".join(f"`{group}`" for group in groups.defaults(name)) if known else ""
        label = f"[`{name}`](configuration.md#nsde-{name})" if known else f"`{name}`"
        sweeps = "yes" if known and groups.sweeps(name) else ""
        lines.append(f"| {label} | {command.summary} | {chosen} | {sweeps} |")
    return "\n".join(lines)


def _configuration() -> str:
    from nsde_torch.cli import groups
    from nsde_torch.cli.registry import hydra_commands

    lines = [
        "# Configuration",
        "",
        "Every key of every command, from the schema that also checks what is typed. A key is set by `name=value`,",
        "a group is chosen by `group=choice`; `null` lets the program choose. `--config-dir DIR` adds choices of",
        "your own: `DIR/system/mine.yaml` is `system=mine`.",
        "",
        "## Commands",
    ]
    seen: dict[str, str] = {}
    for command in hydra_commands():
        chosen = groups.defaults(command)
        own = [key for key in groups.keys(command, chosen) if key.path.split(".")[0] not in chosen]
        lines += ["", f"### nsde {command}", ""]
        if chosen:
            named = [f"[`{g}={c}`](#{g})" if c != groups.NOTHING else f"`{g}`" for g, c in chosen.items()]
            lines += [f"Groups and their default choices: {', '.join(named)}.", ""]
        lines += _table(own)
        for group, choice in chosen.items():
            if choice != groups.NOTHING:
                seen.setdefault(group, command)
    lines += ["", "## Groups"]
    for group, command in seen.items():
        lines += ["", f"### {group}", ""]
        known = groups.choices(group)
        lines += [f"Choices: {', '.join(f'`{choice}`' for choice in known)}.", ""]
        lines += _group(group, command, known)
    return "\n".join(lines)


def _group(group: str, command: str, known: list[str]) -> Iterator[str]:
    """The keys of a group: those of its default choice in full, of the others what is different."""
    from nsde_torch.cli import groups

    default = groups.defaults(command)[group]
    first = _keys_of(group, command, default)
    yield f"`{group}={default}`:"
    yield ""
    yield from _table(first.values())
    for choice in known:
        if choice == default:
            continue
        own = _keys_of(group, command, choice)
        differing = [
            key for path, key in own.items() if path not in first or key.default != first[path].default
        ]
        if differing:
            yield f"\n`{group}={choice}`, where it differs:\n"
            yield from _table(differing)


def _keys_of(group: str, command: str, choice: str) -> dict[str, Any]:
    from nsde_torch.cli import groups

    chosen = {**groups.defaults(command), group: choice}
    return {key.path: key for key in groups.keys(command, chosen) if key.path.startswith(f"{group}.")}


def _table(keys: Any) -> Iterator[str]:
    from nsde_torch.cli.help import value_text

    yield "| key | default | unit | meaning |"
    yield "|---|---|---|---|"
    for key in keys:
        default = "required" if key.default == "???" else f"`{value_text(key.default)}`"
        if key.path in ("run_dir", "sweep_dir", "out_dir"):
            default = "dated"
        meaning = _cell(key.help) + (f" ({_cell(key.allowed)})" if key.allowed else "")
        yield f"| `{key.path}` | {default} | {_cell(key.unit)} | {meaning} |"


# --- systems and effects ----------------------------------------------------------------------------------------------


def _systems() -> str:
    from nsde_torch.systems import SYSTEMS, make_system

    lines = [
        "# Systems",
        "",
        "Machines that the package knows, from their classes. World ENU, body FLU, quaternion `w x y z` body to",
        "world, SI units, commands of multirotors in [0, 1], motors numbered as in PX4. Mass, inertia and mixer",
        "gains enter motion only as ratios, so ratios are what is fitted.",
        "[A machine of your own](../tutorials/own-machine.md).",
    ]
    for name, cls in SYSTEMS.items():
        system = make_system(name)
        defaults = cls.defaults
        lines += ["", f"## {name}", "", _first(cls.__doc__), ""]
        lines += ["| columns | |", "|---|---|"]
        lines.append(f"| state | {_columns(cls.state_names, cls.state_units)} |")
        lines.append(f"| input | {_columns(system.input_names, system.input_units)} |")
        lines.append(f"| ports | {', '.join(f'`{port.value}`' for port in cls.ports)} |")
        declared = ", ".join(f"[`{effect}`](effects.md#{effect})" for effect in cls.declared)
        lines.append(f"| declared effects | {declared or 'none'} |")
        lines.append(f"| step, horizon | {defaults.dt:g} s, {defaults.horizon} steps |")
        lines.append(f"| solver | `{defaults.step}` |")
        lines += ["", "| parameter | first value | unit | bounds | meaning |", "|---|---|---|---|---|"]
        lines += [_parameter_row(label, spec) for label, spec in cls.PARAMETERS.items()]
    return "\n".join(lines)


def _columns(names: Any, units: Any) -> str:
    return ", ".join(f"`{name}` [{unit}]" for name, unit in zip(names, units, strict=True))


def _parameter_row(name: str, spec: Any) -> str:
    bounds = " to ".join("" if bound is None else f"{bound:g}" for bound in (spec.low, spec.high))
    bounds = {" to ": "free"}.get(bounds, bounds if not bounds.endswith(" to ") else f"above {bounds[:-4]}")
    return f"| `{name}` | {spec.initial} | {spec.unit} | {bounds} | {_cell(spec.help)} |"


def _effects() -> str:
    from nsde_torch.cli.commands.effects import catalogue

    rows = catalogue()
    lines = [
        "# Effects",
        "",
        f"The catalogue of `nsde effects`: {len(rows)} physical terms with formula, bounded parameters and source.",
        "[How to add some, or one of your own](../how-to/effects.md).",
        "",
        "| effect | port | systems |",
        "|---|---|---|",
    ]
    lines += [
        f"| [`{row['name']}`](#{row['name']}) | `{row['port']}` | {', '.join(row['systems'])} |"
        for row in rows
    ]
    for row in rows:
        lines += ["", f"## {row['name']} {{#{row['name']}}}", "", f"`{row['formula']}`", ""]
        lines += [f"Port `{row['port']}`; for {', '.join(row['systems'])}. Source: {_text(row['source'])}."]
        lines += [""] + [f"- {note}" for note in _notes(row)]
        if row["parameters"]:
            lines += ["", "| parameter | unit | bounds | numbers | meaning |", "|---|---|---|---|---|"]
            lines += [_effect_parameter(parameter) for parameter in row["parameters"]]
    return "\n".join(lines)


def _notes(row: dict[str, Any]) -> Iterator[str]:
    if row["sentence"]:
        yield f"Reported as: {_text(row['sentence'])}"
    if row["separate"]:
        yield f"An experiment that tells it apart: {_text(row['separate'])}"
    if row["memory_per_input"]:
        yield f"Memory: {row['memory_per_input']} states per input."
    if row["exogenous"]:
        yield f"Reads the logged columns {', '.join(f'`{name}`' for name in row['exogenous'])}."
    if row["includes"]:
        yield f"Includes {', '.join(f'[`{name}`](#{name})' for name in row['includes'])} as special cases."


def _effect_parameter(parameter: dict[str, Any]) -> str:
    low, high = parameter["low"], parameter["high"]
    bounds = (
        "free" if low is high is None else f"{'' if low is None else low} to {'' if high is None else high}"
    )
    axes = {"inputs": "one per input"}.get(str(parameter["axes"]), str(parameter["axes"]))
    return f"| `{parameter['name']}` | {parameter['unit']} | {bounds} | {axes} | {_cell(parameter['help'])} |"


# --- Python -----------------------------------------------------------------------------------------------------------


def _packages() -> list[str]:
    """The public packages by dotted name, the top one first."""
    below = sorted(path.parent for path in PACKAGE.glob("*/__init__.py"))
    plug_ins = sorted(path.parent for path in PLUG_INS.glob("*/__init__.py"))
    return ["nsde_torch", *(f"{path.parent.name}.{path.name}" for path in [*below, *plug_ins])]


def _api_path(name: str) -> str:
    return f"reference/api/{name}.md"


def _api(name: str) -> str:
    """What a package offers, and a table of its modules with what each is for."""
    beside = PLUG_INS.parent if name.startswith(PLUG_INS.name) else ROOT
    folder = beside.joinpath(*name.split("."))
    lines = [f"# {name}", "", f"::: {name}", "    options:"]
    lines += ["      show_root_heading: false", "      show_root_toc_entry: false"]
    if name == "nsde_torch":
        lines += ["      members: false", ""]
        lines += [f"::: {name}.{public}\n" for public in _verbs_first()]
    lines += [""]
    modules = sorted(folder.glob("*.py") if name == "nsde_torch" else folder.rglob("*.py"))
    modules = [path for path in modules if not path.name.startswith("__") or path.parent != folder]
    if modules:
        lines += ["## Modules", "", "| module | |", "|---|---|"]
    for path in modules:
        parts = path.relative_to(beside).with_suffix("").parts
        dotted = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        lines.append(f"| `{dotted}` | {_cell(_first(text))} |")
    return "\n".join(lines)


def _verbs_first() -> list[str]:
    """What `nsde_torch` exports: the verbs of a first hour in their order, the other functions, the classes."""
    import nsde_torch

    hour = ["read", "inspect", "diagnose", "train", "evaluate"]
    others = [name for name in nsde_torch.__all__ if name not in hour and not name.startswith("_")]
    return hour + sorted(others, key=lambda name: name[0].isupper())


def _first(text: str | None) -> str:
    """The first paragraph of a docstring as one line."""
    return " ".join((text or "").strip().split("\n\n")[0].split())


def _text(value: str) -> str:
    """Plain words as Markdown that shows them as they are; code in backticks is left alone."""
    parts = re.split(r"(`[^`]+`)", value)
    return "".join(
        part if k % 2 else re.sub(r"([*_<>\[\]\\])", r"\\\1", part) for k, part in enumerate(parts)
    )


def _cell(value: str) -> str:
    return _text(value).replace("|", "\\|")
