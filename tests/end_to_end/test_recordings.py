"""Recordings: a measured stream goes the way of a live one, and a replay waits for its page."""

from __future__ import annotations

import math
import subprocess
import sys
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from selenium.webdriver import Chrome
from shared_data import measured
from tactomo.recordings.recording import open_recording
from tactomo_client import request, subscribe
from tactomo_client.messages import MAP, decode_message
from waiting import PATIENCE_S, wait_until
from whole_system import ANYWHERE, SENSOR, Demo, tactomo


def maps_in(recording: Path) -> dict[int, dict[str, Any]]:
    """Maps of a recording by their scan counter."""
    found = {}
    with recording.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.topic == MAP:
                decoded = decode_message(message.data)
                assert decoded.kind == MAP
                found[decoded.fields["scan_counter"]] = decoded.fields
    return found


@pytest.mark.slow
def test_a_measured_stream_is_imported_replayed_and_located(tmp_path: Path) -> None:
    recording, again = tmp_path / "tank.mcap", tmp_path / "again.mcap"
    tank = measured("tank_sciospec_20fps.npz")
    tactomo(
        *("import", tank, recording, "--description", "tank_disc", "--reference-frames", "0:20")
    )
    tactomo(
        *("daemon", "--description", "tank_disc", "--port", f"replay://{recording}?port=0&speed=0"),
        *("--set", f"recording.file={again}", "--set", "recording.maps=true"),
        *("--set", "exit_at_end=true"),
        *("--stream", ANYWHERE, "--control", ANYWHERE),
    )
    maps = maps_in(again)
    assert len(maps) == 255
    frames = [maps[counter] for counter in sorted(maps)]
    assert all(not frame["contacts"] for frame in frames[:20]), "the tank is empty at first"
    moving = [frame["contacts"] for frame in frames[130:200]]
    assert all(len(contacts) == 1 for contacts in moving), "one cup"
    angle = np.unwrap([math.atan2(contacts[0]["y_mm"], contacts[0]["x_mm"]) for contacts in moving])
    # The hand leads it around the tank, counter-clockwise, by well over half a turn.
    assert angle[-1] - angle[0] > math.pi
    assert np.diff(angle).min() > -0.2


SCRUB = """
const slider = document.getElementById('position');
slider.value = arguments[0];
slider.dispatchEvent(new Event('input'));
return slider.value;
"""
SHOWN = """
const {drawn} = tactomo.state;
return [document.body.dataset.health, drawn.scan_counter,
        ...drawn.contacts.map((contact) => [contact.x_mm, contact.y_mm])];
"""


@pytest.mark.slow
@pytest.mark.browser
def test_a_replay_with_a_page_begins_when_it_is_open_and_shows_where_it_is_moved(
    demo: Demo, browser: Chrome, tmp_path: Path
) -> None:
    demo.press(-40.0, -40.0, pressure_kpa=180)
    with subscribe(SENSOR, address=demo.stream, timeout_s=PATIENCE_S) as frames:
        next(frame for frame in frames if frame.contacts)
        started = request("record_start", demo.control, PATIENCE_S, path="short.mcap", maps=True)
        path = Path(started["path"])
        for place_mm in (-40.0, -20.0, 0.0, 20.0):
            demo.press(place_mm, place_mm, pressure_kpa=180)
            assert len(list(islice(frames, 9))) == 9
        request("record_stop", demo.control, PATIENCE_S)
    demo.clear()
    control = f"ipc://{tmp_path}/control"
    command = ["replay", path, "--viewer", "--loop", "--viewer-port", 0, "--control", control]
    command += ["--stream", f"ipc://{tmp_path}/stream"]
    replay = subprocess.Popen(
        [sys.executable, "-m", "tactomo.cli", *map(str, command)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert replay.stdout is not None
        words = (word for line in replay.stdout for word in line.split())
        page = next(word for word in words if word.startswith("http://"))
        waiting = request("status", control, PATIENCE_S)
        assert waiting["state"] == "paused"
        assert waiting["frames"] <= 1  # the first one is shown
        browser.get(page)
        wait_until(
            lambda: request("status", control, PATIENCE_S)["frames"] > 60, "the second round"
        )
        request("replay", control, PATIENCE_S, paused=True)
        wait_until(lambda: browser.execute_script(SHOWN)[0] == "replay-paused")
        recording, recorded = open_recording(path), maps_in(path)
        times_s = {
            mark.scans[0].counter: (mark.clock_ns - recording.start_ns) * 1e-9
            for mark in recording.marks()
        }
        counters = sorted(times_s)
        for number in (20, 6, 26, 11, 15):  # there and back
            # The slider has steps, and a busy computer's frames may come several to a step.
            at_s = float(browser.execute_script(SCRUB, times_s[counters[number]] - 0.02))
            first = next(n for n, counter in enumerate(counters) if times_s[counter] >= at_s)
            # Frames stand where they were made, their scans a little before.
            there = [["replay-paused", counter] for counter in counters[first - 1 : first + 3]]

            def is_shown(there: list[Any] = there) -> bool:
                return browser.execute_script(SHOWN)[:2] in there

            wait_until(is_shown, f"the frame at {at_s} s, one of {there}")
            _, counter, *places = browser.execute_script(SHOWN)
            expected = [(c["x_mm"], c["y_mm"]) for c in recorded[counter]["contacts"]]
            assert len(places) == len(expected) == 1
            assert math.dist(places[0], expected[0]) < 3
    finally:
        replay.terminate()
        replay.communicate(timeout=PATIENCE_S)
