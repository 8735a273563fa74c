"""Boards that print their readings, from the emulator's pty through a daemon to a controller."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from daemon_process import DaemonProcess
from emulated_board import changed, emulated, frame_where
from tactomo.twin import Twin
from tactomo_client import request
from waiting import PATIENCE_S, wait_until

SINGLE_ENDED = (('"unsigned"', '"signed"'), ('= "pairs"', '= "single_ended"'))
WAITING = (('# start = "y"', 'start = "y"'),)
SIXTEENTHS = (("volts_per_unit = 1.0", "volts_per_unit = 0.0625"),)

Start = Callable[..., tuple[Twin, DaemonProcess]]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start an emulated board and a daemon on it."""
    with ExitStack() as running:
        yield lambda protocol, board, /, **daemon: running.enter_context(
            emulated(tmp_path, board, protocol, daemon=daemon)
        )


def tared(daemon: DaemonProcess) -> None:
    wait_until(lambda: daemon.told("tared"), "a reference")


def press(twin: Twin, x_mm: float, y_mm: float) -> None:
    """Press as large a disc as the coarse map resolves: three of its cells in radius."""
    radius_mm = 15.0
    request("press", twin.control, PATIENCE_S, x_mm=x_mm, y_mm=y_mm, radius_mm=radius_mm)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("protocol", "board", "changes"),
    [
        ("matrix", "matrix_disc", (*WAITING, *SIXTEENTHS)),
        ("openeit", "openeit_disc", ()),
        ("matrix", "matrix_disc", SINGLE_ENDED),
        ("matrix", "matrix_square", ()),
    ],
    ids=["matrix", "openeit", "single-ended", "32 electrodes"],
)
def test_a_press_on_an_emulated_board_is_where_it_is(
    start: Start, tmp_path: Path, protocol: str, board: str, changes: tuple[tuple[str, str], ...]
) -> None:
    twin, daemon = start(protocol, changed(tmp_path, board, *changes))
    tared(daemon)
    press(twin, 18.0, -14.0)
    frame = frame_where(daemon, lambda frame: len(frame.contacts) == 1)
    # A flag comes for a frame or two where others take the processor.
    frame = frame_where(daemon, lambda f: f.sequence > frame.sequence + 5 and not f.flags)
    [contact] = frame.contacts
    assert math.hypot(contact.x_mm - 18.0, contact.y_mm + 14.0) < 2.0
    [port] = daemon.status()["ports"]
    assert port["corrupt"] == 0
