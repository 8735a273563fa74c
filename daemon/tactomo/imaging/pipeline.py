"""The pipeline thread: from scans as they arrive to dual scans in order, and those to imaging.

Port threads hand over what they read by a queue. When this thread lags, the newest dual scan wins
and the older ones are counted as dropped, unless every one of them is asked for: then the queue
fills, and the ports wait.

What others want done they ask for through a second queue, so that it happens between two frames.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Final

from tactomo_protocol import Channel, Hello

from tactomo.acquisition.scan_pairer import CounterPairer, RecordPairer, ScanPairer
from tactomo.acquisition.skew import Skew
from tactomo.errors import CommandError
from tactomo.events import OnEvent, RateLimit, Rises, times
from tactomo.imaging.imaging import Imaging
from tactomo.plain import counted
from tactomo.recordings.replay import Replay, ReplayClock
from tactomo.scans import DualScan, PortRead
from tactomo.timing import LATEST_NS, Rate, wall_clock_ns
from tactomo.worker import Worker

JUMP_S: Final = 0.5
"""A time server that corrects less than this does so bit by bit, by at most 0.5 ms a second."""


class WallClock:
    """Compares the wall clock with the monotonic one whenever `check` is called.

    For use by one thread; others may read.
    """

    def __init__(self, on_event: OnEvent) -> None:
        self.jumps = 0  # how often it was set
        # by how much the last time, positive if forwards; None if never
        self.last_jump_s: float | None = None
        self._on_event = on_event
        self._ahead_ns = _ahead_ns()

    def check(self) -> None:
        """Notice a jump since the last call."""
        before_ns, self._ahead_ns = self._ahead_ns, _ahead_ns()
        jump_s = (self._ahead_ns - before_ns) * 1e-9
        if abs(jump_s) < JUMP_S:
            return
        self.jumps += 1
        self.last_jump_s = jump_s
        self._on_event(
            "wall_clock_jumped",
            f"the computer's clock was set {abs(jump_s):.1f} s "
            f"{'ahead' if jump_s > 0 else 'back'}, or the computer slept",
            "nothing, unless you compare dates across it: use monotonic times",
        )


def _ahead_ns() -> int:
    now_ns = wall_clock_ns()
    return now_ns - time.monotonic_ns() if 0 < now_ns < LATEST_NS else now_ns  # stands at the ends


IDLE_S: Final = 0.1
"""How late, at most, a stop or a tare that gives up is noticed."""
QUEUED_DELIVERIES: Final = 256
"""Reads that wait while a frame is made: some 6 s of two ports at 20 Hz."""
QUEUED_OF_REPLAY: Final = 8
"""Likewise of a replay, which waits for frames that take longer, and does not run ahead of them."""
ZERO_PERIOD_S: Final = 10.0
"""How often devices are asked to zero their counters, while that does not bring them in step."""


@dataclass(eq=False)
class Pipeline(Worker):
    """`start` it, `deliver` to it, `stop` it."""

    _imaging: Imaging
    _channels: tuple[Channel, ...]
    _ports: int
    _sync_wait_ns: int
    _is_lossless: bool
    _replay: Replay | None
    _zero_counters: Callable[[], None]
    _on_event: OnEvent

    def __post_init__(self) -> None:
        super().__init__("pipeline")
        self.delivered_ns = 0  # when the newest scan was, monotonic; 0 before the first
        self.incomplete = 0  # dual scans without a channel that had come before, or is lost
        self.scan_rates = {channel: Rate() for channel in self._channels}
        # set while every replayed port is at its end, once what came of it was published
        self.finished = threading.Event()
        replay = self._replay
        self._is_exact = replay is not None and replay.playback.is_exact
        self.sync = self._new_sync()
        self.skew = Skew()
        self.wall_clock = WallClock(self._on_event)
        self._zero_limit = RateLimit(ZERO_PERIOD_S)
        # Scans: each port's thread counts its own; the port threads share a lock for what is
        # discarded because this thread did not come round to it for seconds.
        self._received: list[Counter[Channel]] = [Counter() for _ in range(self._ports)]
        self._discarded: Counter[Channel] = Counter()
        self._joined = self._used = self._left_out = 0
        self._ready: deque[DualScan] = deque()  # to be made into frames now
        self._skipped = 0  # dual scans left out because newer ones had come
        self._has_risen = Rises()
        self._prepared_for: int | None = None  # when the reference of the frames was taken
        self._announced: dict[int, Hello] = {}  # what each port's device says of itself
        self._begun: set[Channel] = set()  # channels that have been in a dual scan
        self._replay_clock = None if replay is None else ReplayClock(self._ports, replay.is_paced)
        self._deliveries: queue.Queue[PortRead | None] = queue.Queue(
            QUEUED_DELIVERIES if replay is None else QUEUED_OF_REPLAY
        )
        self._overflow_lock = threading.Lock()

    @property
    def received(self) -> dict[Channel, int]:
        """How many scans of each channel were delivered; for any thread."""
        return {
            channel: sum(port[channel] for port in self._received) for channel in self._channels
        }

    @property
    def dropped(self) -> int:
        """Dual scans left out because newer ones had come; for any thread."""
        return self._skipped + max(self._discarded.values(), default=0)

    def tally(self) -> dict[str, int]:
        """Return what became of every scan that was delivered; for any thread.

        What is not counted otherwise waits: for its partner, or for its turn.
        """
        gone = self._gone()
        gone["dropped"] += self._discarded.total()
        received = sum(self.received.values())  # last: no more is gone than came
        return {"received": received, **gone, "waiting": received - sum(gone.values())}

    def _gone(self) -> dict[str, int]:
        """Return what became of the scans that were joined and wait no more."""
        sync = self.sync
        return {
            "used": self._used,
            "late": sync.late,
            "repeated": sync.repeated,
            "dropped": self._left_out + sync.unmarked,
        }

    def deliver(self, delivery: PortRead) -> None:
        """Take what a port read; called by port threads. Waits only if nothing may be lost."""
        if delivery.scans:
            self._received[delivery.port].update(scan.channel for scan in delivery.scans)
            self.delivered_ns = time.monotonic_ns()
        while not self._stopping.is_set():
            try:
                self._deliveries.put(delivery, timeout=IDLE_S if self._is_lossless else 0)
                return
            except queue.Full:
                if not self._is_lossless:
                    self._discard_oldest()
                elif not self.is_alive:  # nobody takes more: the daemon ends
                    return

    def tare(self) -> Future[Mapping[str, Any]]:
        """Ask for a new reference; for any thread. The future gets its `scans` and `contacts`.

        Raises:
            CommandError: the references are those of the recording that is replayed.
        """
        if self._is_exact:
            raise CommandError(
                "an exact replay measures against the references that were recorded",
                "tare while you record",
                "tare_refused",
            )
        answer: Future[Mapping[str, Any]] = Future()
        self.ask(lambda: self._imaging.taring.start(answer))
        return answer

    def move(self, position_s: float) -> Future[dict[str, Any]]:
        """Have the replay go on elsewhere; for any thread. The future gets its fields then."""
        return self.ask(lambda: self._move(position_s))

    def step(self) -> None:
        """Have the replay go on by one dual scan; for any thread. The next may be here already."""
        assert self._replay is not None
        self._replay.playback.step()
        self._wake()

    def _run(self) -> None:
        self._begin()
        while not self._stopping.is_set():
            self.turns += 1
            self.wall_clock.check()
            ready = self._gather()
            self._tell_changes()
            self._ready.extend(ready if self._takes_all else self._newest(ready))
            while self._ready and not self._stopping.is_set() and self._is_let_through():
                self.turns += 1
                self._process(self._ready.popleft())
                self._do_asked()
            self._do_asked()
            self._imaging.taring.check()
            if self._replay_clock is not None and self._replay_clock.has_ended and not self._ready:
                if self._replay is not None and self._replay.playback.loops:
                    self._move(0.0)
                elif not self.finished.is_set():
                    self.finished.set()
                    self._on_event("replay_ended", "the recording has ended")
                    self._imaging.tell_status()

    @property
    def _takes_all(self) -> bool:
        playback = None if self._replay is None else self._replay.playback
        return self._is_lossless or (playback is not None and playback.is_paused)

    def _is_let_through(self) -> bool:
        """Whether the next dual scan is made a frame now: ports may run ahead of a step's one."""
        return self._replay is None or self._replay.playback.lets_through()

    def _close(self) -> None:
        self._imaging.taring.close()

    def _new_sync(self) -> ScanPairer:
        replay = self._replay
        if replay is not None and replay.marks:
            return RecordPairer(replay.marks_of_pass())
        return CounterPairer(self._channels, self._sync_wait_ns)

    def _move(self, position_s: float) -> dict[str, Any]:
        """Go on elsewhere: what waits, and what the ports read before they follow, is left out."""
        assert self._replay is not None
        playback = self._replay.playback
        playback.maps_before = self._imaging.maps_published
        moved = playback.move(position_s)
        self._replay_clock = ReplayClock(self._ports, self._replay.is_paced)
        self.finished.clear()
        self._left_out += self._joined - sum(self._gone().values())
        self._ready.clear()
        before, self.sync = self.sync, self._new_sync()
        self.sync.carry_on(before)
        self.skew = Skew()
        self._imaging.forget()
        return moved

    def _process(self, dual: DualScan) -> None:
        recorded = dual.mark.timing if dual.mark is not None else None
        timing = recorded or self.skew.timing(dual)
        self.skew.note(timing)
        self._imaging.process(dual, timing, self.sync.lost)
        if not self._is_lossless:
            self._imaging.share_processor(self.dropped)
        self._used += len(dual.scans)

    def _begin(self) -> None:
        reference = self._replay.reference if self._replay else None
        self.sync = self._new_sync()  # the replay may have been moved since
        if self._is_exact:
            return  # the marks bring their references along
        if reference is None:
            self._imaging.taring.start()
        else:
            self._imaging.use_reference(reference, wall_clock_ns())

    def _gather(self) -> list[DualScan]:
        """Wait for deliveries, for a bounded time; return the dual scans that they complete."""
        ready: list[DualScan] = []
        try:
            delivery = self._deliveries.get(timeout=self._wait_s())
            for _ in range(QUEUED_DELIVERIES):  # what comes meanwhile is for the next turn
                if delivery is not None:
                    ready += self._join(delivery)
                delivery = self._deliveries.get_nowait()
            ready += [] if delivery is None else self._join(delivery)
        except queue.Empty:
            pass
        if self._replay is None:
            ready += self.sync.advance(time.monotonic_ns())
        self.incomplete += sum(map(self._lacks_a_channel, ready))
        return ready

    def _lacks_a_channel(self, dual: DualScan) -> bool:
        """Tell whether one did not come; of two, one begins a little before the other."""
        there = {scan.channel for scan in dual.scans}
        self._begun |= there
        return any(c in self._begun | self.sync.lost for c in self._channels if c not in there)

    def _wait_s(self) -> float:
        deadline_ns = self.sync.deadline_ns
        if deadline_ns is None or self._replay is not None:
            return IDLE_S
        return min(IDLE_S, max(0.0, (deadline_ns - time.monotonic_ns()) * 1e-9))

    def _join(self, delivery: PortRead) -> list[DualScan]:
        ready: list[DualScan] = []
        self._joined += len(delivery.scans)
        if self._replay is not None and delivery.replay_pass != self._replay.playback.passes:
            self._left_out += len(delivery.scans)
            return ready
        self._note_device(delivery)
        for scan in delivery.scans:
            self.scan_rates[scan.channel].add(scan.monotonic_ns)
            self.skew.take(scan)
            ready += self.sync.push(scan)
        clock = self._replay_clock
        if clock is not None:
            now_ns = clock.follow(delivery)
            if clock.has_ended:
                ready += self.sync.finish()
            elif now_ns is not None:
                ready += self.sync.advance(now_ns)
        return ready

    def _note_device(self, delivery: PortRead) -> None:
        """Do not wait for a channel that no device says it sends; a calibration is of a device."""
        if delivery.hello is None or self._announced.get(delivery.port) == delivery.hello:
            return
        self._announced[delivery.port] = delivery.hello
        hellos = self._announced.values()
        self._imaging.calibration.meet({hello.device_id for hello in hellos})
        if len(self._announced) == self._ports:
            announced = {channel for hello in hellos for channel in hello.channels}
            self.sync.lost.update(set(self._channels) - announced)

    def _newest(self, ready: list[DualScan]) -> list[DualScan]:
        self._skipped += max(0, len(ready) - 1)
        self._left_out += sum(len(dual.scans) for dual in ready[:-1])
        taken_ns = self._imaging.taken_ns
        is_prepared = taken_ns == self._prepared_for  # a new reference takes a while
        if ready:
            self._prepared_for = taken_ns
        if self._has_risen("dropped", self.dropped) and is_prepared:
            self._on_event(
                "scans_dropped",
                f"{counted(self.dropped, 'dual scan')} left out since the start",
                "give the daemon more of the processor, or set a faster method or a budget",
            )
        return ready[-1:]

    def _tell_changes(self) -> None:
        now, has_risen = self.sync, self._has_risen
        self._tell_lost()
        if has_risen("resets", now.resets):
            self._on_event(
                "device_restarted",
                "a device was reset: its scan counter and its clock went back; "
                f"{times(now.resets)} since the start",
                "check the device's supply; tare again if the device lost its settings",
            )
        if has_risen("zeroed", now.zeroed):
            self._on_event(
                "counters_zeroed",
                f"the scan counter went back, the clock on; {times(now.zeroed)} since the start",
            )
        if has_risen("disordered", now.disordered):
            self._on_event(
                "scans_disordered",
                f"{now.disordered} scans since the start came after their channel's next ones, and "
                "were left out",
                "have the firmware send each channel's scans in the order of their counter",
            )
        if self.skew.is_skewed:
            self._bring_in_step()
        else:
            self._on_event("channels_in_step", "the same counter is the same instant again")

    def _tell_lost(self) -> None:
        for channel in self._channels:
            if channel in self.sync.lost:
                self._on_event(
                    "channel_lost",
                    f"no {channel} scans in time; maps go on without them",
                    "check that channel's cable; if its scans come late, raise sync_wait_ms",
                    channel,
                )
                continue
            step = (
                ""
                if self._imaging.has_reference(channel)
                else "run `tactomo tare`: the channel has no reference yet"
            )
            self._on_event("channel_back", f"{channel} scans come again", step, channel)

    def _bring_in_step(self) -> None:
        """Have two boards count from 0 again; nothing helps a board that does so by itself."""
        are_two = self._ports > 1 and self._replay is None
        self._on_event(
            "channels_skewed",
            f"the channels' counters are {abs(self.skew.out_of_step_ns) * 1e-6:.0f} ms apart: "
            "the same counter is not the same instant",
            "the boards are asked to zero their counters; should it come again, check the "
            "sync line between them"
            if are_two
            else "correct the firmware: both scans of one counter belong to one instant",
        )
        if are_two and self._zero_limit.allows():
            self._zero_counters()

    def _discard_oldest(self) -> None:
        with self._overflow_lock, contextlib.suppress(queue.Empty):
            oldest = self._deliveries.get_nowait()
            if oldest is not None:
                self._discarded.update(scan.channel for scan in oldest.scans)

    def _wake(self) -> None:
        with contextlib.suppress(queue.Full):  # then it is busy, and looks soon
            self._deliveries.put_nowait(None)
