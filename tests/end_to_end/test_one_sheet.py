"""Sensors of one sheet, graded or saturating, as a user starts them: `tactomo demo -d NAME`."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from selenium.webdriver import Chrome
from selenium.webdriver.common.by import By
from tactomo_client import (
    BadArgument,
    Contact,
    ControlError,
    Daemon,
    Frame,
    NoNetwork,
    request,
    subscribe,
)
from tactomo_client.recording import open_recording
from tactomo_models import load_description
from waiting import PATIENCE_S, wait_until
from whole_system import ANYWHERE, SENSOR, Demo, running_demo, tactomo

GRADED, POLYGON, SATURATING = "graded_square", "palm_l", "skin_round"
AT_MM = (-18.0, -15.0)
PRESS = {"pressure_kpa": 200.0, "radius_mm": 10.0}
NEAR_MM = 3.0


SLOW = [pytest.param(sensor, marks=pytest.mark.slow) for sensor in (POLYGON, SATURATING)]


@pytest.fixture(scope="module", params=[GRADED, *SLOW])
def one_sheet(request: pytest.FixtureRequest) -> Iterator[tuple[Demo, str]]:
    """A demo, pressed at AT_MM, and its channel."""
    with running_demo("--description", request.param) as demo:
        demo.press(*AT_MM, **PRESS)
        yield demo, "structure" if request.param == SATURATING else "magnitude"


def pressed_frame(demo: Demo) -> Frame:
    """Wait for the frame of one contact where the demo is pressed."""
    frames: list[Frame] = []
    with subscribe(SENSOR, address=demo.stream, timeout_s=PATIENCE_S) as skin:
        wait_until(
            lambda: is_there(frames[-1].contacts),
            "the contact",
            meanwhile=lambda: frames.append(next(skin)),
        )
    return frames[-1]


def is_there(contacts: tuple[Contact, ...]) -> bool:
    return [math.dist((c.x_mm, c.y_mm), AT_MM) < NEAR_MM for c in contacts] == [True]


def test_a_press_becomes_a_contact_there_and_what_the_sheet_cannot_tell_is_absent(
    one_sheet: tuple[Demo, str],
) -> None:
    demo, channel = one_sheet
    frame = pressed_frame(demo)
    assert {"magnitude": frame.map is not None, "structure": frame.structure is not None} == {
        name: name == channel for name in ("magnitude", "structure")
    }
    assert not frame.flags & {"magnitude_missing", "structure_missing"}
    if channel == "structure":
        assert frame.pressure_kpa is None
        assert frame.contacts[0].pressure_kpa is None
    with Daemon(demo.control) as daemon:
        status = daemon.status()
    image = frame.map if channel == "magnitude" else frame.structure
    assert image is not None
    assert status.description is not None
    off_sheet = load_description(status.description.model).off_sheet
    expected = np.zeros(image.shape, bool) if off_sheet is None else off_sheet
    np.testing.assert_array_equal(np.isnan(image), expected)
    assert len(status.ports) == 1
    assert status.incomplete_scans == 0


def test_a_method_that_needs_what_the_sheet_lacks_is_refused(one_sheet: tuple[Demo, str]) -> None:
    demo, channel = one_sheet
    with Daemon(demo.control) as daemon:
        offered = daemon.status().methods
        assert {"auto", "tikhonov", "noser", "fit"} <= set(offered)
        assert "network" not in offered
        assert ("levelset" in offered) == (channel == "structure")
        with pytest.raises(NoNetwork, match="both channels"):
            daemon.set_method("network")
        if channel == "magnitude":
            with pytest.raises(BadArgument, match="structure channel"):
                daemon.set_method("levelset")
        else:
            daemon.set_method("levelset")
            daemon.set_method("auto")
        # The daemon answers after 1 s at most, but a frame that is being made may take longer.
        wait_until(lambda: daemon.status().tier_requested == "auto", "the method in force")


def test_the_twin_has_no_sheet_but_its_own_to_mute(one_sheet: tuple[Demo, str]) -> None:
    demo, channel = one_sheet
    other = {"magnitude": "structure", "structure": "magnitude"}[channel]
    with pytest.raises(ControlError, match=f"give {channel}"):
        request("mute", demo.twin, PATIENCE_S, channel=other, seconds=1.0)


@pytest.mark.slow
def test_what_is_recorded_replays_and_is_plotted(
    one_sheet: tuple[Demo, str], tmp_path: Path
) -> None:
    demo, channel = one_sheet
    again = tmp_path / "again.mcap"
    with (
        Daemon(demo.control) as daemon,
        subscribe(SENSOR, address=demo.stream, timeout_s=PATIENCE_S) as skin,
    ):
        pressed_frame(demo)
        with daemon.record("live.mcap", maps=True) as recording:
            live = recording.path
            begin_ns = time.monotonic_ns()  # what was acquired before may not be in it
            since = (frame for frame in skin if frame.acquired_monotonic_ns > begin_ns)
            assert len(list(islice(since, 10))) == 10
    anywhere = ("--stream", ANYWHERE, "--control", ANYWHERE)
    tactomo("replay", live, "--speed", "max", "--record", again, *anywhere)
    tactomo("plot", live, "-o", tmp_path / "live.png")
    name = "map" if channel == "magnitude" else "structure"
    recorded = {frame.scan_counter: frame for frame in open_recording(live)}
    replayed = {frame.scan_counter: frame for frame in open_recording(again)}
    shared = recorded.keys() & replayed.keys()
    assert len(shared) >= 8
    for counter in shared:
        np.testing.assert_array_equal(
            getattr(recorded[counter], name), getattr(replayed[counter], name)
        )


@pytest.mark.slow
def test_status_and_doctor_know_of_one_sheet(one_sheet: tuple[Demo, str]) -> None:
    demo, _ = one_sheet
    tactomo("status", "--address", demo.stream)
    demo.clear()
    with subscribe(SENSOR, address=demo.stream, timeout_s=PATIENCE_S) as skin:
        next(frame for frame in skin if not frame.contacts)
    tactomo("doctor", "-s", SENSOR, "--address", demo.stream, "--seconds", "2")
    demo.press(*AT_MM, **PRESS)


@pytest.mark.slow
@pytest.mark.browser
def test_the_page_shows_the_contact(one_sheet: tuple[Demo, str], browser: Chrome) -> None:
    demo, _ = one_sheet
    pressed_frame(demo)
    browser.get(demo.page)
    wait_until(lambda: browser.find_elements(By.CSS_SELECTOR, "#contacts [data-id]"), "the contact")
    health = "return document.body.dataset.health"  # stale for a moment on a busy computer
    wait_until(lambda: browser.execute_script(health) == "good", "a page that is well")
