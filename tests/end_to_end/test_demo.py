"""The demo as a person meets it: a press, the page, the mouse, a script, and Ctrl-C."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import pytest
from fixture_types import Run
from page import first_line_of_the_readme
from selenium.webdriver import ActionChains, Chrome
from selenium.webdriver.common.by import By
from tactomo_client import Frame, request, subscribe
from waiting import PATIENCE_S, wait_until
from whole_system import SENSOR, Demo


@pytest.mark.parametrize(
    "places", [[(0.0, 0.0)], [(-30.0, 25.0), (35.0, -20.0)]], ids=["centre", "two"]
)
def test_every_press_is_found_within_3_mm_with_its_pressure(
    demo: Demo, places: list[tuple[float, float]]
) -> None:
    demo.clear()
    settled_frame(demo, 0)
    for number, (x_mm, y_mm) in enumerate(places):
        demo.press(x_mm, y_mm, id=str(number), pressure_kpa=180, radius_mm=15)
    frame = settled_frame(demo, len(places), "fit")
    demo.clear()
    for place in places:
        assert min(math.dist((c.x_mm, c.y_mm), place) for c in frame.contacts) < 3.0
    for contact in frame.contacts:
        assert contact.pressure_kpa == pytest.approx(180, abs=20)
        assert contact.area_mm2 == pytest.approx(math.pi * 15**2, rel=0.35)
    assert frame.map is not None
    assert frame.map.shape == (51, 51)
    assert frame.map.max() > 0.1


def settled_frame(demo: Demo, contacts: int, tier: str | None = None) -> Frame:
    """First unflagged frame with so many contacts, of a tier if one is given.

    Where others take the processor, frames get less time until it is free again.
    """
    deadline = time.monotonic() + 200.0
    with subscribe(SENSOR, address=demo.stream, timeout_s=PATIENCE_S) as frames:
        for frame in frames:
            settled = not frame.flags and len(frame.contacts) == contacts
            if settled and tier in (None, frame.tier):
                return frame
            assert time.monotonic() < deadline, f"{frame.tier} {frame.contacts} {frame.flags}"
    raise AssertionError("the stream ended")


@pytest.mark.browser
def test_a_press_by_mouse_becomes_a_contact_at_that_place(demo: Demo, browser: Chrome) -> None:
    demo.clear()
    browser.get(demo.page)
    wait_until(lambda: "kPa" in browser.page_source, "the page")
    canvas = browser.find_element(By.ID, "map")
    # The page takes presses once it knows that a twin answers.
    wait_until(lambda: browser.find_elements(By.CSS_SELECTOR, "#map.pressable"), "the twin")
    x, y = browser.execute_script("return window.tactomo.mmToPixel(30, -25)")
    size = canvas.size
    mouse = ActionChains(browser)
    # The driver counts from the element's middle.
    mouse.move_to_element_with_offset(
        canvas, round(x - size["width"] / 2), round(y - size["height"] / 2)
    ).click_and_hold().perform()

    def found() -> tuple[float, float] | None:
        # At once: the page may draw its rows anew between two questions.
        rows = browser.execute_script(
            "return [...document.querySelectorAll('#contacts [data-id]')]"
            ".map(({dataset}) => [Number(dataset.xMm), Number(dataset.yMm)])"
        )
        return tuple(rows[0]) if len(rows) == 1 else None

    def is_near() -> bool:
        place = found()
        return place is not None and abs(place[0] - 30) < 3 and abs(place[1] + 25) < 3

    try:
        wait_until(is_near, f"a contact at (30, -25) mm; there is {found()}")
    finally:
        mouse.release().perform()
    wait_until(
        lambda: not browser.find_elements(By.CSS_SELECTOR, "#contacts [data-id]"), "the release"
    )


def test_the_readme_subscribes_in_six_lines(demo: Demo, tmp_path: Path) -> None:
    demo.press(20.0, 0.0)
    line = first_line_of_the_readme(demo, tmp_path)
    demo.clear()
    assert "kPa" in line


@pytest.mark.slow
def test_doctor_finds_a_healthy_skin_and_noise(tactomo: Run, demo: Demo) -> None:
    def snrs(status: int) -> list[dict[str, Any]]:
        look = ("doctor", "-s", SENSOR, "--address", demo.stream, "--seconds", "1", "--json")
        told = json.loads(tactomo(*look, status=status).stdout)
        assert [each["pressed"] for each in told["stream"] if each["about"] == "frames"] == [0]
        found = [each for channel in told["channels"].values() for each in channel["findings"]]
        return [each for each in found if each["about"] == "snr"]

    request("tare", demo.control, PATIENCE_S)
    assert [each["snr_db"] > 50 for each in snrs(status=0)] == [True, True]
    request("noise", demo.twin, PATIENCE_S, noise_v=0.02)  # for good: no test after this one
    request("garbage", demo.twin, PATIENCE_S, count=4000)
    assert {each["level"] for each in snrs(status=1)} <= {"fault", "broken"}
