"""A clock that is set to another century: no thread ends, and messages and recordings are read."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from fixture_types import Start
from tactomo.recordings.recording import open_recording

YEAR_NS = 31_556_952 * 10**9


@pytest.mark.parametrize("years", [274, -100])
@pytest.mark.parametrize("at_start", [True, False], ids=["from the start", "while it runs"])
def test_a_far_date_of_the_computer_ends_no_thread(
    bench: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, years: int, at_start: bool
) -> None:
    now_ns, path = time.time_ns, tmp_path / "far.mcap"

    def far_ns() -> int:
        far = now_ns() + years * YEAR_NS
        if far >= 2**63:
            raise OverflowError("timestamp too large to convert to C _PyTime_t")  # as Python's own
        return far

    def set_clock() -> None:
        monkeypatch.setattr(time, "time_ns", far_ns)

    if at_start:
        set_clock()
    b = bench(recording={"file": path, "maps": True}).tare()
    if not at_start:
        set_clock()
    frames = [b.step() for _ in range(5)]
    assert all(abs(frame["acquired_realtime_ns"]) < 2**63 for frame in frames)
    assert all(0 <= frame["age_ns"] < 60e9 for frame in frames)
    assert bool([e for e in b.listener.of("event") if e["name"] == "wall_clock_jumped"]) != at_start
    b.ask("record_stop")
    assert open_recording(path).summary.frames >= 5
    assert b.ask("status")["events"]["counts"].get("message_unsent", 0) == 0
