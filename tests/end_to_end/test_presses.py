"""A press on the virtual skin, from the pseudo-terminal to a subscriber."""

from __future__ import annotations

import math
import time

import pytest
from tactomo_client import Frame, request, subscribe
from waiting import PATIENCE_S
from whole_system import SENSOR, Demo

Places = list[tuple[float, float]]

FREE_AGAIN_S = 200.0
"""Until a daemon on a busy computer has tried again what frames with all of their time take."""
SCENES: list[Places] = [
    [(0.0, 0.0)],
    [(-30.0, 25.0), (35.0, -20.0)],
]


def distance_mm(frame: Frame, place: tuple[float, float]) -> float:
    return min(
        (math.dist((contact.x_mm, contact.y_mm), place) for contact in frame.contacts),
        default=math.inf,
    )


def is_settled(frame: Frame, places: Places) -> bool:
    return not frame.flags and len(frame.contacts) == len(places)


def settled_frame(demo: Demo, places: Places, tier: str | None = None) -> Frame:
    """First unflagged frame with as many contacts as there are presses, of a tier if one is given.

    Where others take the processor, frames get less time until it is free again.
    """
    deadline = time.monotonic() + (PATIENCE_S if tier is None else FREE_AGAIN_S)
    with subscribe(SENSOR, address=demo.stream, timeout_s=PATIENCE_S) as frames:
        for frame in frames:
            if is_settled(frame, places) and tier in (None, frame.tier):
                return frame
            assert time.monotonic() < deadline, f"{frame.tier} {frame.contacts} {frame.flags}"
    raise AssertionError("the stream ended")


def scanned_from_now(demo: Demo) -> None:
    """Wait for a frame of a scan that the twin has yet to take."""
    counter = request("status", demo.twin, PATIENCE_S)["counter"]
    with subscribe(SENSOR, address=demo.stream, timeout_s=PATIENCE_S) as frames:
        next(frame for frame in frames if frame.scan_counter > counter + 1)


@pytest.mark.parametrize("places", SCENES, ids=["centre", "two"])
def test_every_press_is_found_within_3_mm_with_its_pressure(any_demo: Demo, places: Places) -> None:
    any_demo.clear()
    settled_frame(any_demo, [])
    for number, (x_mm, y_mm) in enumerate(places):
        any_demo.press(x_mm, y_mm, id=str(number), pressure_kpa=180, radius_mm=15)
    frame = settled_frame(any_demo, places, "fit")
    for place in places:
        assert distance_mm(frame, place) < 3.0
    for contact in frame.contacts:
        assert contact.pressure_kpa == pytest.approx(180, abs=20)
        assert contact.area_mm2 == pytest.approx(math.pi * 15**2, rel=0.35)
    assert frame.map is not None
    assert frame.map.shape == (51, 51)
    assert frame.map.max() > 0.1
