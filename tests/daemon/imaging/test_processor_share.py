"""Frames get less time while others take the processor, and get it back."""

from __future__ import annotations

from tactomo.imaging.method_in_force import HOLD_S, LEAST, ProcessorShare

FRAME_S = 0.05


class Computer:
    """A computer on which a thread gets a share of a core, and leaves out what it cannot keep."""

    def __init__(self) -> None:
        self.share = ProcessorShare()
        self.now_s = 0.0
        self.dropped = 0

    def run(self, of_core: float, seconds: float, drops: bool) -> list[float]:
        """Return each share of their time that frames were given within so many seconds."""
        given, end_s = [], self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += FRAME_S
            self.dropped += drops
            if self.share.note(of_core * FRAME_S, FRAME_S, self.dropped, self.now_s):
                given.append(self.share.of_work)
        return given


def test_time_is_halved_while_others_take_the_processor_and_scans_are_left_out() -> None:
    assert Computer().run(0.4, 10.0, drops=True) == [1 / 2, 1 / 4, LEAST]


def test_time_is_halved_where_one_frame_waits_for_seconds() -> None:
    share, given = ProcessorShare(), []
    for frame in range(1, 7):
        if share.note(0.05, 1.5, 70 * frame, 1.5 * frame):
            given.append(share.of_work)
    assert given == [1 / 2, 1 / 4, LEAST]


def test_a_busy_processor_alone_takes_no_time_nor_do_lost_scans_alone() -> None:
    assert Computer().run(0.4, 10.0, drops=False) == []
    assert Computer().run(0.95, 10.0, drops=True) == []


def test_what_a_landing_contact_costs_by_itself_takes_no_time() -> None:
    computer = Computer()
    for _ in range(10):
        assert computer.run(0.4, 0.15, drops=True) == []
        assert computer.run(0.4, 0.85, drops=False) == []


def test_time_comes_back_when_nothing_has_been_left_out_for_a_while() -> None:
    computer = Computer()
    computer.run(0.4, 2.2, drops=True)
    assert computer.run(1.0, HOLD_S - 1.5, drops=False) == []
    assert computer.run(1.0, 3 * HOLD_S, drops=False) == [1 / 2, 1.0]


def test_what_was_too_much_is_tried_less_and_less_often() -> None:
    computer = Computer()
    tries = 0
    for _ in range(120):  # seconds: half of the time is kept, all of it is too much
        tries += computer.run(0.4, 1.0, drops=computer.share.of_work == 1).count(1.0)
    assert 3 <= tries <= 6


def test_what_was_left_out_while_nothing_pressed_does_not_count() -> None:
    computer = Computer()
    computer.run(0.4, 3.0, drops=False)
    computer.now_s += 60.0
    computer.dropped += 1000
    assert computer.run(0.4, 3.0, drops=False) == []
