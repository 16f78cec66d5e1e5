"""Make the blocks of output in the pages anew: each is what its command prints today.

    <!-- run: nsde effects system=cartpole -->   runs; the block of text that follows is what it prints
    <!-- run -->                                 runs the block of commands that follows, and prints to output.txt
    <!-- run slow: ... -->, <!-- run slow -->    the same where it takes longer than a test may
    <!-- no run: why -->                         before a block that no command can print here, and why

The commands of a page run in turn, in one scratch folder with `examples` and `benchmarks` of the checkout. A command
that names $PUBLISHED needs the published data and is left where that variable is not set. A line that differs in
seconds, dates or the scratch folder alone stays as it was, and so does a first line `$ ...`, which shows the command.
What a block leaves out its command takes out, as by `| sed '/^from/,/^to/c[...]'`; of several such lines one stays.

    python docs/blocks.py [--check] [PAGE ...]   writes what differs; --check shows it, and fails
"""

from __future__ import annotations

import argparse
import difflib
import os
import re
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs" / "content").rglob("*.md")))
_FENCED = r"(?P<fence> *``` ?(?P<info>[^\n]*)\n)(?P<block>.*?)^ *```$"
FENCED = re.compile("^" + _FENCED, re.MULTILINE | re.DOTALL)
MARK = re.compile(
    r"^(?P<indent> *)<!-- (?P<no>no )?run(?P<slow> slow)?(?:: (?P<command>.+?))? -->\n\n?"
    + f"(?:{_FENCED})?",
    re.MULTILINE | re.DOTALL,
)
VARIES = re.compile(r"\btook \d+(\.\d+)? (s|min)|\d{4}-\d\d-\d\d[/T]\d\d[-:]\d\d[-:]\d\d")


def is_output(mark: re.Match[str]) -> bool:
    """Whether the block after a mark is what its command prints."""
    return bool(mark["command"]) and "text" in (mark["info"] or "")


def made(mark: re.Match[str], printed: str) -> str:
    """The text of a block from what its command printed; lines that vary without meaning stay."""
    old = textwrap.dedent(mark["block"]).splitlines()
    new = [line.rstrip() for line in printed.strip("\n").splitlines()]
    if old[:1] and old[0].startswith("$ "):
        new.insert(0, old[0])
    known = {VARIES.sub("~", line): line for line in old}
    lines = [known.get(VARIES.sub("~", line), line) for line in new]
    lines = [line for k, line in enumerate(lines) if line != "[...]" or lines[k - 1 : k] != ["[...]"]]
    return textwrap.indent("\n".join(lines) + "\n", mark["indent"])


def words(mark: re.Match[str]) -> str:
    """What a mark runs; one line, if it is in the mark."""
    return " ".join(mark["command"].split()) if mark["command"] else textwrap.dedent(mark["block"])


def run(command: str, folder: Path) -> str:
    """What a command prints on its standard output, which it leaves in output.txt too.

    Raises:
        RuntimeError: It failed.
    """
    paths = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    env = {**os.environ, "PATH": paths, "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg", "COLUMNS": "120"}
    words = ["bash", "-e", "-o", "pipefail", "-c", command]
    done = subprocess.run(words, cwd=folder, env=env, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(
            f"status {done.returncode} of `{command}`:\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
        )
    printed = done.stdout.replace(f"{folder}/", "").replace(str(folder), "/home/me")
    if "output.txt" not in command:
        (folder / "output.txt").write_text(printed, encoding="utf-8")
    return printed


def renewed(page: Path, *, slow: bool = True) -> tuple[str, list[str]]:
    """A page with its blocks made anew.

    Args:
        page: The page.
        slow: Run all of it; otherwise what comes before the first slow command.

    Returns:
        Its text, and what failed: the blocks of commands that fail stay as they were.
    """
    text = page.read_text(encoding="utf-8")
    pieces, end, failed = [], 0, []
    with tempfile.TemporaryDirectory() as name:
        for part in ("examples", "benchmarks"):
            (Path(name) / part).symlink_to(ROOT / part)
        for mark in marks(text, slow=slow):
            try:
                printed = run(words(mark), Path(name))
            except RuntimeError as error:
                failed.append(f"line {text.count(chr(10), 0, mark.start()) + 1}: {error}")
                continue
            if is_output(mark):
                pieces += [text[end : mark.start("block")], made(mark, printed)]
                end = mark.end("block")
    return "".join(pieces) + text[end:], failed


def marks(text: str, *, slow: bool = True) -> Iterator[re.Match[str]]:
    """The marks of a page whose commands can run here, in turn."""
    for mark in MARK.finditer(text):
        if mark["slow"] and not slow:
            return
        command = mark["command"] or mark["block"]
        if not mark["no"] and ("$PUBLISHED" not in command or "PUBLISHED" in os.environ):
            yield mark


def main() -> None:
    """Make the blocks of the pages anew, or say what differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pages", nargs="*", type=Path, help="pages (all)")
    parser.add_argument(
        "--check", action="store_true", help="write nothing; end with 1 where a block differs"
    )
    a = parser.parse_args()
    status = 0
    for page in [p.resolve() for p in a.pages] or PAGES:
        old = page.read_text(encoding="utf-8")
        if not any(marks(old)):
            continue
        print(page.relative_to(ROOT), flush=True)
        new, failed = renewed(page)
        changes = difflib.unified_diff(old.splitlines(), new.splitlines(), "page", "today", lineterm="", n=0)
        for line in (*failed, *changes):
            print(f"  {line}", flush=True)
        if not a.check:
            page.write_text(new, encoding="utf-8")
        status |= bool(failed) or (a.check and new != old)
    sys.exit(status)


if __name__ == "__main__":
    main()
