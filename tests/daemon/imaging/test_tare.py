"""Taking a reference takes a second of finding out how the sheets are: frames go on meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from daemon_bench import Memory
from tactomo_client.messages import array_from_wire


def pressed(frame: dict[str, Any]) -> float:
    return float(array_from_wire(frame["map"])[0, 0])


@pytest.mark.slow
def test_frames_go_on_against_the_last_reference_until_the_new_one_is_understood(
    bench: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    understood = threading.Event()
    understood.set()
    monkeypatch.setattr(Memory, "find_sheets", lambda *_: understood.wait(60) and None)
    b = bench()
    b.tare()
    understood.clear()
    with ThreadPoolExecutor(1) as terminal:
        answer = terminal.submit(b.ask, "tare")
        b.until(lambda: b.daemon._imaging.taring.is_on)  # the status is stale after a second
        for _ in range(b.daemon.config.tare_scans):
            b.step(0.2)
        for _ in range(5):
            assert pressed(b.step(0.2)) > 0.15, "still pressed by the old reference"
        assert not answer.done()
        understood.set()
        assert answer.result(60)["contacts"] == 1
    b.until(lambda: abs(pressed(b.step(0.2))) < 0.01)
    assert b.ask("status")["dropped_scans"] == 0


def test_a_daemon_stops_while_it_finds_out_how_sheets_are(
    bench: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, ended = threading.Event(), threading.Event()

    def find(*_: object) -> None:
        begun.set()
        ended.wait(60)

    monkeypatch.setattr(Memory, "find_sheets", find)
    b = bench()
    b.skin.introduce()
    for _ in range(b.daemon.config.tare_scans + 1):
        b.step()
    assert begun.wait(60)
    stopping = threading.Thread(target=b.daemon.stop)
    stopping.start()
    ended.set()
    stopping.join(60)
    assert not stopping.is_alive()
    assert not [t for t in threading.enumerate() if t.name.startswith("sheets")]
