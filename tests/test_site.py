"""The site is read from the disk: its search, its style and its code blocks need no server and no network."""

import importlib
import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import nsde_torch
from tests.helpers.browser import chromium

PAGE = """# Machines

```text
the rotor drag of a long line {words} end
```

```{{ .text .wide }}
a table that is wider than its page {words} end
```
"""


@pytest.fixture(scope="module")
def site(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site's theme, style, search and extensions around two small pages."""
    pytest.importorskip("material", reason="needs the extra `docs`")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(root / "docs" / "content" / "javascripts", folder / "pages" / "javascripts")
    shutil.copy(root / "docs" / "content" / "extra.css", folder / "pages")
    (folder / "pages" / "index.md").write_text("# Home\n\nNothing here.\n")
    (folder / "pages" / "machines.md").write_text(PAGE.format(words="word " * 40))
    where = {"docs_dir": str(folder / "pages"), "site_dir": str(folder / "built")}
    build(load_config(str(root / "docs" / "mkdocs.yml"), nav=None, hooks=[], **where))
    return folder / "built"


def test_the_index_of_the_search_is_a_script_that_holds_the_pages(site: Path) -> None:
    script = (site / "search" / "search_index.js").read_text(encoding="utf-8")
    name, equals, index = script.partition(" = ")
    assert (name, equals) == ("var __index", " = ")
    (found,) = [entry for entry in json.loads(index)["docs"] if "rotor drag" in entry["text"]]
    assert found["location"].startswith("machines.html")


def test_a_page_of_the_site_loads_nothing_from_the_network(site: Path) -> None:
    page = (site / "machines.html").read_text(encoding="utf-8")
    loaded = re.findall(r'<(?:script|link|img|iframe)\b[^>]*?(?:src|href)="([^"]+)"', page)
    assert len(loaded) >= 4
    for address in loaded:
        assert "://" not in address
        assert (site / address).is_file(), address


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with chromium(tmp_path_factory.mktemp("profile")) as found:
        yield found


def _wait(driver: Any, seen: Callable[[], Any]) -> Any:
    """What is seen, once it is."""
    from selenium.webdriver.support.ui import WebDriverWait

    return WebDriverWait(driver, 20).until(lambda _: seen())


def test_the_search_answers_on_a_site_that_was_opened_from_the_disk(site: Path, driver: Any) -> None:
    driver.get((site / "index.html").as_uri())
    (field,) = _wait(driver, lambda: driver.find_elements("css selector", "input.md-search__input"))
    driver.execute_script("arguments[0].focus()", field)
    field.send_keys("rotor")
    answers = _wait(driver, lambda: driver.find_elements("css selector", ".md-search-result__link"))
    pages = [answer.get_attribute("href").split("/")[-1].split("?")[0] for answer in answers]
    assert pages == ["machines.html"]


def test_long_lines_wrap_clear_of_the_button_and_wide_tables_scroll(site: Path, driver: Any) -> None:
    driver.get((site / "machines.html").as_uri())
    _wait(driver, lambda: len(driver.find_elements("css selector", ".highlight button")) == 2)
    measured = driver.execute_script(
        """return [...document.querySelectorAll(".md-typeset pre")].map(pre => {
            const code = pre.querySelector("code"), button = pre.parentElement.querySelector("button")
            const clear = button.getBoundingClientRect().left - code.getBoundingClientRect().right
            return [code.scrollWidth - code.clientWidth, clear]
        })"""
    )
    (long, clear), (wide, also_clear) = measured
    assert long == 0
    assert wide > 100
    assert min(clear, also_clear) >= 0


def test_the_reference_of_the_package_begins_with_the_verbs_of_the_first_hour(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("material", reason="needs the extra `docs`")
    monkeypatch.syspath_prepend(str(root / "docs"))
    hooks = importlib.import_module("hooks")
    shown = re.findall(r"^::: nsde_torch\.(\w+)$", hooks._api("nsde_torch"), flags=re.MULTILINE)
    assert shown[:5] == ["read", "inspect", "diagnose", "train", "evaluate"]
    assert sorted(shown) == sorted(set(nsde_torch.__all__) - {"__version__"})
    classes = [name for name in shown if name[0].isupper()]
    assert shown[-len(classes) :] == classes
