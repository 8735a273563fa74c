"""A press on the virtual skin, from the pseudo-terminal to a subscriber."""

from __future__ import annotations

import math
import time
from itertools import islice

import pytest
from tactomo_client import Frame, request, subscribe
from waiting import PATIENCE_S
from whole_system import SENSOR, Demo

Places = list[tuple[float, float]]

FREE_AGAIN_S = 200.0
"""Until a daemon on a busy computer has tried again what frames with all of their time take."""
SCENES: list[Places] = [
    [(0.0, 0.0)],
    [(52.0, 5.0)],
    [(-10.0, -50.0)],
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


def shared(demo: Demo) -> int:
    """How often others have taken the processor from the daemon."""
    counts = request("status", demo.control, PATIENCE_S)["events"]["counts"]
    return int(counts.get("processor_shared", 0))


def scanned_from_now(demo: Demo) -> None:
    """Wait for a frame of a scan that the twin has yet to take."""
    counter = request("status", demo.twin, PATIENCE_S)["counter"]
    with subscribe(SENSOR, address=demo.stream, timeout_s=PATIENCE_S) as frames:
        next(frame for frame in frames if frame.scan_counter > counter + 1)


@pytest.mark.parametrize("places", SCENES, ids=["centre", "right edge", "bottom edge", "two"])
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


@pytest.mark.slow
def test_a_contact_keeps_its_identity_while_it_slides(any_demo: Demo) -> None:
    any_demo.clear()
    settled_frame(any_demo, [])
    any_demo.press(-20.0, 10.0, id="finger")
    first = settled_frame(any_demo, [(-20.0, 10.0)]).contacts[0]
    with subscribe(SENSOR, address=any_demo.stream, timeout_s=PATIENCE_S) as frames:
        for x_mm in range(-20, 21, 2):
            any_demo.press(float(x_mm), 10.0, id="finger")
            next(frames)
        for frame in islice(frames, 400):
            if is_settled(frame, [(20.0, 10.0)]) and distance_mm(frame, (20.0, 10.0)) < 3:
                break
        else:
            pytest.fail("the contact did not arrive")
    assert [contact.id for contact in frame.contacts] == [first.id]


@pytest.mark.slow
def test_a_lost_channel_is_flagged_and_the_other_goes_on(any_demo: Demo) -> None:
    any_demo.clear()
    settled_frame(any_demo, [])
    any_demo.press(10.0, -10.0)
    is_disturbed = True
    while is_disturbed:  # by others, who take the processor: the network then makes every frame
        settled_frame(any_demo, [(10.0, -10.0)], "fit")
        before = shared(any_demo)
        with subscribe(SENSOR, address=any_demo.stream, timeout_s=PATIENCE_S) as frames:
            next(frames)  # none of what follows is missed
            request("mute", any_demo.twin, PATIENCE_S, channel="structure", seconds=PATIENCE_S)
            missing = (frame for frame in frames if "structure_missing" in frame.flags)
            bridged = next(missing)
            alone = next(frame for frame in missing if frame.tier == "network")
        request("mute", any_demo.twin, PATIENCE_S, channel="structure", seconds=1e-9)  # it is over
        is_disturbed = shared(any_demo) > before
    assert bridged.tier == "fit", "the last shape stands in for a moment"
    for frame in (bridged, alone):
        assert frame.map is not None, "the magnitude channel's image goes on"
        assert frame.structure is None
    settled_frame(any_demo, [(10.0, -10.0)])  # and both again once it is back


@pytest.mark.slow
def test_a_tare_under_load_is_disputed_until_the_skin_is_at_rest(any_demo: Demo) -> None:
    any_demo.clear()
    settled_frame(any_demo, [])
    any_demo.press(0.0, 0.0)
    settled_frame(any_demo, [(0.0, 0.0)])
    request("tare", any_demo.control, timeout_s=PATIENCE_S)
    with subscribe(SENSOR, address=any_demo.stream, timeout_s=PATIENCE_S) as frames:
        disputed = next(frame for frame in frames if "reference_disputed" in frame.flags)
    assert not disputed.contacts
    any_demo.clear()
    settled_frame(any_demo, [])
    any_demo.press(0.0, 0.0)
    settled_frame(any_demo, [(0.0, 0.0)])
