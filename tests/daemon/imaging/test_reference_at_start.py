"""The reference across restarts: what lies on the skin at a start is no bare skin."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixture_types import Start
from tactomo.imaging.kept_reference import reference_path
from tactomo_client.schema import TOUCHES_SEEN
from tactomo_models import Press, SkinSimulator, load_description
from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel

pytestmark = pytest.mark.slow

Volts = Mapping[Channel, FloatArray]
HELD = [Press(x, y, 180.0) for x in (-0.03, 0.03) for y in (-0.03, 0.03)]


@cache
def volts(is_held: bool) -> Volts:
    skin = SkinSimulator(load_description("paper_square"), spacing_m=0.008)  # coarse, but quick
    return skin.voltages(HELD if is_held else [])


@cache
def touched() -> Volts:
    """Beside what is held."""
    skin = SkinSimulator(load_description("paper_square"), spacing_m=0.008)
    return skin.voltages([*HELD, Press(0.0, 0.0, 180.0)])


@pytest.fixture
def begin(bench: Start) -> Callable[..., Any]:
    """Start a daemon that tares on these voltages, or on one after the other of them."""

    def start(*seen: Volts) -> Any:
        b = bench(real=True, tare_scans=max(3, len(seen)))
        b.skin.introduce()
        for index in range(b.daemon.config.tare_scans):
            b.step(volts=seen[index % len(seen)])
        return b

    return start


def once(begin: Callable[..., Any]) -> None:
    """Have a daemon tare on the bare skin and stop."""
    b = begin(volts(False))
    b.listener.event("tared")
    b.daemon.stop()
    assert reference_path("left").exists()


def tare(b: Any, seen: Volts) -> None:
    """Ask for a tare and send scans of these voltages until it is answered."""
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(b.ask, "tare")
        while not answer.done():
            b.step(volts=seen)


def is_known(frame: Mapping[str, Any]) -> bool:
    return TOUCHES_SEEN.issuperset(frame["flags"])


def test_contacts_held_down_through_a_restart_are_still_there(begin: Any) -> None:
    once(begin)
    b = begin(volts(True))
    assert "tactomo tare" in b.listener.event("reference_disputed")["next_step"]
    frame = b.step(volts=volts(True))
    assert len(frame["contacts"]) == 4
    assert "reference_disputed" in frame["flags"]
    assert not is_known(frame)
    released = b.step(volts=volts(False))
    b.listener.event("reference_confirmed")
    assert (released["contacts"], released["flags"]) == ([], [])


def test_a_status_between_the_first_reference_and_its_first_frame_is_of_a_tared_skin(
    begin: Any,
) -> None:
    def told(b: Any) -> str:
        status = b.ask("status")
        return f"{[issue['what'] for issue in status['issues']]} {status['flags']}"

    b = begin(volts(False))
    b.listener.event("tared")  # no scan has come since
    assert "tared" not in told(b)
    assert "no_reference" not in told(b)
    b.daemon.stop()
    b = begin(volts(True))
    b.listener.event("reference_disputed")
    assert "tared" not in told(b)
    assert "no_reference" not in told(b)


def test_tares_under_a_press_are_disputed_until_somebody_touches_beside_it_and_tares(
    begin: Any,
) -> None:
    once(begin)
    kept = reference_path("left").read_bytes()
    b = begin(volts(True))
    b.listener.event("reference_disputed")
    for _ in range(3):  # contacts are shown during the first, none during the others
        tare(b, volts(True))
        frame = b.step(volts=volts(True))
        assert frame["contacts"] == []
        assert "reference_disputed" in frame["flags"]
        assert reference_path("left").read_bytes() == kept
    assert len(b.step(volts=touched())["contacts"]) == 1
    tare(b, volts(True))
    frame = b.step(volts=volts(True))
    assert frame["contacts"] == []
    assert "reference_disputed" not in frame["flags"]
    assert reference_path("left").read_bytes() != kept
    b.daemon.stop()
    again = begin(volts(True))  # it is what the sensor was last known as
    again.listener.event("tared")


def test_a_recording_knows_which_frames_were_disputed(
    begin: Any, replay: Start, tmp_path: Path
) -> None:
    """A tare under a press makes it nothing: in its replay as live, that is not sure."""
    b = begin(volts(False))
    b.listener.event("tared")
    b.step(volts=volts(True))
    b.ask("record_start", path="disputed.mcap")
    first = b.skin.counter + 1
    tare(b, volts(True))
    for is_held in (True, True, False, False):
        b.step(volts=volts(is_held))
    b.ask("record_stop")
    live = {m["scan_counter"]: m for m in b.listener.of("map") if m["scan_counter"] >= first}
    again = {m["scan_counter"]: m for m in replay(tmp_path / "disputed.mcap", real=True).of("map")}
    assert {k: (m["flags"], m["contacts"] == []) for k, m in again.items()} == {
        k: (m["flags"], m["contacts"] == []) for k, m in live.items()
    }
    assert not is_known(live[b.skin.counter - 2])


def test_a_skin_that_has_warmed_since_is_tared_anew(begin: Any) -> None:
    once(begin)
    with np.load(reference_path("left")) as kept:
        arrays = {**kept, "realtime_ns": kept["realtime_ns"] - 3600 * 10**9}
    np.savez(reference_path("left"), **arrays)
    b = begin({name: 0.96 * each for name, each in volts(False).items()})
    b.listener.event("tared")
    assert b.step(volts={n: 0.96 * each for n, each in volts(False).items()})["tier"] == "quiet"


def test_another_skin_is_not_taken_for_a_load(begin: Any) -> None:
    once(begin)
    description = load_description("paper_square")
    other = SkinSimulator(description, 0.008, unevenness=0.03, seed=5).voltages([])
    b = begin(other)
    b.listener.event("skin_changed")
    b.listener.event("tared")
    frame = b.step(volts=other)
    assert (frame["contacts"], frame["flags"]) == ([], [])


@pytest.mark.parametrize("exchanged", [("own-0", "other-1"), ("other-0", "other-1")])
def test_boards_of_another_skin_are_named_at_the_start(
    bench: Start, exchanged: tuple[str, str]
) -> None:
    """Two daemons whose cables were exchanged while they were off: of one sheet, or of both."""

    def start(*device_ids: str) -> Any:
        b = bench(ports=2, baseline={"track": True}, real=True)
        for line, device_id in zip(b.skin.lines, device_ids, strict=True):
            line.hello = replace(line.hello, device_id=device_id)
        b.tare()
        return b

    start("own-0", "own-1").daemon.stop()
    told = start(*exchanged).listener.event("device_changed")
    others = ", ".join(name for name in exchanged if name.startswith("other"))
    assert told["detail"] == f"at the start, {others} instead of own-0, own-1"
    assert "exchange" in told["next_step"]


def test_a_twin_by_another_description_of_the_same_sheet_is_no_exchanged_cable(
    bench: Start,
) -> None:
    for device_id in ("twin-paper_square", "twin-graded_square"):
        b = bench(baseline={"track": True}, real=True)
        b.skin.lines[0].hello = replace(b.skin.lines[0].hello, device_id=device_id)
        b.tare()
        b.daemon.stop()
    assert "device_changed" not in [told["name"] for told in b.listener.of("event")]


def test_where_somebody_moves_at_the_start_the_reference_that_was_kept_is_used(begin: Any) -> None:
    once(begin)
    b = begin(*[volts(False)] * 10, *[volts(True)] * 10)
    assert "moved" in b.listener.event("reference_disputed")["detail"]
    assert len(b.step(volts=volts(True))["contacts"]) == 4


def test_a_damaged_file_is_told_and_does_no_harm(begin: Any) -> None:
    once(begin)
    reference_path("left").write_bytes(b"no archive")
    b = begin(volts(False))
    assert str(reference_path("left")) in b.listener.event("reference_not_kept")["detail"]
    b.listener.event("tared")


def test_where_nobody_can_tell_what_lay_on_the_skin_every_frame_says_so_until_a_tare(
    begin: Any,
) -> None:
    once(begin)
    for _ in range(2):  # what was taken under a load is not kept for the next start
        reference_path("left").write_bytes(b"no archive")
        b = begin(volts(True))
        b.listener.event("tared")
        frame = b.step(volts=volts(True))
        assert "reference_disputed" in frame["flags"]
        assert not is_known(frame)
        b.daemon.stop()
    assert reference_path("left").read_bytes() == b"no archive"
    b = begin(volts(False))
    tare(b, volts(False))
    assert b.step(volts=volts(False))["flags"] == []


def test_a_pipe_in_the_references_place_is_told_and_not_waited_for(begin: Any) -> None:
    path = reference_path("left")
    path.parent.mkdir(parents=True)
    os.mkfifo(path)
    b = begin(volts(False))
    assert "no regular file" in b.listener.event("reference_not_kept")["detail"]
    b.listener.event("tared")
    tare(b, volts(False))
    b.ask("record_start", path="a.mcap")  # by the thread that keeps references
    b.ask("record_stop")
    b.daemon.stop()


def test_a_folder_that_cannot_be_written_is_told(begin: Any) -> None:
    reference_path("left").parent.parent.mkdir(parents=True, exist_ok=True)
    reference_path("left").parent.write_text("a file where the folder should be")
    b = begin(volts(False))
    b.listener.event("reference_not_kept")


@pytest.mark.parametrize("value", [0.0, 2000.0])
def test_where_nothing_can_be_measured_no_contacts_is_not_known(begin: Any, value: float) -> None:
    b = begin(volts(False))
    b.listener.event("tared")
    frame = b.step(volts=dict.fromkeys(volts(False), np.full(208, value)))
    assert frame["contacts"] == []
    assert "no_usable_scan" in frame["flags"]
    assert not is_known(frame)
