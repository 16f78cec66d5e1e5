"""The documentation says what is so: links lead somewhere, commands exist, and the code of the pages runs."""

import importlib
import re
import shlex
import sys
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import nsde_torch
from nsde_torch.cli import groups
from nsde_torch.cli.main import main
from nsde_torch.cli.registry import all_commands, hydra_commands
from nsde_torch.diagnosis.result import Content
from nsde_torch.effects import Effect
from nsde_torch.recording import FAULTS

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs"))
blocks = importlib.import_module("blocks")  # docs/ is no package
sys.path.pop(0)
CONTENT = ROOT / "docs" / "content"
PAGES = sorted(CONTENT.rglob("*.md"))
OUTSIDE = [ROOT / "README.md", *sorted(ROOT.glob("benchmarks/*.md")), *sorted(ROOT.glob("examples/*/*.md"))]
"""Pages that a code host shows; mkdocs checks the links of the others."""

ALIASES = ("controller",)
"""Other names of a key: `controller=FILE` is `run=FILE`."""

FREE = (
    *("plant.parameters.", "system.parameters.", "system.options.", "model.options."),
    *("data.options.", "options.", "plant.options.", "hydra"),
)
"""Beginnings of keys whose names are not those of the schema."""


def code(page: Path, language: str) -> list[str]:
    """The code blocks of a page, blocks in tabs and lists included."""
    text = page.read_text(encoding="utf-8")
    return [textwrap.dedent(m["block"]) for m in blocks.FENCED.finditer(text) if m["info"] == language]


def commands() -> Iterator[tuple[str, list[str]]]:
    """Every `nsde ...` of every page, as words without comments."""
    for page in [*PAGES, *OUTSIDE]:
        inline = re.findall(r"`(nsde [^`]+)`", page.read_text(encoding="utf-8"))
        lines = [line for block in code(page, "bash") for line in block.replace("\\\n", " ").splitlines()]
        for line in [*inline, *lines]:
            for part in re.findall(r"(?:^|\s)(nsde .*)", " ".join(line.split())):
                yield f"{page.relative_to(ROOT)}: {part}", shlex.split(part, comments=True)[1:]


def keys_of(command: str) -> set[str]:
    """Every key that some choice of groups gives a command, and the groups themselves."""
    chosen = groups.defaults(command)
    found = set(chosen)
    for group in chosen:
        for choice in groups.choices(group):
            found |= {key.path for key in groups.keys(command, {**chosen, group: choice})}
    return found | {key.path for key in groups.keys(command, chosen)}


def test_the_readme_is_one_page(root: Path) -> None:
    assert len((root / "README.md").read_bytes()) <= 8000


@pytest.mark.parametrize("page", OUTSIDE, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_of_pages_outside_the_site_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
        assert "://" in target or (page.parent / target).exists(), target


def test_commands_of_the_pages_exist_and_take_what_is_typed() -> None:
    known = {command: keys_of(command) for command in hydra_commands()}
    checked = 0
    for where, words in commands():
        command, *rest = words
        if command.startswith("-") or command == "COMMAND":
            continue
        assert command in all_commands(), where
        for word in rest if command in known else ():
            key, equals, value = word.partition("=")
            if not equals or key in ALIASES or key.startswith(("-", *FREE)):
                continue
            assert key in known[command], f"{where}: no key {key}"
            if key in groups.defaults(command) and re.fullmatch(r"\w+", value) and "--config-dir" not in rest:
                assert value in groups.choices(key), f"{where}: no choice {word}"
            checked += 1
    assert checked > 150


def test_the_effect_of_the_page_is_one(root: Path) -> None:
    (block,) = code(CONTENT / "how-to" / "effects.md", "python")
    names: dict[str, type[Effect]] = {}
    exec(block, names)
    effect = names["Cogging"]({"size": 2.0, "pitch": 0.4})
    force = effect(torch.tensor(0.0), torch.tensor([[0.1, 0.0]]), torch.zeros(1, 1), torch.zeros(1, 0))
    assert float(force.detach()) == pytest.approx(-2.0)


SHORT = [
    pytest.param(p, id=p.stem, marks=[pytest.mark.slow] if p.stem == "simulate" else [])
    for p in PAGES
    if any(blocks.is_output(m) for m in blocks.marks(p.read_text(), slow=False))
]


@pytest.mark.parametrize("page", SHORT)
def test_short_blocks_are_what_their_commands_print_today(page: Path) -> None:
    text, failed = blocks.renewed(page, slow=False)
    assert not failed
    assert text == page.read_text(encoding="utf-8")


def test_every_block_of_output_names_its_command_or_says_why_none_can_print_it() -> None:
    made = 0
    for page in [ROOT / "README.md", *PAGES]:
        text = page.read_text(encoding="utf-8")
        marked = {mark.start("fence"): mark for mark in blocks.MARK.finditer(text) if mark["fence"]}
        for fence in blocks.FENCED.finditer(text):
            if not re.match(r"text$|\{ \.text", fence["info"]):
                continue
            line = text.count("\n", 0, fence.start()) + 1
            assert fence.start() in marked, f"{page.relative_to(ROOT)}:{line}: what prints this block?"
            mark = marked[fence.start()]
            assert mark["command"], f"{page.relative_to(ROOT)}:{line}: no command and no reason"
            made += not mark["no"]
    assert made > 10


def test_a_block_made_anew_keeps_seconds_and_dates_and_takes_every_other_change(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    lines = "$ nsde train", "took 3 s; wrote runs/2026-01-02/03-04-05_cart", "left: {left}", "[...]"
    fence = "\n".join(f"  {line}" for line in ("```text", *lines, "```\n"))
    printed = r"took 9 s; wrote runs/2027-01-02/03-04-05_cart\nleft: 0.06\n1\n2\n"
    mark = f"<!-- run: printf '{printed}' | sed '/^.$/c[...]' -->"
    page.write_text(f"  {mark}\n{fence.format(left=0.07)}after\n")
    text, failed = blocks.renewed(page)
    assert not failed
    assert text == page.read_text().replace("0.07", "0.06")


@pytest.mark.slow
def test_the_fault_of_the_page_is_simulated_found_and_undone(monkeypatch: pytest.MonkeyPatch) -> None:
    fault, register, use = code(CONTENT / "how-to" / "extend" / "recording-fault.md", "python")
    names: dict[str, Any] = {"__name__": __name__}
    monkeypatch.setitem(
        FAULTS, "quantisation", FAULTS["dropout"]
    )  # what the page registers ends with the test
    exec(compile(fault + register + use, "recording-fault.md", "exec", dont_inherit=True), names)
    made, found, data = names["made"], names["found"], names["data"]
    assert made.truth["recording"] == {"quantisation": {"q": 0.05}}
    assert found.added == ["quantisation"]
    assert found.sensor_faults["quantisation"] == {"q": pytest.approx(0.05)}
    assert found.content()["parameters"]["quantisation.q"]["value"] == pytest.approx(0.05)
    sound = nsde_torch.simulate("mass_spring_damper", **names["machine"])
    assert nsde_torch.diagnose(sound, system="mass_spring_damper").added == []

    def off(runs: Sequence[Any]) -> float:
        pairs = zip(runs, sound.runs, strict=True)
        return max(float(np.std(run.x[:, 0] - true.x[:, 0])) for run, true in pairs)

    assert off(made.runs) > 0.012  # a step over the square root of twelve
    assert off(found.recorded.runs) < 0.95 * off(made.runs)
    assert off(data.runs) == pytest.approx(off(found.recorded.runs))


@pytest.mark.slow
def test_the_python_of_the_tutorial_finds_what_it_says_and_the_reference_lists_every_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = CONTENT / "tutorials" / "own-log.md"
    monkeypatch.chdir(tmp_path)
    simulate = next(block for block in code(page, "bash") if block.startswith("nsde simulate"))
    assert main([*shlex.split(simulate)[1:], "durations=[4,4,4,4]"]) == 0
    (block,) = code(page, "python")
    names: dict[str, object] = {}
    exec(block, names)
    found = names["found"]
    assert set(found.added) == {"coulomb_friction[cart]", "viscous_friction[pole]"}  # type: ignore[attr-defined]
    assert "verdict: effect_found" in capsys.readouterr().out
    table = (CONTENT / "reference" / "diagnosis-json.md").read_text(encoding="utf-8")
    first = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    listed = {key for cell in first for key in re.findall(r"`(\w+)`", cell)} | {"summary"}
    assert set(Content.__annotations__) == listed - {"formula"}  # a kind of `findings`, with keys of its own
    optional = {"model", "rehearsal", "so_far"}
    assert set(found.content()) == set(Content.__annotations__) - optional  # type: ignore[attr-defined]
