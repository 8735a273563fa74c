"""Draw the pictures of the page: ``docs/viewer.png``, and ``docs/viewer.webp``, which moves.

A demo is started and looked at in Chromium while its page presses by itself: ``make pictures``, on
a computer that is not busy, for the pictures show how fast it is.
"""

from __future__ import annotations

import io
import itertools
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

DOCS = Path(__file__).parents[2] / "docs"
SIZE = (1280, 800)
MOVING_SIZE = (832, 520)
MOVING_S = 19.0
CHROMIUM = ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars")
PRESSED_S = "return tactomo.idle.isOn ? (performance.now() - tactomo.idle.since) / 1000 : 0"


def main() -> None:
    """Write both pictures."""
    with demo() as url, page(url) as browser:
        while browser.execute_script(PRESSED_S) == 0:
            time.sleep(0.05)
        seen = list(look(browser))
    still = min(seen, key=lambda each: abs(each[0] - 12.6))[1]  # two that rest
    still.save(DOCS / "viewer.png", optimize=True)
    pictures = [picture.resize(MOVING_SIZE, Image.Resampling.LANCZOS) for _, picture in seen]
    times_s = [at_s for at_s, _ in seen]
    lasts_ms = [round(1e3 * (b - a)) for a, b in itertools.pairwise(times_s)]
    pictures[0].save(
        DOCS / "viewer.webp",
        save_all=True,
        append_images=pictures[1:],
        duration=[*lasts_ms, 1000],
        loop=0,
        quality=55,
        method=6,
    )


def look(browser: webdriver.Chrome) -> Iterator[tuple[float, Image.Image]]:
    """Yield what is seen while it presses, and when, seconds since that began."""
    at_s = 0.0
    while at_s < MOVING_S:
        at_s = float(browser.execute_script(PRESSED_S))
        shot = Image.open(io.BytesIO(browser.get_screenshot_as_png()))
        yield at_s, shot.convert("RGB")
        time.sleep(0.12)


@contextmanager
def demo() -> Iterator[str]:
    """A demo on addresses of its own; yields its page's address."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            *(sys.executable, "-m", "tactomo.cli", "demo", "--no-browser", "--viewer-port", "0"),
            *("--stream", f"ipc://{folder}/stream", "--control", f"ipc://{folder}/control"),
            *("--twin-control", f"ipc://{folder}/twin"),
        ]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder) as process:
            assert process.stdout is not None
            words = (word for line in process.stdout for word in line.split())
            try:
                yield next(word for word in words if word.startswith("http://"))
            finally:
                process.terminate()
                process.communicate()


@contextmanager
def page(url: str) -> Iterator[webdriver.Chrome]:
    """The page, dark, in a browser."""
    options = webdriver.ChromeOptions()
    for option in CHROMIUM:
        options.add_argument(option)
    browser = webdriver.Chrome(options, Service(shutil.which("chromedriver")))
    try:
        width, height = SIZE
        metrics = {"deviceScaleFactor": 1, "mobile": False, "width": width, "height": height}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        dark = [{"name": "prefers-color-scheme", "value": "dark"}]
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": dark})
        browser.get(url)
        yield browser
    finally:
        browser.quit()


if __name__ == "__main__":
    main()
