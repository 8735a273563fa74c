"""The demo as a person meets it: the page, the mouse, a script, and Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from page import first_line_of_the_readme
from processes import children_of, is_running
from selenium.webdriver import ActionChains, Chrome
from selenium.webdriver.common.by import By
from small_sensor import SMALL
from waiting import PATIENCE_S, wait_until
from whole_system import SENSOR, Demo, running_demo


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


def test_a_script_of_pyzmq_and_msgpack_alone_prints_contacts(demo: Demo, tmp_path: Path) -> None:
    """Written from the stream's documentation: this test imports nothing of ours."""
    script = tmp_path / "contacts.py"
    script.write_text(f"""
import msgpack, zmq
socket = zmq.Context().socket(zmq.SUB)
socket.connect({demo.stream!r})
socket.subscribe(b"{SENSOR}/contacts\\0")
while True:
    topic, _, body = socket.recv().partition(b"\\0")
    message = msgpack.unpackb(body)
    for contact in message["contacts"]:
        print(round(contact["x_mm"]), round(contact["y_mm"]), contact["pressure_kpa"])
        raise SystemExit
""")
    demo.clear()
    demo.press(-40.0, 40.0)
    done = subprocess.run(
        [sys.executable, "-I", script], capture_output=True, text=True, timeout=PATIENCE_S
    )
    demo.clear()
    assert done.returncode == 0, done.stderr
    x_mm, y_mm, _ = done.stdout.split()
    assert abs(int(x_mm) + 40) < 5
    assert abs(int(y_mm) - 40) < 5


def test_the_readme_subscribes_in_six_lines(demo: Demo, tmp_path: Path) -> None:
    demo.press(20.0, 0.0)
    line = first_line_of_the_readme(demo, tmp_path)
    demo.clear()
    assert "kPa" in line


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_demo_that_ends_leaves_no_process_behind(number: signal.Signals, tmp_path: Path) -> None:
    sensor = tmp_path / "small.toml"
    sensor.write_text(SMALL)
    with running_demo("--description", str(sensor)) as demo:
        children = children_of(demo.process.pid)
        assert len(children) == 3
        os.kill(demo.process.pid, number)
        wait_until(lambda: not any(is_running(pid) for pid in children), "the children to end")
        wait_until(lambda: demo.process.poll() is not None, "the demo to end")
    if number != signal.SIGKILL:
        assert demo.process.returncode in (0, 130)
