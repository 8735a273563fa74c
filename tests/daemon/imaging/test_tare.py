"""Taking a reference takes a second of finding out how the sheets are: frames go on meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from daemon_bench import Memory
from tactomo.imaging import imaging
from tactomo_client.messages import array_from_wire
from tactomo_models import Reference
from tactomo_models.commissioning.known_skin import SkinAtStart


def pressed(frame: dict[str, Any]) -> float:
    return float(array_from_wire(frame["map"])[0, 0])


def hold_takes(monkeypatch: pytest.MonkeyPatch, first: Callable[[], object]) -> None:
    """Have `first` be called before it is found out what a reference tells."""
    take = Memory.take

    def held(self: Memory, reference: Reference) -> Any:
        first()
        return take(self, reference)

    monkeypatch.setattr(Memory, "take", held)


@pytest.mark.slow
def test_frames_go_on_against_the_last_reference_until_the_new_one_is_understood(
    bench: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    understood = threading.Event()
    understood.set()
    hold_takes(monkeypatch, lambda: understood.wait(60))
    b = bench().tare()
    understood.clear()
    with ThreadPoolExecutor(1) as terminal:
        answer = terminal.submit(b.ask, "tare")
        b.until(lambda: b.daemon._imaging.taring.is_on)  # the status is stale after a second
        for _ in range(b.daemon.config.tare_scans):
            shown = len(b.step(0.2)["contacts"])
        for _ in range(5):
            assert pressed(b.step(0.2)) > 0.15, "still pressed by the old reference"
        assert not answer.done()
        understood.set()
        assert answer.result(60) == {"scans": 3, "contacts": shown}
    b.listener.wait("event", lambda event: f"shown meanwhile: {shown} contact" in event["detail"])
    b.until(lambda: abs(pressed(b.step(0.2))) < 1e-3)
    assert b.step(0.2)["contacts"] == []
    assert b.ask("status")["dropped_scans"] == 0


def test_it_is_taring_until_the_reference_is_in_force(
    bench: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    use, begun, may_end = Memory.use, threading.Event(), threading.Event()

    def slowly(self: Memory, tare: Any) -> None:
        begun.set()
        may_end.wait(60)
        use(self, tare)

    monkeypatch.setattr(Memory, "use", slowly)
    b = bench()
    b.skin.introduce()
    try:
        b.until(lambda: begun.is_set() or b.skin.scan() is None)
        b.skin.scan()
        assert b.ask("status")["state"] == "taring"
    finally:
        may_end.set()
    b.listener.event("tared")


def test_a_daemon_stops_while_it_finds_out_how_sheets_are(
    bench: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, ended = threading.Event(), threading.Event()

    def find() -> None:
        begun.set()
        ended.wait(60)

    hold_takes(monkeypatch, find)
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


def tare_under(b: Any, load: float, asked: int = 1) -> list[dict[str, Any]]:
    """Ask for tares and send scans of a load until all are answered."""
    with ThreadPoolExecutor(asked) as terminals:
        answers = [terminals.submit(b.ask, "tare") for _ in range(asked)]
        b.until(lambda: b.daemon._imaging.taring.is_on)
        while not all(answer.done() for answer in answers):
            b.step(load)
        return [answer.result() for answer in answers]


def test_a_tare_under_a_press_is_disputed_until_the_skin_is_at_rest(
    bench: Callable[..., Any],
) -> None:
    b = bench().tare()
    assert b.step(0.2)["flags"] == []
    [answer] = tare_under(b, 0.2)
    assert answer["contacts"] == 1
    told = b.listener.event("reference_disputed")
    assert "contact" in told["detail"]
    assert "tactomo tare" in told["next_step"]
    for _ in range(3):
        assert b.step(0.2)["flags"] == ["reference_disputed"]
    released = b.step(0.0)
    b.listener.event("reference_confirmed")
    assert released["flags"] == []
    assert pressed(b.step(0.2)) > 0.09, "measured against the skin at rest again"


def test_a_light_press_is_no_rest_by_the_reference_before_the_tare(
    bench: Callable[..., Any],
) -> None:
    b = bench().tare()
    b.step(0.2)
    tare_under(b, 5e-4)  # 0.05 % of the voltages: 20 times the noise
    assert b.step(5e-4)["flags"] == ["reference_disputed"]
    assert b.step(0.0)["flags"] == []


@pytest.mark.parametrize(
    "found",
    [
        SkinAtStart.KNOWN,
        SkinAtStart.LOADED,
        pytest.param(SkinAtStart.OTHER, marks=pytest.mark.slow),
    ],
)
def test_a_second_tare_with_nothing_shown_settles_it_unless_contacts_explain_it(
    bench: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, found: SkinAtStart
) -> None:
    monkeypatch.setattr(imaging, "skin_at_start", lambda *_: found)
    b = bench().tare()
    b.step(0.2)
    tare_under(b, 0.2)
    b.until(lambda: abs(pressed(b.step(0.2))) < 0.01)
    tare_under(b, 0.2)
    is_disputed = found is SkinAtStart.LOADED
    assert b.step(0.2)["flags"] == ["reference_disputed"] * is_disputed
    assert b.step(0.0)["flags"] == [], "at rest by the reference before both"


def test_who_asks_while_a_reference_is_found_out_about_shares_the_next_one(
    bench: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[int] = []
    understood = threading.Event()
    understood.set()

    def find() -> None:
        found.append(1)
        understood.wait(60)

    hold_takes(monkeypatch, find)
    b = bench().tare()
    understood.clear()
    first = threading.Thread(target=b.ask, args=("tare",))
    first.start()
    b.until(lambda: b.step() and len(found) == 2)
    with ThreadPoolExecutor(6) as terminals:
        answers = []
        for _ in range(6):  # one after the other, with scans enough for a reference each
            answers.append(terminals.submit(b.ask, "tare"))
            for _ in range(5 * b.daemon.config.tare_scans):
                b.step()
        understood.set()
        b.until(lambda: b.step() and all(answer.done() for answer in answers))
        assert {answer.result()["scans"] for answer in answers} == {3}
    first.join()
    assert len(found) <= 4
    b.until(lambda: b.ask("status")["state"] == "running")
