"""The client in an event loop: the same frames and commands, cancelled and closed at any time."""

from __future__ import annotations

import asyncio
import gc
import socket
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from typing import Any

import pytest
import uvloop
from fake_control import FakeControl
from tactomo_client import Contact, Frame, NoAnswer, StreamTimeout, aio
from tactomo_client.fake import FakeSensor
from waiting import repeated

Run = Callable[[Coroutine[Any, Any, None]], None]
CONTACT = Contact(3, 10.0, -20.0, 700.0, 0.15, 0.01, 170.0)
PATIENCE_S = 30.0


@pytest.fixture(params=["asyncio", "uvloop"])
def run(request: pytest.FixtureRequest) -> Run:
    """Run a coroutine in an event loop of this make; nothing of it may be left open."""
    factory = uvloop.new_event_loop if request.param == "uvloop" else None

    def run_in_loop(main: Coroutine[Any, Any, None]) -> None:
        with asyncio.Runner(loop_factory=factory, debug=True) as runner:
            runner.run(within(main))
        gc.collect()  # what was left open would warn now, and warnings of this kind are errors

    return run_in_loop


async def within(main: Awaitable[None]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        await main


@pytest.fixture
def pressed(sensor: FakeSensor) -> Iterator[FakeSensor]:
    """The sensor, publishing frames from a thread of its own."""
    with repeated(lambda: sensor.publish([CONTACT]), 0.005):
        yield sensor


def test_frames_come_to_several_subscriptions_in_one_loop(run: Run, pressed: FakeSensor) -> None:
    async def collect(kind: Any) -> list[Frame]:
        frames: list[Frame] = []
        async with aio.subscribe("left", address=pressed.address, kind=kind) as skin:
            async for frame in skin:
                frames.append(frame)
                if len(frames) == 20:
                    break
        return frames

    async def main() -> None:
        each = await asyncio.gather(*(collect(kind) for kind in ("map", "contacts") * 3))
        for frames in each:
            assert all(frame.contacts == (CONTACT,) for frame in frames)
            numbers = [frame.sequence for frame in frames]
            assert numbers == list(range(numbers[0], numbers[0] + 20))

    run(main())


def test_a_cancelled_wait_loses_no_frame(run: Run, pressed: FakeSensor) -> None:
    async def main() -> None:
        async with aio.subscribe("left", address=pressed.address) as skin:
            numbers = [(await anext(skin)).sequence]
            cancelled = 0
            while len(numbers) < 40 or not cancelled:
                waiting = asyncio.create_task(skin.wait(PATIENCE_S))
                await asyncio.sleep(0 if len(numbers) % 3 else 0.002)
                waiting.cancel()
                try:
                    frame = await waiting
                except asyncio.CancelledError:
                    cancelled += 1
                    frame = await skin.wait(PATIENCE_S)
                assert frame is not None
                numbers.append(frame.sequence)
            assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
            assert skin.missed == 0

    run(main())


def test_silence_is_an_error_or_none(run: Run, sensor: FakeSensor) -> None:
    async def main() -> None:
        async with aio.subscribe("left", address=sensor.address, timeout_s=0.05) as skin:
            with pytest.raises(StreamTimeout, match=r"no map of sensor 'left'.*tactomo status"):
                await anext(skin)
            assert await skin.wait(0.01) is None
            async with asyncio.timeout(PATIENCE_S):
                with pytest.raises(TimeoutError):
                    async with asyncio.timeout(0.02):
                        await skin.wait(PATIENCE_S)

    run(main())


def test_closing_ends_the_iteration_of_another_task(run: Run, sensor: FakeSensor) -> None:
    async def count(skin: aio.Subscription[Frame]) -> int:
        return len([frame async for frame in skin])

    async def main() -> None:
        skin = aio.subscribe("left", address=sensor.address)
        counting = asyncio.create_task(count(skin))
        await asyncio.to_thread(sensor.wait_for_subscriber)
        await asyncio.sleep(0)  # the other task waits now
        skin.close()
        skin.close()
        assert await counting == 0
        assert await skin.latest() is None

    run(main())


def test_commands_of_several_tasks_are_carried_out_one_by_one(run: Run) -> None:
    answers: dict[str, Any] = {
        "tare": {"scans": 20},
        "set_tier": {"tier": "fit"},
        "status": {"state": "running"},
    }

    async def main() -> None:
        with FakeControl(answers) as control:
            async with aio.Control(control.address, timeout_s=PATIENCE_S) as daemon:
                results = await asyncio.gather(
                    daemon.request("tare"),
                    daemon.request("set_tier", tier="fit"),
                    daemon.request("status"),
                )
            assert list(results) == list(answers.values())
            assert [name for name, _ in control.requests] == list(answers)
            assert await aio.request("tare", control.address, PATIENCE_S) == {"scans": 20}

    run(main())


def test_a_command_that_is_given_up_does_not_spoil_the_next(run: Run) -> None:
    async def main() -> None:
        with FakeControl({"tare": {"scans": 20}}) as control:
            async with aio.Control(control.address) as daemon:
                giving_up = asyncio.create_task(daemon.request("tare", PATIENCE_S))
                await asyncio.sleep(0)
                giving_up.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await giving_up
                assert await daemon.request("tare", PATIENCE_S) == {"scans": 20}

    run(main())


def test_a_client_that_is_closed_gets_no_answer(run: Run) -> None:
    async def main() -> None:
        with socket.create_server(("127.0.0.1", 0)) as silent:
            daemon = aio.Control(f"tcp://127.0.0.1:{silent.getsockname()[1]}")
            waiting = asyncio.create_task(daemon.request("tare", PATIENCE_S))
            await asyncio.sleep(0.1)
            daemon.close()
            with pytest.raises(NoAnswer):
                await waiting

    run(main())
