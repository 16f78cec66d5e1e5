"""The page in a real browser, over a real socket; the commands behind it are played."""

import contextlib
import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import nsde_torch
from tests.helpers.browser import chromium, programs
from tests.serving.conftest import INSPECTION, TOKEN, Played, make_page

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

DROP = """
const [files] = arguments, data = new DataTransfer();
for (const [name, text] of Object.entries(files)) data.items.add(new File([text], name));
const event = new DragEvent("drop", {dataTransfer: data, bubbles: true, cancelable: true});
document.getElementById("drop").dispatchEvent(event);
"""
BEYOND = """
const edge = document.documentElement.clientWidth, inside = (e) => e.closest(".wide, textarea") === null;
return [...document.body.querySelectorAll("*")].filter((e) => inside(e) && e.getBoundingClientRect().right > edge + 1)
  .map((e) => e.outerHTML.slice(0, 200));
"""
CSV = {"run_0.csv": "t,q,q_dot,force\n0,1,0,0\n", "run_1.csv": "t,q,q_dot,force\n0,1,0,0\n"}
HOSTILE = "<img src=x onerror='document.title=1'>"


class Screen:
    """What a person does, and sees, at an address with its key; `folder` keeps the jobs."""

    def __init__(self, driver: Any, address: str, folder: Path) -> None:
        self.driver, self.address, self.folder = driver, address, folder

    def drop(self, files: dict[str, str]) -> None:
        self.driver.execute_script(DROP, files)

    def until(self, css: str, seen: Callable[[Any], bool] = lambda found: True) -> Any:
        from selenium.common.exceptions import NoSuchElementException, StaleElementReferenceException
        from selenium.webdriver.common.by import By
        from selenium.webdriver.support.ui import WebDriverWait

        gone = (NoSuchElementException, StaleElementReferenceException)

        def look(driver: Any) -> Any:
            found = driver.find_element(By.CSS_SELECTOR, css)
            return found if seen(found) else False

        return WebDriverWait(self.driver, 20, poll_frequency=0.05, ignored_exceptions=gone).until(look)

    def all(self, css: str) -> list[Any]:
        from selenium.webdriver.common.by import By

        found: list[Any] = self.driver.find_elements(By.CSS_SELECTOR, css)
        return found

    def says(self, text: str) -> None:
        """Wait for a message that holds this."""
        self.until("#message", lambda box: text in box.text)

    def press(self, text: str) -> None:
        self.until("button", lambda _: any(b.text == text for b in self.all("button")))
        next(b for b in self.all("button") if b.text == text).click()


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with chromium(tmp_path_factory.mktemp("profile")) as found:
        yield found


@pytest.fixture
def screen(driver: Any, tmp_path: Path, played: Played) -> Iterator[Screen]:
    """The page, opened with its key."""
    programs()
    from waitress.server import create_server

    from nsde_torch.cli.serving.app import listen

    sock = listen("127.0.0.1", 0)
    address = f"127.0.0.1:{sock.getsockname()[1]}"
    page = make_page(tmp_path / "served", played, hosts=[address], upload=1 << 18, keep=4)
    running = create_server(page.app, sockets=[sock], threads=4)

    def answer() -> None:
        with contextlib.suppress(OSError):  # its socket is closed at the end, from another thread
            running.run()

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    made = Screen(driver, f"http://{address}/#{TOKEN}", tmp_path / "served")
    driver.get_log("browser")
    driver.set_window_size(1200, 1000)
    driver.get("about:blank")
    driver.get(made.address)
    made.until("#kept li")
    yield made
    played.go.set()
    page.runner.close()
    running.close()


def test_from_drop_to_report(screen: Screen, played: Played) -> None:
    assert TOKEN not in screen.driver.current_url  # the key does not stay in the address
    screen.drop(CSV)
    screen.until("#start").send_keys("\n")  # by the keyboard
    screen.until(".stages .now", lambda row: row.text.startswith("screening effects (2 of 4)"))
    assert screen.driver.switch_to.active_element.text == "Stop"
    played.go.set()
    verdict = screen.until(".verdict")
    golden = json.loads((Path(__file__).parents[1] / "golden" / "diagnosis.json").read_text())
    assert golden["summary"] in verdict.text
    assert [f.text for f in screen.all(".finding h4 code")] == [f["name"] for f in golden["findings"]]
    assert screen.driver.switch_to.active_element.get_attribute("id") == "result"  # said to who cannot see it
    links = {a.text: a.get_attribute("href") for a in screen.all("a.button")}
    assert set(links) == {"report.html", "effects.yaml", "diagnosis.json"}
    (job,) = (path.name for path in screen.folder.iterdir())
    (command,) = (c.text for c in screen.all(".command code"))
    assert command.startswith("nsde diagnose system=mass_spring_damper data=log data.path=")
    assert job in command
    screen.until("details:last-of-type summary")
    screen.driver.execute_script("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    frame = screen.until("iframe")
    screen.driver.execute_script("arguments[0].scrollIntoView()", frame)
    screen.driver.switch_to.frame(frame)
    screen.until("p", lambda p: p.text == "as found")
    screen.until("#charts .js-line")  # the one script that a report may run
    screen.until("#charts canvas")
    screen.driver.switch_to.default_content()
    wrong = [e for e in screen.driver.get_log("browser") if "residual.png" not in e["message"]]
    assert not [e for e in wrong if e["level"] == "SEVERE"], wrong  # nothing against its own policy
    asked = screen.driver.execute_script("return performance.getEntriesByType('resource').map((e) => e.name)")
    assert len(asked) > 5
    assert all(name.startswith(screen.address.partition("#")[0]) for name in asked)  # nothing of elsewhere
    screen.driver.refresh()  # the key is known still, and the job
    screen.until(".verdict")


@pytest.mark.slow
def test_a_sample_log_is_diagnosed_and_two_diagnoses_are_compared(screen: Screen, played: Played) -> None:
    played.go.set()
    for _ in range(2):
        assert screen.until("#empty").is_displayed() == (not screen.all("#result"))
        screen.driver.execute_script("document.getElementById('sample').click()")
        screen.until("#start").click()
        screen.until(".verdict")
        screen.until("#kept li[aria-current]")
    logs = sorted(screen.folder.glob("*/logs/*.csv"))
    assert len(logs) == 8
    # all checks of columns, units and times
    runs = nsde_torch.read(logs[0].parent, system="mass_spring_damper")
    assert (len(runs.runs), runs.dt) == (4, 0.01)
    screen.press("Compare")
    head, first, *_ = screen.until("#comparison").text.splitlines()[1:]
    assert head.count("sample_0.csv") == 2 or "sample_0.csv" in first
    rows = [row.text for row in screen.all("#comparison tbody tr")]
    golden = json.loads((Path(__file__).parents[1] / "golden" / "diagnosis.json").read_text())
    for name in golden["parameters"]:
        effect, _, parameter = name.partition(".")
        (row,) = [row for row in rows if row.startswith(f"{effect}: {parameter} ")] or [""]
        assert row or effect not in {f["name"] for f in golden["findings"]}


def test_what_is_refused_is_said_and_nothing_runs(screen: Screen, played: Played) -> None:
    for files, said in (
        ({"flights.zip": "PK"}, "unpack it"),
        ({"a.csv": "x" * 270000}, "at most 0.25 MiB"),
        ({f"{HOSTILE}.svg": "x"}, HOSTILE),
        ({"a.csv": ""}, "is empty"),
        ({"a.csv": "x", "b.ulg": "y"}, "different formats"),
    ):
        screen.drop(files)
        screen.says(said)
    assert not played.words
    assert screen.driver.title == "Diagnose a log"
    assert not list(screen.folder.iterdir())


def test_names_and_sentences_of_a_log_are_text(screen: Screen, played: Played) -> None:
    bad = [{"name": HOSTILE, "passed": False, "text": HOSTILE}]
    row = {"stream": HOSTILE, "column": "q", "unit": HOSTILE, "rows": 2, "rate": None}
    row |= {"low": 0, "high": 1, "missing": 0, "gaps": 0}
    played.inspection |= {"usable": False, "checks": bad, "columns": [row]}
    played.inspection |= {"notes": [HOSTILE], "runs": [HOSTILE]}
    screen.drop({f"{HOSTILE}.csv": "t\n"})
    screen.until("#job .message", lambda box: HOSTILE in box.text)
    assert not screen.all("img")
    assert screen.driver.title != "1"


def test_a_diagnosis_is_stopped_and_begun_again(screen: Screen, played: Played) -> None:
    screen.drop(CSV)
    screen.until("#start").click()
    screen.until(".stages .now")
    screen.press("Stop")
    screen.until("#job .message", lambda box: box.text == "It was stopped.")
    screen.press("Diagnose again")
    screen.until(".verdict")


def test_a_mapping_is_corrected(screen: Screen, played: Played) -> None:
    wrong = [{"name": "q", "passed": False, "text": "q_dot has the opposite sign."}]
    proposed = "columns:\n  q: {from: a}\n"
    played.inspection |= {"usable": False, "native": False, "checks": wrong, "mapping": proposed}
    screen.drop(CSV)
    field = screen.until("textarea")
    assert field.is_displayed()  # it is opened where it has to be corrected
    played.inspection = {**INSPECTION, "native": False, "mapping": "x"}
    screen.driver.execute_script("arguments[0].value = 'columns: mine'", field)
    screen.press("Check this mapping")
    screen.until("#start")
    assert next(screen.folder.glob("*/mapping.yaml")).read_text() == "columns: mine"


def test_without_its_key_the_page_says_where_it_is(screen: Screen) -> None:
    screen.driver.execute_script("sessionStorage.clear()")
    screen.driver.get(screen.address.partition("#")[0])
    screen.driver.refresh()
    screen.says("Open the address that `nsde serve` printed")


@pytest.mark.parametrize("width", [1200, 500])
def test_everything_has_a_name_and_fits_the_window(screen: Screen, played: Played, width: int) -> None:
    screen.driver.set_window_size(width, 900)
    screen.drop(CSV)
    screen.until("#start").click()
    played.go.set()
    screen.until(".verdict")
    for one in screen.all("button, select, input, textarea, a, progress, iframe, [role=region]"):
        assert one.accessible_name or not one.is_displayed(), one.get_attribute("outerHTML")
    assert not screen.driver.execute_script(BEYOND)
