"""The page in a real browser: what it draws, what a press becomes, what it says when things stop.

The skin is a thread that publishes ten frames a second on a real socket, the twin a control
socket that notes what it is asked; between them and the browser is the viewer, in a thread.
"""

from __future__ import annotations

import asyncio
import io
import itertools
import json
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import matplotlib as mpl
import numpy as np
import pytest
from aiohttp import web
from fake_control import FakeControl
from PIL import Image as Picture
from selenium import webdriver
from selenium.webdriver import Keys
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement
from tactomo_client import Contact, ControlError
from tactomo_client.fake import FakeSensor
from tactomo_models.arrays import Image
from tactomo_viewer.server import Viewer
from waiting import wait_until

pytestmark = pytest.mark.browser

NODES_MM = np.linspace(-75, 75, 51)
DESCRIPTION: dict[str, Any] = {
    "model": "paper_square",
    "shape": "rectangle",
    "width_mm": 150.0,
    "height_mm": 150.0,
    "sensing_width_mm": 138.0,
    "sensing_height_mm": 138.0,
    "electrodes_mm": [[-54.0, -75.0], [75.0, -54.0]],
    "magnitude_max": 0.45,
    "pressure_max_kpa": 300.0,
}


def blob(x_mm: float, y_mm: float, value: float, nodes_mm: Any = NODES_MM) -> Image:
    """Return an image that is `value` within 12 mm of a place and 0 elsewhere."""
    x, y = np.meshgrid(nodes_mm, nodes_mm)
    return np.where(np.hypot(x - x_mm, y - y_mm) < 12, value, 0).astype(np.float32)


class Skin:
    """A sensor that goes on publishing what its attributes say."""

    def __init__(self, address: str) -> None:
        self.contacts: list[Contact] = []
        self.frame: dict[str, Any] = {}
        self.status: dict[str, Any] = {
            "state": "running",
            "description": DESCRIPTION,
            "source": {"kind": "twin"},
            "ports": [{"url": "/dev/ttySKIN", "connected": True, "bytes": 1}],
        }
        self.events: list[dict[str, Any]] = []
        self.sends_frames = True
        self.period_s = 0.1
        self._stop = threading.Event()
        self._sensor = FakeSensor("left", address)
        self.address = self._sensor.address
        self._thread = threading.Thread(target=self._run, name="skin")

    def press(self, x_mm: float, y_mm: float, kpa: float = 200, magnitude: float = 0.25) -> None:
        """Show one contact, as the daemon would."""
        self.contacts = [Contact(1, x_mm, y_mm, 452.0, magnitude, 0.01, kpa)]
        self.frame = {
            "map": blob(x_mm, y_mm, magnitude),
            "pressure_kpa": blob(x_mm, y_mm, kpa),
            "structure": blob(x_mm, y_mm, 1),
        }

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._sensor.close()

    def _run(self) -> None:
        tick, told = 0, dict[str, Any]()
        while not self._stop.wait(self.period_s):
            if tick % 3 == 0 or told != self.status:
                told = dict(self.status)
                self._sensor.publish_message("status", told)
            while self.events:
                self._sensor.publish_message("event", self.events.pop(0))
            if self.sends_frames:
                self._sensor.publish(self.contacts, **self.frame)
            tick += 1


class ServedViewer:
    """A viewer on a port of this computer, in a thread."""

    def __init__(self, viewer: Viewer, port: int) -> None:
        self._loop = asyncio.new_event_loop()
        self._runner = web.AppRunner(viewer.app(), access_log=None, shutdown_timeout=1.0)
        self._loop.run_until_complete(self._runner.setup())
        self._loop.run_until_complete(web.TCPSite(self._runner, "127.0.0.1", port).start())
        self.port: int = self._runner.addresses[0][1]
        self._thread = threading.Thread(target=self._loop.run_forever, name="viewer")
        self._thread.start()

    def hang(self) -> threading.Event:
        """Do nothing until the event is set."""
        goes_on = threading.Event()
        self._loop.call_soon_threadsafe(goes_on.wait)
        return goes_on

    def stop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.run_until_complete(self._runner.cleanup())
        self._loop.close()


class Page:
    """The open page, and the viewer behind it."""

    def __init__(
        self, browser: webdriver.Chrome, skin: Skin, daemon: FakeControl, twin: FakeControl
    ) -> None:
        self.browser = browser
        self.skin = skin
        self.daemon = daemon
        self.twin = twin
        self.port = 0

    def serve(self, press_itself: bool = False) -> None:
        """Start the viewer; a second time at the same port."""
        viewer = Viewer(
            "left",
            self.skin.address,
            self.daemon.address,
            self.twin.address,
            press_itself=press_itself,
        )
        self.served = ServedViewer(viewer, self.port)
        self.port = self.served.port

    def stop_viewer(self) -> None:
        self.served.stop()

    def open(self, **emulated: Any) -> None:
        """Open the page and wait until it shows the skin; `emulated`: width, height, mobile."""
        if emulated:
            metrics = {"deviceScaleFactor": 1, "mobile": False, **emulated}
            self.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        self.browser.get(f"http://127.0.0.1:{self.port}/")
        wait_until(lambda: self.health == "good")
        wait_until(lambda: self.js("return Boolean(tactomo.state.drawn)"))

    @property
    def health(self) -> str:
        """Name of the banner, `good` when there is none."""
        return str(self.js("return document.body.dataset.health"))

    @property
    def banner(self) -> str:
        return self["banner"].text

    def __getitem__(self, element: str) -> WebElement:
        return self.browser.find_element(By.ID, element)

    @property
    def row(self) -> list[str]:
        """Words of the first contact's row, by the page itself, which may replace it meanwhile."""
        script = "return document.querySelector('#contacts tbody tr')?.innerText ?? ''"
        return str(self.js(script)).split()

    @property
    def map_classes(self) -> set[str]:
        return set((self["map"].get_attribute("class") or "").split())

    def js(self, script: str, *arguments: Any) -> Any:
        return self.browser.execute_script(script, *arguments)

    def module(self, expression: str, file: str) -> Any:
        """Evaluate an expression with `m`, one of the page's modules."""
        return self.browser.execute_async_script(
            f"const done = arguments[0]; import('/{file}').then((m) => done({expression}))"
        )

    def colour(self, x_mm: float, y_mm: float) -> list[int]:
        """Return red, green and blue on the canvas at a place on the skin."""
        script = """
            const canvas = document.getElementById('map');
            const [x, y] = tactomo.mmToPixel(arguments[0], arguments[1]);
            const ratio = canvas.width / canvas.clientWidth;
            const context = canvas.getContext('2d');
            return [...context.getImageData(x * ratio, y * ratio, 1, 1).data].slice(0, 3)"""
        return [int(level) for level in self.js(script, x_mm, y_mm)]

    def client_point(self, x_mm: float, y_mm: float) -> tuple[float, float]:
        """Return where a place on the skin is in the browser's window."""
        script = """
            const box = document.getElementById('map').getBoundingClientRect();
            const [x, y] = tactomo.mmToPixel(arguments[0], arguments[1]);
            return [box.left + x, box.top + y]"""
        x, y = self.js(script, x_mm, y_mm)
        return x, y

    def mouse(self, kind: str, x_mm: float, y_mm: float, modifiers: int = 0) -> None:
        """Send a mouse event (Pressed, Moved with the button down, or Released) at a place."""
        x, y = self.client_point(x_mm, y_mm)
        button = {"button": "left", "buttons": int(kind != "Released"), "clickCount": 1}
        event = {"type": f"mouse{kind}", "x": round(x), "y": round(y), "modifiers": modifiers}
        self.browser.execute_cdp_cmd("Input.dispatchMouseEvent", event | button)

    def click(self, x_mm: float, y_mm: float, modifiers: int = 0) -> None:
        self.mouse("Pressed", x_mm, y_mm, modifiers)
        self.mouse("Released", x_mm, y_mm, modifiers)

    def wait_until_pressable(self) -> None:
        wait_until(lambda: "pressable" in self.map_classes)

    def presses(self, command: str = "press") -> list[dict[str, Any]]:
        """Return the arguments of the presses (or releases) that reached the twin."""
        return [arguments for name, arguments in self.twin.requests if name == command]


@pytest.fixture
def page(browser: webdriver.Chrome, tmp_path: Path) -> Iterator[Page]:
    # Skins come back at their address: a port may be another program's meanwhile.
    with Skin(f"ipc://{tmp_path}/skin") as skin, FakeControl() as daemon, FakeControl() as twin:
        page = Page(browser, skin, daemon, twin)
        page.serve()
        yield page
        browser.get("about:blank")
        page.stop_viewer()


@pytest.fixture
def quiet_console(page: Page) -> Iterator[None]:
    """Check that the page wrote nothing to the console."""
    yield
    written = page.browser.get_log("browser")  # type: ignore[no-untyped-call]
    ours = [entry for entry in written if entry["source"] != "rendering"]  # advice about canvases
    assert ours == []


RADIOS, CHECKS = ("unit", "scale"), ("smooth", "outline")


# What it draws


def is_bright(page: Page, x_mm: float, y_mm: float) -> bool:
    return sum(page.colour(x_mm, y_mm)) > 350


def test_what_somebody_chose_to_see_is_there_when_the_page_is_opened_anew(page: Page) -> None:
    def shown() -> list[Any]:
        chosen = [
            page.js(f"return document.querySelector('[name={n}]:checked').value") for n in RADIOS
        ]
        checked = [
            page.js(f"return tactomo && document.getElementById('{n}').checked") for n in CHECKS
        ]
        return [*chosen, page["colormap"].get_attribute("value"), *checked]

    page.skin.press(36, -48, kpa=200)
    page.open()
    assert shown() == ["kpa", "sensor", "inferno", True, True]
    for selector in ("[name=unit][value=percent]", "[name=scale][value=fit]", "#smooth"):
        page.js(f"document.querySelector('{selector}').click()")
    page["colormap"].send_keys("v")
    wait_until(lambda: shown() == ["percent", "fit", "viridis", False, True])
    page.open()
    assert shown() == ["percent", "fit", "viridis", False, True]
    page.js("localStorage.setItem('scale', 'none'); localStorage.setItem('colormap', 'none')")
    page.open()
    assert shown() == ["percent", "sensor", "inferno", False, True]


@pytest.mark.usefixtures("quiet_console")
def test_a_press_is_drawn_where_it_is(page: Page) -> None:
    page.skin.press(36, -48, kpa=200)
    page.open()
    for _ in ("smooth", "node by node"):
        wait_until(partial(is_bright, page, 30, -48))
        for x_mm, y_mm in ((-36, -48), (36, 48), (-36, 48), (0, 0), (36, -26), (58, -48)):
            assert sum(page.colour(x_mm, y_mm)) < 60, (x_mm, y_mm)
        page["smooth"].click()
    described = sum(page.colour(30, -48))
    calibrated = DESCRIPTION | {"pressure_max_kpa": 800.0}  # which is put in force
    page.skin.status |= {"description": calibrated}
    wait_until(lambda: 60 < sum(page.colour(30, -48)) < described - 60)
    assert page["pressure"].get_attribute("max") == "800"
    page.skin.status |= {"description": DESCRIPTION}
    wait_until(lambda: sum(page.colour(30, -48)) == described)
    page.skin.frame |= {"map": None, "pressure_kpa": None}
    wait_until(lambda: page.colour(30, -48)[1] > 120)  # the structure is drawn instead of a map
    white = [r for r in np.arange(4, 20, 0.2) if min(page.colour(36 - r, -48)) > 200]
    assert white
    assert 9 <= min(white) <= max(white) <= 13
    page["outline"].click()
    wait_until(lambda: not any(min(page.colour(36 - r, -48)) > 200 for r in white))
    page.skin.contacts = []
    page["smooth"].click()
    for ix, iy in ((47, 5), (3, 45)):  # each node is the middle of its pixel
        image = np.zeros((51, 51), np.float32)
        image[iy, ix] = 300
        page.skin.frame = {"pressure_kpa": image}
        x, y = NODES_MM[ix], NODES_MM[iy]
        # A smoothed pixel fades towards its corners: they are bright once the click is drawn.
        for corner in itertools.product((x - 1.2, x + 1.2), (y - 1.2, y + 1.2)):
            wait_until(partial(is_bright, page, *corner))
        for dx, dy in ((1.8, 0), (-1.8, 0), (0, 1.8), (0, -1.8)):
            assert sum(page.colour(x + dx, y + dy)) < 60, (dx, dy)


def around(radius_m: float) -> dict[str, Any]:
    """A mount around a cylinder, as a status has it."""
    angles = np.linspace(-0.075, 0.075, 25) / radius_m
    rows = [
        [[radius_m * np.cos(a), radius_m * np.sin(a), y] for a in angles.tolist()]
        for y in np.linspace(-0.075, 0.075, 25).tolist()
    ]
    return {"frame": "left_forearm_link", "kind": "cylinder", "surface_m": rows}


NUMBER_AT = """
    const { labels: [[, number]], body, camera } = tactomo.surface;
    const { x, y } = number.position.clone().applyMatrix4(body.matrixWorld).project(camera);
    return Math.max(Math.abs(x), Math.abs(y))"""
SEEN = "return tactomo.surface.mmToPixel(arguments[0], arguments[1])"


@pytest.mark.slow
def test_a_mounted_sheet_is_pressed_and_turned_on_its_surface(page: Page) -> None:
    page.skin.status = page.skin.status | {"description": {**DESCRIPTION, "mount": around(0.04)}}
    page.skin.press(-15, 20)
    page.skin.contacts = [
        replace(
            page.skin.contacts[0],
            position_m=(0.037, -0.0146, 0.02),
            normal=(0.93, -0.366, 0.0),
            frame="left_forearm_link",
            force_n=100.0,
        )
    ]
    page.open()
    page.skin.period_s = 0.3  # a processor draws a surface, which takes a tenth of a second
    wait_until(lambda: page.js("return Boolean(tactomo.surface?.mesh)"))
    page.wait_until_pressable()
    assert "left_forearm_link" in page["surface-help"].text

    def bright() -> bool:
        x, y = page.js(SEEN, -20, 24)
        picture = Picture.open(io.BytesIO(page["surface"].screenshot_as_png)).convert("RGB")
        return sum(picture.getpixel((round(x), round(y)))) > 250  # type: ignore[arg-type]

    wait_until(bright)

    def mouse(kind: str, x: float, y: float) -> None:
        box = page.js("return document.getElementById('surface').getBoundingClientRect()")
        button = {"button": "left", "buttons": int(kind != "Released"), "clickCount": 1}
        at = {"x": round(box["left"] + x), "y": round(box["top"] + y)}
        page.browser.execute_cdp_cmd(
            "Input.dispatchMouseEvent", {"type": f"mouse{kind}"} | at | button
        )

    x, y = page.js(SEEN, 10, -30)
    mouse("Pressed", x, y)
    wait_until(lambda: bool(page.presses()))
    press = page.presses()[-1]
    assert (press["x_mm"], press["y_mm"]) == pytest.approx((10, -30), abs=1)
    mouse("Released", x, y)
    wait_until(lambda: bool(page.presses("release")))
    pressed = len(page.presses())
    left = page.js(SEEN, -40, -30)[0]
    mouse("Pressed", 5, 5)  # beside the sheet
    mouse("Moved", 105, 5)
    mouse("Released", 105, 5)
    wait_until(lambda: page.js(SEEN, -40, -30)[0] > left + 10)
    assert len(page.presses()) == pressed
    left = page.js(SEEN, -40, -30)[0]
    page["surface"].send_keys(Keys.ARROW_LEFT)
    wait_until(lambda: page.js(SEEN, -40, -30)[0] < left - 2)
    page.js("tactomo.surface.distance = 2.2")  # as by the wheel: the arrow leaves the picture
    for _ in range(8):  # the number of the contact is never cut off
        page["surface"].send_keys(Keys.ARROW_RIGHT)
        wait_until(lambda: page.js(NUMBER_AT) < 0.95)
    page.skin.status = page.skin.status | {"description": DESCRIPTION}
    wait_until(lambda: not page["surface"].is_displayed())


def test_outlines_colours_and_verdicts_are_computed_right(page: Page) -> None:
    page.open()
    segments = page.module(
        "m.contour(m.upsample({nx: 21, ny: 31, values: Float32Array.from({length: 651}, (_, i) =>"
        " 8 - Math.hypot(i % 21 - 10, Math.floor(i / 21) - 12))}, 4), 0)",
        "grid.js",
    )
    points = np.array(segments).reshape(-1, 2) / 4 - (10, 12)
    assert len(points) > 100
    np.testing.assert_allclose(np.hypot(*points.T), 8, atol=0.1)
    # It is closed: each end of a segment is the end of one other segment.
    _, ends = np.unique(points.round(6), axis=0, return_counts=True)
    assert set(ends) == {2}
    for name in ("inferno", "viridis"):
        table = page.module(f"[...m.colourTable('{name}')]", "colormap.js")
        expected = 255 * mpl.colormaps[name](np.arange(256))[:, :3]
        np.testing.assert_allclose(np.reshape(table, (256, 3)), expected, atol=9)
    # A replay that goes on is not stale before its next frame.
    assert page.module(VERDICTS, "health.js") == [None, "stale"]
    # What waited in the page is late by no failure of the skin's.
    assert page.module(WAITED, "health.js") == [
        *(["error", False], ["warning", True], ["error", False])
    ]
    # A page whose first frame has not come yet only waits: red is for failures.
    verdicts = [None, ["no-frame", "info"], ["no-frame", "error"]]
    assert page.module(FIRST_FRAME, "health.js") == verdicts
    # A move is over with its own frame, whether that comes before the reply or after it.
    is_before = page.browser.execute_async_script("""
        const done = arguments[0];
        import('/replay.js').then(async ({ Replay }) => {
          const replay = new Replay(async (name, change, tell) => tell({ maps_before: 5 }));
          replay.fields = { paused: true, maps_before: 2 };
          document.getElementById('position').dispatchEvent(new Event('input'));
          const isAsked = replay.isBefore({ sequence: 6 });
          await new Promise((soon) => setTimeout(soon));
          done([isAsked, replay.isBefore({ sequence: 5 }), replay.isBefore({ sequence: 6 })]);
        })""")
    assert is_before == [True, True, False]
    for scheme in ("light", "dark"):
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        page.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        ratio = {
            (ink, paper): page.js(CONTRAST, ink, paper)
            for ink, paper in (
                *((ink, paper) for ink in ("--text", "--dim") for paper in ("--page", "--card")),
                *((f"--{kind}", f"--{kind}-tint") for kind in ("good", "warn", "bad")),
                ("--accent", "--info-tint"),
                ("--on-accent", "--accent"),
            )
        }
        assert {pair: value for pair, value in ratio.items() if value < 4.5} == {}  # WCAG AA


VERDICTS = """
    [100, 2000].map((ms) => m.verdict({
      link: { isOpen: true },
      hello: { status_stale_ms: 5000, frame_stale_ms: 500 },
      status: {
        age_ms: 0, receivedAt: 1e6, fields: { state: 'running', replay: { paused: false } },
      },
      frame: { age_ms: 26_000, receivedAt: 1e6 },
      stoodAt: 1e6 - ms,
    }, 1e6)?.name)"""


WAITED = """
    [[800, 10], [800, 800], [9000, 800]].map(([ms, waitedMs]) => m.verdict({
      link: { isOpen: true },
      hello: { status_stale_ms: 5000, frame_stale_ms: 500 },
      status: { age_ms: 0, receivedAt: 1e6, fields: { state: 'running' } },
      frame: { age_ms: 20, receivedAt: 1e6 - ms, waitedMs },
      stoodAt: -Infinity,
    }, 1e6)).map(({ level, detail }) => [level, detail.includes("too slowly")])"""


FIRST_FRAME = """
    [100, 2000, 20_000].map((ms) => m.verdict({
      link: { isOpen: true },
      hello: { status_stale_ms: 5000, frame_stale_ms: 500 },
      status: { age_ms: 0, receivedAt: 1e6, fields: { state: 'running' } },
      frame: null,
      openedAt: 1e6 - ms,
      stoodAt: -Infinity,
    }, 1e6)).map((found) => found && [found.name, found.level])"""


CONTRAST = """
const style = getComputedStyle(document.documentElement);
const luminance = (name) => {
  const hex = style.getPropertyValue(name).trim().slice(1);
  const [r, g, b] = [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255)
    .map((c) => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const [a, b] = [luminance(arguments[0]), luminance(arguments[1])];
return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
"""


@pytest.mark.usefixtures("quiet_console")
def test_contacts_are_listed_marked_and_read_out(page: Page) -> None:
    page.skin.press(-50, 0)
    page.open()
    wait_until(lambda: page.js("return tactomo.state.drawn?.contacts.length"))
    point_at(page, 30, 30)
    wait_until(lambda: page["readout"].text.endswith(": 0 kPa"))
    page.skin.press(30, 30)  # under a pointer that rests
    wait_until(lambda: page["readout"].text.endswith(": 200 kPa"))

    page.skin.press(36, -48, kpa=173.0, magnitude=0.151)
    (contact,) = page.skin.contacts
    known = replace(contact, pressure_sigma_kpa=2.7, force_n=78.2, force_sigma_n=3.4)
    page.skin.contacts = [known]
    rows = "return [...document.querySelectorAll('#contacts tbody tr')].map(r => ({...r.dataset}))"
    wait_until(lambda: page.js(rows) == [{"id": "1", "xMm": "36", "yMm": "-48"}])

    def is_marked() -> bool:  # in the colour of contact 1
        return any(
            np.allclose(page.colour(36 + r_mm, -48), (86, 180, 233), atol=8)
            for r_mm in np.arange(12, 20, 0.2)
        )

    assert not is_marked()
    page["contacts"].find_element(By.TAG_NAME, "button").send_keys("")
    wait_until(is_marked)
    page.js("document.activeElement.blur()")
    wait_until(lambda: not is_marked())

    # Nothing is listed for a moment where a busy computer lets a frame grow old.
    wait_until(lambda: page.row == ["1", "36.0", "−48.0", "452", "173", "±", "3", "78", "±", "3"])
    page.browser.find_element(By.CSS_SELECTOR, "input[value=percent]").click()
    wait_until(lambda: page.row[4:] == ["15.1", "±", "1.0", "78", "±", "3"])
    page.browser.find_element(By.CSS_SELECTOR, "input[value=kpa]").click()
    page.skin.contacts = [replace(known, pressure_range="above")]
    wait_until(lambda: page.row[4:] == ["≥", "173", "≥", "78"])
    # Touched too lightly for a number: shown where it is, as where there is no map at all.
    light = replace(contact, pressure_kpa=None, pressure_range="below")
    page.skin.contacts = [light]
    page.skin.frame |= {"pressure_kpa": np.where(blob(36, -48, 1.0) > 0, np.nan, np.float32(0))}
    wait_until(lambda: page["contacts"].text.split()[-2:] == ["touched", "–"])
    wait_until(lambda: page.colour(30, -48)[1] > 120)
    assert sum(page.colour(-36, 48)) < 60
    page.skin.contacts = [replace(light, max_kpa=90.4)]
    wait_until(lambda: page["contacts"].text.split()[-3:] == ["≤", "90", "–"])
    page.skin.contacts = [Contact(1, 0, 0, 452.0, None, None, None)]
    page.skin.frame |= {"map": None, "pressure_kpa": None, "flags": ["magnitude_missing"]}
    wait_until(lambda: page["quality"].text == "magnitude missing")
    wait_until(lambda: page.row[-1:] == ["–"])
    page.skin.contacts, page.skin.frame = [], {}
    wait_until(lambda: page["no-contacts"].text == "Nothing pressed." and page.js(rows) == [])


def reads(page: Page, element: str, text: str) -> bool:
    return page[element].text == text


def point_at(page: Page, x_mm: float, y_mm: float) -> None:
    """Rest the mouse on a place of the skin."""
    x, y = page.js("return tactomo.mmToPixel(arguments[0], arguments[1])", x_mm, y_mm)
    canvas = page["map"]
    width, height = canvas.size["width"], canvas.size["height"]
    actions = webdriver.ActionChains(page.browser)
    actions.move_to_element_with_offset(canvas, round(x - width / 2), round(y - height / 2))
    actions.perform()


def dots(page: Page) -> list[str]:
    """Return how each channel and port is."""
    kinds = "return [...document.querySelectorAll('#channels .dot')].map(d => d.dataset.kind)"
    return list(page.js(kinds))


def test_frames_and_status_are_shown_part_by_part(page: Page) -> None:
    page.skin.frame = {"tier_reason": "two contacts", "flags": ["misfit_high"], "misfit": 3.21}
    page.open()
    wait_until(lambda: page["quality"].text == "misfit high")
    wait_until(lambda: page["rate"].text.endswith("/s"))
    wait_until(lambda: page["latency"].text.endswith("ms"))
    assert page["made-by"].text == "levelset"
    assert page["made-by-reason"].text == "two contacts"
    assert page["misfit"].text == "3.2 σ"
    height = "return document.getElementById('made-by').closest('.card').offsetHeight"
    heights = set()
    for reason in ("quiet", "no change above the noise"):
        page.skin.frame |= {"tier_reason": reason}
        wait_until(partial(reads, page, "made-by-reason", reason))
        heights.add(page.js(height))
    assert len(heights) == 1  # room is kept: nothing below jumps
    page.skin.press(0, 0)
    page.skin.frame |= {"tier": "tikhonov"}
    wait_until(lambda: "linear" in page["quality"].text)
    page.skin.frame |= {"tier": "fit"}
    wait_until(lambda: page["quality"].text == "good")
    page.skin.contacts = []
    for flags, told in (  # it is nothing that is pressed only where touches are seen
        (["electrode_fault"], "Nothing pressed."),
        (["electrode_fault", "no_usable_scan"], "Not known."),
        ([], "Nothing pressed."),
        (["no_reference"], "Not known."),
    ):
        page.skin.frame = {"flags": flags}
        wait_until(partial(reads, page, "no-contacts", told))
    assert page["quality"].text == "no reference"

    # What the daemon finds wrong is printed, and nothing else is judged.
    page.skin.status |= {"state": "late", "dropped_scans": 99, "recorder": {"failure": "no room"}}
    wait_until(lambda: page["state"].text == "late")
    assert not page["banner"].is_displayed()
    issue = {"severity": "error", "what": "frames come late", "next_step": "be quick"}
    noted = {"severity": "warning", "what": "it hums", "next_step": "`oil it`"}
    page.skin.status |= {"issues": [issue, noted]}
    wait_until(lambda: page["banner"].text == "frames come late: be quick")
    assert page["channels"].text.split("\n")[:4] == [
        *("frames come late", "be quick", "it hums", "oil it")
    ]
    assert page.map_classes == {"pressable"}
    page.skin.status |= {"issues": []}
    wait_until(lambda: not page["banner"].is_displayed())

    nasty = "<img src=x onerror=document.title='broken'>"
    page.skin.status |= {
        "stage_ms": {"level_set": {"p50": 21.2, "p99": 44.0}},
        "rates": {"magnitude_hz": 0.0, "structure_hz": 19.96, "frames_hz": 20.0},
        "reference": {"scans": 20, "taken_realtime_ns": time.time_ns()},
        "recording": {"path": "/data/a.mcap", "bytes": 1_500_000},
        "description": DESCRIPTION | {"model": nasty},
        "companions": {
            "cell": {"state": "fitted", "reading": 255.5, "force_n": 127, "force_sigma_n": 2.5},
            "pad": {"state": "missing", "reading": None, "force_n": None, "force_sigma_n": None},
        },
    }
    wait_until(lambda: "21.2, 44.0 ms" in page["stages"].text)
    channels = page["channels"].text.split("\n")
    assert channels[:2] == ["magnitude", "no scans"]
    assert "20.0 scans/s" in channels
    assert "/dev/ttySKIN" in channels
    assert channels[channels.index("cell") + 1] == "reads 255.5: 127.0 ± 2.5 N, fitted"
    assert channels[channels.index("pad") + 1] == "no reading within its limits"
    assert page["reference"].text.startswith("Reference of 20 scans")
    assert page["record"].text == "Stop · 1.5 MB"
    assert page["source"].text == "simulated skin"
    page.skin.events = [{"name": nasty, "severity": "info", "detail": nasty, "next_step": ""}]
    wait_until(lambda: nasty in page["events"].text)
    wait_until(lambda: page["model"].text == nasty)
    assert page.browser.title == "left · tactomo"  # foreign text stays text


# What a press becomes


@pytest.mark.usefixtures("quiet_console")
def test_mouse_and_keyboard_press_where_they_point(page: Page) -> None:
    page.skin.press(12, 20, kpa=170)
    page.open()
    page.wait_until_pressable()
    assert page["error"].text == ""
    page.mouse("Pressed", 10, 20)  # what is pressed is compared with what is felt
    wait_until(lambda: re.fullmatch(r"error (1\.[89]|2\.[012]) mm, −10 kPa", page["error"].text))
    page.skin.contacts, page.skin.frame = [], {}
    wait_until(lambda: page["error"].text == "1 not felt")
    page.mouse("Released", 10, 20)
    wait_until(lambda: page["error"].text == "" and page.presses("release"))

    page.twin.requests.clear()
    page["shape"].find_element(By.XPATH, "./option[@value='ring']").click()
    page.click(0, 0, modifiers=8)
    radius_mm = page.js("return Number(document.getElementById('size').value)") / 2

    def is_drawn(r_mm: float) -> bool:  # dashed: somewhere around, a dash
        angles = np.linspace(0, 2 * np.pi, 40)
        return any(page.colour(r_mm * np.cos(a), r_mm * np.sin(a))[2] > 150 for a in angles)

    wait_until(lambda: is_drawn(radius_mm))  # a ring, with its hole
    assert is_drawn(radius_mm / 2)
    assert not is_drawn(0.75 * radius_mm)
    page["clear"].click()
    wait_until(lambda: ("clear", {}) in page.twin.requests)

    page.twin.requests.clear()
    page["shape"].find_element(By.XPATH, "./option[@value='ellipse']").click()
    page.js(
        "for (const [id, value] of [['pressure', 220], ['size', 20]]) {"
        " const e = document.getElementById(id); e.value = value; e.oninput(); }"
    )
    page.mouse("Pressed", 36, -48)
    wait_until(page.presses)
    first = page.presses()[0]
    half_pixel_mm = 0.5 / page.js("return tactomo.mmToPixel(1, 0)[0] - tactomo.mmToPixel(0, 0)[0]")
    assert first["x_mm"] == pytest.approx(36, abs=1.01 * half_pixel_mm)
    assert first["y_mm"] == pytest.approx(-48, abs=1.01 * half_pixel_mm)
    assert (first["pressure_kpa"], first["radius_mm"], first["shape"]) == (220, 10, "ellipse")
    page.mouse("Moved", -20, 10)
    wait_until(lambda: page.presses()[-1]["x_mm"] == pytest.approx(-20, abs=1))
    assert page.presses()[-1]["y_mm"] == pytest.approx(10, abs=1)
    assert page.presses("release") == []
    page.mouse("Released", -20, 10)
    wait_until(lambda: page.presses("release"))
    assert {press["id"] for press in page.presses()} == {page.presses("release")[0]["id"]}

    page.twin.requests.clear()
    moves = """
        const canvas = document.getElementById('map');
        const box = canvas.getBoundingClientRect();
        for (const [kind, mm] of arguments[0]) {
          const [x, y] = tactomo.mmToPixel(mm, 0);
          const place = {clientX: box.left + x, clientY: box.top + y, pointerId: 1, button: 0};
          canvas.dispatchEvent(new PointerEvent('pointer' + kind, place));
        }"""
    page.js(moves, [["down", 0], ["move", 10], ["move", 20], ["move", 30]])  # all at once
    wait_until(lambda: [round(press["x_mm"]) for press in page.presses()] == [0, 30])
    page.js(moves, [["up", 30]])
    wait_until(lambda: page.presses("release"))
    page.twin.requests.clear()
    page["map"].send_keys(Keys.SHIFT, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_UP, Keys.SHIFT)
    page["map"].send_keys(Keys.ARROW_LEFT, " ")
    wait_until(lambda: page.presses("release"))
    assert (page.presses()[0]["x_mm"], page.presses()[0]["y_mm"]) == (19, 10)


def test_fingers_press_where_they_are_on_a_scrolled_narrow_page(page: Page) -> None:
    page.open(width=390, height=500, mobile=True)
    page.js("scrollTo(0, 190)")
    wait_until(lambda: page.js("return scrollY") > 100)
    page.wait_until_pressable()
    page.click(20, -30)
    wait_until(lambda: page.presses("release"))
    assert page.presses()[0]["x_mm"] == pytest.approx(20, abs=0.5)
    assert page.presses()[0]["y_mm"] == pytest.approx(-30, abs=0.5)
    page.twin.requests.clear()
    page.browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})

    def touch(kind: str, *places: tuple[float, float]) -> None:
        corners = [page.client_point(*place) for place in places]
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(corners)]
        arguments = {"type": kind, "touchPoints": points}
        page.browser.execute_cdp_cmd("Input.dispatchTouchEvent", arguments)

    touch("touchStart", (-40, 10))
    touch("touchStart", (-40, 10), (40, -30))
    wait_until(lambda: len({press["id"] for press in page.presses()}) == 2)
    touch("touchMove", (-40, 10), (20, -10))
    wait_until(lambda: round(page.presses()[-1]["x_mm"]) == 20)
    places = {press["id"]: (round(press["x_mm"]), round(press["y_mm"])) for press in page.presses()}
    assert sorted(places.values()) == [(-40, 10), (20, -10)]
    touch("touchEnd")
    wait_until(lambda: {r["id"] for r in page.presses("release")} == set(places))


def test_only_a_simulated_skin_can_be_pressed_and_only_on_its_sheet(page: Page) -> None:
    for source in ("device", "replay"):
        page.skin.status |= {"source": {"kind": source}}
        page.stop_viewer()  # the first status that it had was that of a twin
        page.serve()
        page.open()
        wait_until(lambda: page.js("return tactomo.state.twin.answers"))
        assert not page["press-card"].is_displayed()
        page.click(0, 0)
    corners = [(-50, -50), (50, -50), (50, 0), (10, 0), (10, 50), (-50, 50)]
    hole = [(-40, 30), (-40, 40), (-30, 40), (-30, 30)]
    polygon = {"shape": "polygon", "width_mm": 100.0, "height_mm": 100.0}
    description = DESCRIPTION | polygon | {"outline_mm": [corners, hole]}
    page.skin.status |= {"source": {"kind": "twin"}, "description": description}
    wait_until(lambda: page["map"].get_attribute("data-x-mm") == "-50 50")
    page.wait_until_pressable()
    page.click(30, 30)  # in the bounding box, not on the sheet
    page.click(-35, 35)
    page.click(30, -30)
    wait_until(lambda: page.presses("release"))
    assert [round(press["x_mm"]) for press in page.presses()] == [30]


def test_held_presses_are_lifted_one_by_one_or_all_and_the_finger_with_the_page(page: Page) -> None:
    page.open()
    page.wait_until_pressable()
    page.click(10, 20, modifiers=8)
    held = "return !tactomo.touch.down.size && tactomo.touch.held.length === 1"
    wait_until(lambda: page.js(held))
    page.click(-30, 0)
    wait_until(lambda: page.presses("release"))
    # That the first is held may be told after the second is there.
    first, lifted = dict.fromkeys(press["id"] for press in page.presses())
    assert {round(p["x_mm"]) for p in page.presses() if p["id"] == first} == {10}
    assert [release["id"] for release in page.presses("release")] == [lifted]
    page.click(-30, 0, modifiers=8)
    buttons = "return [...document.querySelectorAll('#held button')].map(b => b.ariaLabel)"
    wait_until(lambda: len(page.js(buttons)) == 2)
    page["held"].find_elements(By.TAG_NAME, "button")[0].click()
    wait_until(lambda: page.presses("release") == [{"id": lifted}, {"id": first}])
    assert page.js(buttons) == ["Lift the press at x −30, y 0 mm"]
    page["clear"].click()
    wait_until(lambda: ("clear", {}) in page.twin.requests)
    assert page.js("return tactomo.touch.held.length") == 0

    page.twin.requests.clear()
    page.mouse("Pressed", 36, -48)
    wait_until(page.presses)
    page.browser.get("about:blank")
    wait_until(lambda: page.presses("release"))
    page.browser.back()
    wait_until(lambda: page.health == "good")
    assert page.js("return tactomo.touch.presses.length") == 0
    page.skin.press(36, -48)
    wait_until(partial(is_bright, page, 30, -48))
    page.js("tactomo.state.hello.old = true; dispatchEvent(new Event('pagehide'))")  # put away
    wait_until(lambda: page.health == "good" and not page.js("return tactomo.state.hello.old"))


def test_a_demo_lets_others_press_and_presses_by_itself_until_somebody_does(page: Page) -> None:
    page.twin.answers["scene"] = {"presses": [{"id": "finger"}]}
    page.stop_viewer()
    page.serve(press_itself=True)
    page.open()
    page.wait_until_pressable()
    wait_until(lambda: page.js("return tactomo.idle.isOver"))
    assert page.presses() == []
    page.twin.answers.clear()
    page.skin.press(0, 0)
    page.stop_viewer()
    page.serve(press_itself=True)
    page.open()
    wait_until(page.presses)
    assert "by itself" in page["map-help"].text
    page.click(40, 40)
    wait_until(lambda: {40} & {round(press["x_mm"]) for press in page.presses()})
    assert page.js("return tactomo.touch.presses.length") == 0
    assert not page.js("return tactomo.idle.isOn || !tactomo.idle.isOver")


# The last minute


def lanes_with(page: Page, colour: tuple[int, int, int]) -> list[bool]:
    """Return for the strip's upper and lower lane whether a colour is in it."""
    script = """
        const c = document.getElementById('strip');
        const [w, h] = [c.width, c.height];
        const there = (y0, y1) => {
          const {data} = c.getContext('2d').getImageData(0, y0, w, y1 - y0);
          for (let i = 0; i < data.length; i += 4)
            if (data[i + 3] > 240 && arguments[0].every((l, k) => Math.abs(data[i + k] - l) < 8))
              return true;
          return false;
        };
        return [there(0, Math.floor(0.4 * h)), there(Math.ceil(0.45 * h), Math.floor(0.8 * h))]"""
    return list(page.js(script, colour))


@pytest.mark.usefixtures("quiet_console")
def test_the_strip_shows_each_contacts_pressure_and_force_and_the_events(page: Page) -> None:
    first, second = (86, 180, 233), (0, 158, 115)  # of contacts 1 and 2
    page.skin.press(36, -48)
    (contact,) = page.skin.contacts
    page.skin.contacts = [replace(contact, pressure_kpa=None, pressure_range="below")]
    page.open()
    wait_until(lambda: page.js("return tactomo.timeline.frames.length > 20"))
    assert lanes_with(page, first) == [False, False]  # what nobody knows is not drawn as none
    page.skin.contacts = [replace(contact, force_n=80.0)]
    wait_until(lambda: lanes_with(page, first) == [True, True])
    assert lanes_with(page, second) == [False, False]
    page.skin.contacts.append(replace(contact, id=2))  # how hard in newtons is not known
    wait_until(lambda: lanes_with(page, second)[0])
    begin_s = time.monotonic()
    page.skin.events = [{"name": "port_lost", "severity": "error", "detail": "", "next_step": ""}]
    wait_until(lambda: page.js("return tactomo.timeline.events.length"))
    read = readouts(page)
    age_ms = page.js("return performance.now() - tactomo.timeline.events[0].at")
    told = [at for at, words in enumerate(reversed(read)) if words.endswith("port lost")]
    assert max(told) - min(told) < 0.03 * len(read)
    assert 0 < age_ms < 1e3 * (time.monotonic() - begin_s) + 50
    assert np.mean(told) / len(read) == pytest.approx(age_ms / 60_000, abs=0.03)
    for _ in range(9):
        page["zoom-in"].click()
    assert page.js("return tactomo.timeline.spanMs") == 5000
    actions = webdriver.ActionChains(page.browser)
    right = page["strip"].size["width"] // 2 - 20
    actions.move_to_element_with_offset(page["strip"], right, 0).perform()
    wait_until(lambda: " · 1: 200 kPa" in page["readout"].text)
    page["zoom-out"].click()
    assert page.js("return tactomo.timeline.spanMs") == 7500


def readouts(page: Page) -> list[str]:
    """Return what is read out under a pointer at each pixel of the strip, from left to right."""
    told: list[str] = page.js("""
        const strip = document.getElementById('strip');
        const {left, right} = strip.getBoundingClientRect();
        return Array.from({length: right - left}, (_, i) => {
          strip.dispatchEvent(new PointerEvent('pointermove', {clientX: left + i}));
          return document.getElementById('readout').textContent;
        })""")
    return told


def test_an_outage_is_told_and_each_event_stands_where_it_happened(page: Page) -> None:
    page.open()
    wait_until(lambda: page.js("return tactomo.timeline.frames.length") > 5)
    lost_ns = time.time_ns()
    page.skin.sends_frames = False
    # As a daemon has it: with the time of the newest dual scan, which is the same for both.
    at = {"acquired_realtime_ns": lost_ns, "severity": "warning", "detail": "", "next_step": ""}
    page.skin.events = [{**at, "name": "port_lost"}]
    wait_until(lambda: page.js("return tactomo.timeline.events.length") == 1)
    time.sleep(1.5)
    page.skin.events = [{**at, "name": "port_back"}]
    wait_until(lambda: page.js("return tactomo.timeline.events.length") == 2)
    page.skin.sends_frames = True
    wait_until(lambda: page.health == "good")
    page.js("tactomo.timeline.lookAt(tactomo.timeline.events[1].at)")
    wait_until(lambda: page.banner.startswith("Looking back. No data then"))
    assert page["no-contacts"].text == "Not known."
    assert "stale" in page.map_classes
    page["pause"].click()
    apart_ms = page.js("const [a, b] = tactomo.timeline.events; return b.at - a.at")
    assert apart_ms > 1400
    times = "return [...document.querySelectorAll('#events time')].map((t) => t.textContent)"
    assert len(set(page.js(times))) == 2
    assert [words for words in readouts(page) if "no data · port" in words]


@pytest.mark.usefixtures("quiet_console")
def test_what_was_is_looked_at_and_left_again(page: Page) -> None:
    page.skin.press(36, -48)
    page.open()
    wait_until(partial(is_bright, page, 30, -48))
    wait_until(lambda: page.js("return tactomo.timeline.frames.length") > 5)
    event = {"name": "tared", "severity": "warning", "detail": "", "next_step": ""}
    page.skin.events = [event]
    wait_until(lambda: "tared" in page["events"].text)
    page.skin.press(-30, 30, kpa=100)
    wait_until(lambda: sum(page.colour(30, -48)) < 60)
    page["events"].find_element(By.TAG_NAME, "button").click()  # an event leads to its moment
    wait_until(lambda: page.health == "paused")
    wait_until(partial(is_bright, page, 30, -48))
    page["pause"].click()
    wait_until(lambda: sum(page.colour(30, -48)) < 60)
    page["pause"].click()
    wait_until(lambda: page.health == "paused")
    page["moment"].send_keys(Keys.HOME)
    wait_until(partial(is_bright, page, 30, -48))
    wait_until(lambda: "36.0" in page["contacts"].text)
    assert page["moment"].get_attribute("aria-valuetext") == "60.0 s before the pause"
    wait_until(lambda: page["readout"].text.startswith("−60 s · "))  # by keyboard, too
    wait_until(lambda: "ago" in page.banner)
    page.skin.sends_frames = False  # what goes wrong now is said while one looks back, too
    wait_until(lambda: page.health == "stale")
    assert sum(page.colour(30, -48)) > 350
    page.skin.sends_frames = True
    wait_until(lambda: page.health == "paused")
    page["pause"].click()
    wait_until(lambda: sum(page.colour(30, -48)) < 60)
    wait_until(lambda: page.health == "good")
    actions = webdriver.ActionChains(page.browser)
    actions.move_to_element_with_offset(page["strip"], 0, 0).click_and_hold().move_by_offset(5, 0)
    actions.release().perform()  # a pointer on the strip looks back, too
    wait_until(lambda: page.health == "paused")
    assert -33_000 < int(page["moment"].get_attribute("value") or 0) < -29_000
    page["pause"].click()
    page.daemon.answers["replay"] = REPLAY  # where an event leads to its place in the recording
    page.skin.status |= {"replay": REPLAY}
    wait_until(lambda: page["replay"].is_displayed())
    time.sleep(0.3)
    page.skin.events = [event | {"name": "late"}]
    wait_until(lambda: "late" in page["events"].text)
    page["events"].find_element(By.TAG_NAME, "button").click()
    wait_until(lambda: page.daemon.requests)
    ((_, asked),) = page.daemon.requests
    assert asked["paused"]
    assert asked["position_s"] == pytest.approx(2.0, abs=0.5)


# Replays


REPLAY = {
    "position_s": 2.0,
    "duration_s": 40.0,
    "speed": 1.0,
    "paused": False,
    "loop": False,
    "waits_for_page": False,
    "exact": True,
    "maps_before": 0,
}


@pytest.mark.usefixtures("quiet_console")
def test_a_replay_is_steered_by_the_page(page: Page) -> None:
    page.open()
    assert not page["replay"].is_displayed()
    assert page["tare"].is_enabled()
    page.skin.status |= {"source": {"kind": "replay"}, "replay": REPLAY}
    page.daemon.answers["replay"] = REPLAY
    wait_until(lambda: page["replay"].is_displayed())
    wait_until(lambda: page["position-text"].text.endswith("/ 40.0 s"))
    assert page["speed"].get_attribute("value") == "1"
    wait_until(lambda: page.js("return tactomo.timeline.frames.length") > 5)
    page.browser.find_element(By.TAG_NAME, "body").send_keys(" ")
    wait_until(lambda: page.daemon.requests[:1] == [("replay", {"paused": True})])
    page.skin.status |= {"state": "paused", "replay": REPLAY | {"paused": True}}
    page.skin.sends_frames = False
    wait_until(lambda: page.health == "replay-paused")
    assert page.banner == "The replay is paused. The map shows the frame at the slider."
    assert not page["tare"].is_enabled()  # it goes by the references that were recorded
    assert page["state"].text == "replay paused"
    assert page["position-text"].text == "2.0 / 40.0 s"
    assert "scans/s" not in page["channels"].text  # none come, whatever came while it moved
    time.sleep(1.5)  # which is no outage
    page["pause"].click()
    wait_until(lambda: page.banner.startswith("Looking back. The map shows the frame of"))
    assert "stale" not in page.map_classes
    page["pause"].click()
    page.skin.status |= {"state": "running", "replay": REPLAY}
    count = page.js("return tactomo.timeline.frames.length")
    page.skin.sends_frames = True
    wait_until(lambda: page.js("return tactomo.timeline.frames.length") > count + 5)
    gaps_ms = np.diff(page.js("return tactomo.timeline.frames.map(({ at }) => at)"))
    assert gaps_ms.max() < 1000
    page.skin.status |= {"state": "paused", "replay": REPLAY | {"paused": True}}
    page.skin.sends_frames = False
    wait_until(lambda: page.health == "replay-paused")
    page["step"].click()
    page["loop"].click()
    page["speed"].find_element(By.XPATH, "./option[text()='0.25']").click()
    moved = REPLAY | {"paused": True, "maps_before": page.js("return tactomo.state.frame.sequence")}
    page.daemon.answers["replay"] = moved
    page.skin.status |= {"replay": moved}
    page["position"].send_keys(Keys.END)
    wait_until(lambda: page.health == "replay-moving")  # the map is that of before
    wait_until(lambda: "stale" in page.map_classes)
    page.skin.sends_frames = True  # of where it stands now
    wait_until(lambda: page.health == "replay-paused")
    wait_until(lambda: "may differ from the recorded ones" in page.banner)
    page.skin.sends_frames = False
    page.daemon.answers["replay"] = ControlError("the recording ends there", "", "bad_request")
    page["position"].send_keys(Keys.HOME)
    wait_until(lambda: page["message"].text == "the recording ends there")
    wait_until(lambda: page.health == "replay-paused")  # no frame will come
    page.daemon.answers["replay"] = REPLAY
    page["play"].click()
    ended = {"url": "replay:///a.mcap?port=0", "connected": False, "state": "ended"}
    rates = {"magnitude_hz": 0.0, "structure_hz": None, "frames_hz": 0.0}
    page.skin.status |= {"state": "ended", "ports": [ended], "rates": rates}
    wait_until(lambda: page["play"].text == "Play" and page["state"].text == "replay ended")
    wait_until(lambda: "at its end" in page["banner"].text)  # which is no alarm
    assert page["banner"].get_attribute("data-level") == "info"
    wait_until(lambda: dots(page)[0] == "good")
    assert "bad" not in dots(page)
    page["play"].click()
    asked = [
        {"paused": True},
        {"step": True},
        {"loop": True},
        {"speed": 0.25},
        {"position_s": 40.0},
        {"position_s": 0},
        {"paused": False},
        {"position_s": 0, "paused": False},
    ]
    wait_until(lambda: page.daemon.requests == [("replay", each) for each in asked])


def test_a_replay_that_waits_for_the_page_begins_when_its_first_frame_is_seen(page: Page) -> None:
    page.daemon.answers["replay"] = REPLAY
    waiting = REPLAY | {"paused": True, "waits_for_page": True}
    page.skin.status |= {"state": "paused", "replay": waiting}
    page.skin.sends_frames = False
    page.stop_viewer()  # it may have heard of a frame by now
    page.serve()
    page.browser.get(f"http://127.0.0.1:{page.port}/")
    wait_until(lambda: page.health == "replay-paused")
    status = "return tactomo.state.status.receivedAt"
    first = page.js(status)
    wait_until(lambda: page.js(status) > first)
    assert page.daemon.requests == []
    page.skin.sends_frames = True
    wait_until(lambda: ("replay", {"paused": False}) in page.daemon.requests)


# Buttons


def test_methods_recordings_and_tares_are_asked_for_and_told(page: Page) -> None:
    def in_force() -> str | None:
        return page["method"].get_attribute("value")

    own = "my_module:MyMethod"
    page.skin.status |= {"tier_requested": "fit"}
    page.open()
    wait_until(lambda: page["method"].text == "fit")  # though the daemon lists none
    page.skin.status |= {"methods": ["auto", "network", own], "tier_requested": "auto"}
    wait_until(lambda: in_force() == "auto")
    assert page["method"].text.split() == ["auto", "network", own]
    page.daemon.answers["set_tier"] = {"tier": own}
    page["method"].find_element(By.XPATH, f"./option[text()='{own}']").click()
    wait_until(lambda: page["message"].text == f"Method: {own}")
    assert page.daemon.requests == [("set_tier", {"tier": own})]
    page.skin.frame = {"tier": own}
    wait_until(lambda: page["made-by"].text == own)
    page.skin.status |= {"tier_requested": "network"}  # by another one
    wait_until(lambda: in_force() == "network")
    page.daemon.answers["set_tier"] = ControlError("it has no network", "", "no_network")
    page["method"].find_element(By.XPATH, "./option[text()='auto']").click()
    wait_until(lambda: "no network" in page["message"].text)
    wait_until(lambda: in_force() == "network")

    page.daemon.answers |= {"record_start": {"path": "/a.mcap"}, "record_stop": {"path": "/a.mcap"}}
    page["record"].click()
    wait_until(lambda: page["message"].text == "Recording to /a.mcap")
    page.skin.status |= {"recording": {"path": "/a.mcap", "bytes": 12}}
    wait_until(lambda: page["record"].accessible_name == "Stop the recording")
    page["record"].click()
    wait_until(lambda: ("record_stop", {}) in page.daemon.requests)
    assert [command for command, _ in page.daemon.requests[2:]] == ["record_start", "record_stop"]

    page.daemon.answers["tare"] = ControlError("somebody presses", "lift it", "tare_refused")
    page["tare"].click()
    wait_until(lambda: page["message"].text == "somebody presses; lift it")
    page.daemon.answers["tare"] = {"scans": 20}
    page["tare"].click()
    wait_until(lambda: "20 scans" in page["message"].text)
    page.skin.status |= {"state": "taring"}
    wait_until(lambda: page.health == "taring")
    assert "do not touch" in page.banner
    page.skin.status |= {"state": "waiting_for_data", "uptime_s": 2.0}
    wait_until(lambda: page.health == "no-data")
    level = page["banner"].get_attribute
    assert level("data-level") == "info"  # a daemon that has just begun is no alarm
    page.skin.status |= {"uptime_s": 30.0}
    wait_until(lambda: level("data-level") == "warning")


# When things stop


@pytest.mark.slow
def test_what_stops_is_told_and_comes_back(page: Page) -> None:
    page.skin.press(36, -48)
    page.open()
    wait_until(lambda: page["count"].text == "1")
    point_at(page, 36, -48)
    wait_until(lambda: page["readout"].text.endswith(": 200 kPa"))
    page.wait_until_pressable()
    page.mouse("Pressed", 36, -48)
    wait_until(lambda: re.fullmatch(r"error 0\.[0-2] mm, 20 kPa", page["error"].text))
    page.skin.sends_frames = False
    wait_until(lambda: page.health == "stale")
    wait_until(lambda: page["readout"].text.endswith(" mm"))  # of before: nobody knows it now
    wait_until(lambda: page["error"].text == "")
    page.mouse("Released", 36, -48)
    assert page.banner.startswith("Stale. The newest frame is ")
    assert page["state"].text == "stale"
    wait_until(lambda: page.map_classes == {"pressable", "stale"})
    wait_until(lambda: page["no-contacts"].text == "Not known.")  # and not "Nothing pressed."
    assert page["made-by"].text == "–"
    closed = {"severity": "error", "what": "/dev/ttySKIN is closed", "next_step": "plug it in"}
    page.skin.status |= {"issues": [closed]}
    wait_until(lambda: page.banner.endswith(" s old; /dev/ttySKIN is closed"))
    stopped = {"severity": "error", "what": "scans have stopped", "next_step": "see the ports"}
    page.skin.status |= {"issues": [stopped, closed, stopped]}
    wait_until(lambda: page.banner.endswith(" old; /dev/ttySKIN is closed; 2 more under Channels"))
    page.skin.status |= {"issues": []}
    page.skin.sends_frames = True
    wait_until(lambda: page.health == "good")
    wait_until(lambda: not page["banner"].is_displayed())
    wait_until(lambda: page.map_classes == {"pressable"})

    page.stop_viewer()
    wait_until(lambda: page.health == "viewer-gone")
    assert page.banner.startswith("The viewer's server is gone.")
    page.serve()
    wait_until(lambda: page.health == "good")
    goes_on = page.served.hang()  # the connection stays, nothing comes
    try:
        wait_until(lambda: page.health == "viewer-gone")
    finally:
        goes_on.set()
    wait_until(lambda: page.health == "good")

    page.skin.status |= {"rates": {"magnitude_hz": 20.6, "structure_hz": 20.6, "frames_hz": 20.6}}
    wait_until(lambda: dots(page) == ["good", "good", ""])
    page.skin.__exit__()
    wait_until(lambda: page.health == "daemon-gone")
    assert page.banner.startswith("The daemon is gone. Last heard ")
    assert not page["tare"].is_enabled()
    assert dots(page) == [""] * 3
    assert "20.6" not in page["channels"].text
    with Skin(page.skin.address) as again:
        again.press(-30, 30)
        wait_until(lambda: page.health == "good")
        wait_until(partial(is_bright, page, -36, 30))
        wait_until(page["tare"].is_enabled)


@pytest.mark.slow
def test_a_server_given_up_for_its_silence_is_asked_again_once(page: Page) -> None:
    page.open()
    # The socket that is given up closes a little later, while the next one is waited for.
    sockets = page.browser.execute_async_script("""
        const done = arguments[0], made = [];
        window.WebSocket = class {
          constructor() { made.push(this); }
          close() { setTimeout(() => this.onclose(), 50); }
        };
        import('/link.js').then(({ Link }) => {
          const link = new Link({ onChange() {} });
          made[0].onopen();
          link.lastHeard = -Infinity;
          setTimeout(() => done(made.length), 2200);
        })""")
    assert sockets == 2


def test_what_waits_in_a_busy_page_grows_old(page: Page) -> None:
    page.open()
    oldest_ms = page.browser.execute_async_script("""
        const done = arguments[0], ages = [], { timeline } = tactomo, { add } = timeline;
        timeline.add = (frame) => {
          ages.push(performance.now() - frame.receivedAt + frame.age_ms);
          add.call(timeline, frame);
        };
        setTimeout(() => {
          const begun = performance.now();
          while (performance.now() - begun < 1500);
          setTimeout(() => done(Math.max(...ages)), 500);
        }, 500)""")
    assert oldest_ms > 1000


@pytest.mark.slow
def test_a_daemon_that_never_came_is_waited_for(page: Page) -> None:
    page.skin.__exit__()
    page.stop_viewer()  # it may have heard of the daemon by now
    page.serve()
    page.browser.get(f"http://127.0.0.1:{page.port}/")
    wait_until(lambda: page.health == "starting")  # is no alarm yet
    assert page["banner"].get_attribute("data-level") == "info"
    assert page["state"].text == "connecting"
    page.js("tactomo.state.openedAt -= 60000")
    wait_until(lambda: page.health == "no-daemon")
    assert page["banner"].find_element(By.TAG_NAME, "code").text == "tactomo daemon"
    assert f"“left” at {page.skin.address}" in page.banner
    assert page["no-contacts"].text == "Not known."
    with Skin(page.skin.address):
        wait_until(lambda: page.health == "good")


# For everybody


@pytest.mark.slow
def test_at_every_width_all_is_seen_and_nothing_moves_when_a_banner_comes(page: Page) -> None:
    page.skin.press(60, 60, kpa=280.0)
    (contact,) = page.skin.contacts
    firm = replace(contact, pressure_sigma_kpa=11.0, force_n=128.0, force_sigma_n=13.0)
    light = replace(firm, id=2, pressure_kpa=None, pressure_range="below", max_kpa=131.0)
    page.skin.contacts = [firm, light]
    error = """const error = document.getElementById('error');
        error.textContent = 'error 2.0 mm, −16 kPa';
        const {scrollWidth, clientWidth} = error;"""
    table = "const {scrollWidth, clientWidth} = document.querySelector('.scroll');"
    places = """return ['map', 'strip', 'moment'].map((id) => {
        const {left, top, width, height} = document.getElementById(id).getBoundingClientRect();
        return [left, top, width, height]; })"""
    told = {"severity": "error", "what": "frames come late", "next_step": "be quick " * 20}
    for width, height, least in (
        *((320, 800, 200), (390, 844, 295), (768, 800, 400), (1024, 800, 400)),
        *((1920, 1080, 690), (1280, 800, 440)),
    ):
        page.open(width=width, height=height)
        wait_until(lambda: "131" in page["contacts"].text)
        assert page.js("return document.documentElement.scrollWidth") <= width
        assert page.js(f"{table} return scrollWidth - clientWidth") == 0  # nothing is cut off
        assert page.js(f"{error} return scrollWidth - clientWidth") == 0
        left, right = (
            page.js("return tactomo.mmToPixel(arguments[0], 0)[0]", x) for x in (-75, 75)
        )
        assert right < page.js("return document.getElementById('map').clientWidth")
        assert right - left >= least
        (one, upper, wide), (other, lower, _) = sorted(page.js("return tactomo.labels()"))
        assert abs(upper - lower) >= 22 or other >= one + wide  # both can be read
        before = page.js(places)
        page.skin.status |= {"issues": [told]}
        wait_until(lambda: page["banner"].is_displayed())
        assert page.js(places) == before
        bottom = page.js("return document.getElementById('banner').getBoundingClientRect().bottom")
        assert bottom <= before[0][1]
        page.skin.status |= {"issues": []}
        wait_until(lambda: not page["banner"].is_displayed())
    # A laptop shows contacts, method and health without scrolling.
    page.skin.contacts = [replace(contact, id=number) for number in range(1, 6)]
    names = ("contacts", "method", "made-by", "quality", "confidence", "moment")

    def ends() -> dict[str, float]:
        bottom = "document.getElementById(id).getBoundingClientRect().bottom"
        bottoms = page.js(f"return arguments[0].map((id) => {bottom})", names)
        return dict(zip(names, bottoms, strict=True))

    # A banner is above them where a busy computer lets a frame grow old.
    wait_until(
        lambda: page["count"].text == "5" and page.health == "good" and max(ends().values()) <= 800,
        f"all of {ends()}",
    )


FOCUSED = """
const at = document.activeElement, seen = at.matches('.segmented input') ? at.nextSibling : at;
const { outlineStyle, outlineWidth } = getComputedStyle(seen);
const isMarked = outlineStyle !== 'none' && parseFloat(outlineWidth) >= 2;
return [at.id || at.name || at.closest('table, ol')?.id, isMarked]"""


@pytest.mark.slow
def test_whoever_sees_nothing_or_has_no_mouse_is_served(page: Page) -> None:
    def nodes() -> list[dict[str, Any]]:
        every = page.browser.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
        return [node for node in every if "role" in node]

    page.open()
    page.wait_until_pressable()
    # Both regions are there before anything is told.
    assert len([node for node in nodes() if node["role"].get("value") == "status"]) == 2
    roles = {"button", "slider", "combobox", "checkbox", "radio", "application", "img", "table"}
    controls = [node for node in nodes() if node["role"].get("value") in roles]
    assert len(controls) >= 15
    nameless = [json.dumps(node["role"]) for node in controls if not node["name"].get("value")]
    assert nameless == []
    told = page["spoken"].get_attribute
    wait_until(lambda: told("textContent") == "Nothing pressed.")
    page.skin.press(36, -48)
    page.skin.frame |= {"flags": ["misfit_high"]}
    wait_until(lambda: told("textContent") == "1 contact, misfit high")
    page["map"].send_keys(Keys.SHIFT, Keys.ARROW_RIGHT, Keys.SHIFT)
    wait_until(lambda: told("textContent") == "1 contact, misfit high, x 10, y 0 mm: 0 kPa")
    page.js("document.activeElement.blur()")
    page.skin.sends_frames = False
    wait_until(
        lambda: str(told("textContent")).startswith("Stale. The newest frame is a while old")
    )
    assert told("aria-live") == "assertive"
    for control, value in (("pressure", "180 kPa"), ("size", "30 mm"), ("moment", "now")):
        assert page[control].get_attribute("aria-valuetext") == value

    page.skin.sends_frames = True
    page.skin.status |= {"replay": REPLAY | {"exact": False}}
    page.skin.events = [{"name": "tared", "severity": "info", "detail": "", "next_step": ""}]
    wait_until(lambda: page["replay"].is_displayed() and "tared" in page["events"].text)
    wait_until(lambda: page["count"].text == "1")
    focused: list[tuple[str, bool]] = []
    while not focused or focused[-1] != focused[0] or len(focused) == 1:
        webdriver.ActionChains(page.browser).send_keys(Keys.TAB).perform()
        focused.append(tuple(page.js(FOCUSED)))
        assert len(focused) < 40
    assert [name for name, is_marked in focused if name and not is_marked] == []
    names = "play step position speed loop moment zoom-out zoom-in pause method pressure size"
    names += " shape hold clear scale colormap smooth outline unit tare record map contacts events"
    assert {name for name, _ in focused} >= set(names.split())
