"""Committed tests in which a rule of a diagnosis fires, and whether they hold without it (`ledger_rules`).

    python benchmarks/blind/ledger_tests.py --out runs/ledger_tests.json tests/diagnosis -q
    python benchmarks/blind/ledger_tests.py --without "late sensor" tests/diagnosis/test_recording_chain.py -q -k late

The first writes the rules that fire by test, those of a fixture by the first test that needs it; the second runs tests
with a rule switched off. All other words go to pytest.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent))
from ledger_rules import RULES, counted, without


class Watch:
    """Notes for each test which rules fire in it."""

    def __init__(self, out: Path) -> None:
        self.out, self.fired = out, dict[str, int]()
        self.found: dict[str, dict[str, int]] = (
            json.loads(out.read_text(encoding="utf-8")) if out.is_file() else {}
        )

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Iterator[None]:
        """Counts from before the fixtures of a test to after it."""
        self.fired.clear()
        out = yield
        self.found[item.nodeid] = dict(self.fired)
        self.out.write_text(json.dumps(self.found, indent=1), encoding="utf-8")
        return out


def main() -> None:
    """Runs pytest with all rules watched, or one switched off."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--out", type=Path, help="file of the rules that fire, by test")
    what.add_argument("--without", choices=[rule.name for rule in RULES], help="rule to switch off")
    given, rest = parser.parse_known_args()
    if given.without:
        with without(next(rule for rule in RULES if rule.name == given.without)):
            raise SystemExit(pytest.main(rest))
    watch = Watch(given.out)
    with counted(watch.fired):
        raise SystemExit(pytest.main(rest, plugins=[watch]))


if __name__ == "__main__":
    main()
