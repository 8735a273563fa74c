"""`watch`: in a terminal and in a pipe, with data, with old data and with none."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from fixture_types import Run
from tactomo.cli.steer.watch import frame_line, map_text
from tactomo.running import Running, announced
from tactomo_client import Contact, subscribe
from tactomo_client.appearance import PRESSED_COLOUR
from tactomo_client.fake import FakeSensor
from terminal import Terminal
from waiting import PATIENCE_S, repeated

CONTACT = Contact(
    7, x_mm=12.5, y_mm=-20.0, area_mm2=700.0, magnitude=0.1, magnitude_sigma=0.01, pressure_kpa=171
)
STATUS = {
    "state": "running",
    "rates": {"frames_hz": 19.7},
    "latency_ms": {"p50": 3.0, "p99": 5.0},
    "description": {"pressure_max_kpa": 200.0},
    "companions": {
        "cell": {"state": "fitted", "reading": 255.5, "force_n": 127.0, "force_sigma_n": 2.5}
    },
}


def images() -> dict[str, Any]:
    pressure = np.zeros((51, 51), np.float32)
    pressure[10, 30] = 200.0  # near the bottom, right of the middle
    structure = (pressure > 0).astype(np.float32)
    structure[40, 20] = 1.0  # pressed, but not hard enough for a value
    return {"map": pressure / 1000, "pressure_kpa": pressure, "structure": structure}


@pytest.fixture
def sensor() -> Iterator[FakeSensor]:
    """Publish a frame and a status twenty times a second."""
    with FakeSensor("skin") as fake:

        def publish() -> None:
            fake.publish([CONTACT], **images())
            fake.publish_message("status", STATUS)

        with repeated(publish):
            yield fake


def test_it_shows_map_contacts_and_health_and_ends_by_ctrl_c(sensor: FakeSensor) -> None:
    with Terminal("watch", "--address", sensor.address) as terminal:
        terminal.wait_for("19.7 frames/s")
        terminal.press_ctrl_c()
        assert terminal.wait() == 0
    shown = terminal.shown
    assert "▀" * 51 in shown
    assert "171 kPa" in shown
    assert "running" in shown
    assert "reads 255.5: 127.0 ± 2.5 N" in " ".join(shown.split())


def test_it_says_when_data_are_stale_and_the_end_of_a_replay_is_not_called_so() -> None:
    status = dict(STATUS)
    with FakeSensor("left") as fake, old_frames(fake, status), Terminal("watch") as terminal:
        assert "nothing pressed" not in terminal.wait_for("STALE: the newest frame is")
        status["state"] = "ended"
        terminal.wait_for("ended")
        assert "STALE" not in terminal.wait_for("ended") + terminal.wait_for("ended")


@contextmanager
def old_frames(fake: FakeSensor, status: dict[str, Any]) -> Iterator[None]:
    """Publish, over and over, a status and then a frame of long ago."""
    old: dict[str, Any] = {"acquired_monotonic_ns": time.monotonic_ns() - 2_000_000_000}
    missing = ["map", "status", "event"]  # or the frame might come without its status

    def publish() -> None:
        while missing:
            fake.wait_for_subscriber(PATIENCE_S)
            missing.pop()
        fake.publish_message("status", status)
        fake.publish([], **images(), **old)

    with repeated(publish), announced(Running("daemon", "", "left", fake.address)):
        yield


def test_in_a_pipe_it_prints_a_line_a_frame(sensor: FakeSensor) -> None:
    command = [sys.executable, "-m", "tactomo.cli", "watch", "--address", sensor.address]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = [process.stdout.readline() for _ in range(6)]
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0
    assert all("#7 (+12.5, -20.0) mm 171 kPa" in line for line in lines)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        (
            {"pressure_sigma_kpa": 4.2, "force_n": 119.7, "force_sigma_n": 6.0},
            "171 ± 4 kPa, 120 ± 6 N",
        ),
        ({"pressure_kpa": None, "pressure_range": "below"}, "touched, pressure unknown"),
        (
            {"pressure_kpa": 300.0, "force_n": 210.0, "pressure_range": "above"},
            "≥ 300 kPa, ≥ 210 N",
        ),
        ({"pressure_kpa": None}, "Δσ/σ₀ 0.100"),
    ],
)
def test_it_says_how_well_a_pressure_is_known(fields: dict[str, Any], words: str) -> None:
    with FakeSensor("skin") as fake, subscribe("skin", address=fake.address) as frames:
        fake.wait_for_subscriber()
        fake.publish([dataclasses.replace(CONTACT, **fields)])
        assert frame_line(next(frames)).endswith(f"mm {words}")


def test_no_contacts_mean_nothing_pressed_only_where_touches_are_seen() -> None:
    with FakeSensor("skin") as fake, subscribe("skin", address=fake.address) as frames:
        fake.wait_for_subscriber()
        for flags, words in (([], "nothing pressed"), (["no_reference"], "not known  [no_ref")):
            fake.publish([], flags=flags)
            assert words in frame_line(next(frames))


@pytest.mark.slow
def test_in_a_pipe_it_says_that_nothing_comes(tactomo: Run) -> None:
    with announced(Running("daemon", "", "skin", "ipc:///nowhere/at/all")):
        result = tactomo("watch", "--seconds", "1.5")
    assert (result.returncode, result.stdout) == (0, "")
    assert "no frame of skin" in result.stderr


def test_the_picture_is_the_right_way_up() -> None:
    with FakeSensor("skin") as fake, subscribe("skin", address=fake.address) as frames:
        fake.wait_for_subscriber()
        fake.publish([CONTACT], **images())
        text = map_text(next(frames), {"pressure_max_kpa": 200.0}, 51)
    lines = text.split("\n")
    assert [len(line) for line in lines][:26] == [51] * 26
    cells: dict[tuple[int, int], list[Any]] = {
        (row, column): [tuple(colour.triplet) for colour in colours(span.style)]
        for row, line in enumerate(lines)
        for span in line.spans
        for column in range(span.start, span.end)
    }
    bright = [place for place, pair in cells.items() if any(sum(c) > 500 for c in pair)]
    pressed = [place for place, pair in cells.items() if PRESSED_COLOUR in pair]
    assert bright == [((50 - 10) // 2, 30)]
    assert pressed == [((50 - 40) // 2, 20)]


def colours(style: Any) -> list[Any]:
    """The upper and the lower colour of a half-block."""
    return [style.color, style.bgcolor]
