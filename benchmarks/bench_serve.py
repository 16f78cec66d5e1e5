"""How long from the drop of three minutes of flight on the page of `nsde serve` to the report, in a real browser?

Simulates three flights of a minute of the hexacopter (rotor drag and motor lag that nobody declared), starts
`nsde serve`, drops them in a headless Chromium, presses Diagnose, and waits for the verdict. Prints the times, the
computing time of all processes of the page, and what was found; `--pictures` writes what the page looked like.

    python benchmarks/bench_serve.py [--pictures docs/content/pictures]

Needs the extra `serve`, selenium, and Debian's chromium and chromium-driver.
"""

import os
import resource
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from common import nsde, options

from tests.helpers.browser import chromium

_LONGEST = 1200.0  # seconds
_WIDTH, _HEIGHT = 1100, 1000


def wait(driver: Any, css: str, started: float) -> tuple[Any, float]:
    """The first element that matches, and the seconds since `started`."""
    from selenium.webdriver.common.by import By

    while time.monotonic() - started < _LONGEST:
        found = driver.find_elements(By.CSS_SELECTOR, css)
        if found:
            return found[0], time.monotonic() - started
        time.sleep(0.1)
    raise SystemExit(f"no {css} after {_LONGEST:g} s")


def picture(driver: Any, folder: Path | None, name: str, css: str = "body") -> None:
    """Save what the window shows, from the top of an element on."""
    if folder is not None:
        driver.execute_script("document.querySelector(arguments[0]).scrollIntoView()", css)
        time.sleep(1.0)
        driver.save_screenshot(str(folder / name))


def use(driver: Any, address: str, flights: list[Path], pictures: Path | None) -> None:
    """What a person does on the page, timed."""
    driver.get(address)
    wait(driver, "#kept li", time.monotonic())
    started = time.monotonic()
    driver.find_element("id", "files").send_keys("\n".join(map(str, flights)))
    button, looked = wait(driver, "#start", started)
    picture(driver, pictures, "serve_inspection.png")
    pressed = time.monotonic()
    button.click()
    verdict, seconds = wait(driver, ".verdict", pressed)
    print(f"what is in the logs: {looked:.1f} s after the drop")
    print(f"the report: {looked + seconds:.1f} s after the drop (Diagnose pressed at once)")
    print(f"{' '.join(verdict.text.split())}")
    driver.set_window_size(_WIDTH, 1500)
    picture(driver, pictures, "serve_result.png", "#job")


def main() -> None:
    parser = options(__doc__, seed=5)
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the page")
    given = parser.parse_args()
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made = ["simulate", "system=hexacopter", f"out={folder / 'flights'}", f"seed={given.seed}"]
        subprocess.run(nsde(*made, "durations=[60,60,60]"), check=True, env=env)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        serving = [*nsde("serve", "port=0", "system=hexacopter"), f"out_dir={folder / 'served'}"]
        server = subprocess.Popen(serving, stdout=subprocess.PIPE, text=True, env=env)
        assert server.stdout is not None
        try:
            address = server.stdout.readline().strip()
            with chromium(folder / "profile", width=_WIDTH, height=_HEIGHT) as driver:
                use(driver, address, sorted((folder / "flights").glob("*.csv")), given.pictures)
        finally:
            server.terminate()
            server.wait()
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        computing = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        print(f"computing time of the page, its jobs and the browser: {computing:.0f} s")


if __name__ == "__main__":
    main()
