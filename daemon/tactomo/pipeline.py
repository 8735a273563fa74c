"""The pipeline thread: from scans as they arrive to dual scans in order, and those to imaging.

Port threads hand over what they read by a queue. When this thread lags, the newest dual scan wins
and the older ones are counted as dropped, unless every one of them is asked for: then the queue
fills, and the ports wait.

What others may read here is written by this thread alone; what they want done they ask for through
a second queue, so that it happens between two frames.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Final

from tactomo_models import Reference, Tier
from tactomo_protocol import Channel

from tactomo.errors import CommandError
from tactomo.events import OnEvent, RateLimit
from tactomo.imaging import Imaging
from tactomo.port import Delivery
from tactomo.recording import Mark
from tactomo.sync import DualScan, Joiner, MarkedSync, Sync
from tactomo.timing import Rate

IDLE_S: Final = 0.1
QUEUED_DELIVERIES: Final = 256


@dataclass(frozen=True, slots=True)
class Replay:
    """What a recording tells the pipeline beyond the bytes on the ports."""

    marks: list[Mark]
    """The dual scans to reconstruct; empty where the recording does not say."""
    reference: Reference | None
    """The one in force at its beginning."""
    is_paced: bool
    """Whether bytes come in their own time rather than as fast as they are taken."""


class Pipeline:
    """`start` it, `deliver` to it, `stop` it.

    Args:
        imaging: takes the dual scans; it belongs to this thread from `start` on.
        channels: those that the sensor has.
        ports: how many ports deliver.
        sync_wait_ns: how long a scan waits for its partner.
        lossless: reconstruct every dual scan, however late.
        replay: what the recording says, where the ports replay one.
        on_event: told what happens to scans and channels.

    Attributes:
        dropped: dual scans left out because newer ones had come.
        overflowed: deliveries lost because this thread did not come round to them for seconds;
            written by the port threads under a lock.
        incomplete: dual scans of which one channel did not come.
        scan_rates: how often each channel's scans come.
        finished: set once every replayed port has ended and what came of it was published.
        turns: of the loop, and frames; the watchdog goes by them.

    """

    def __init__(
        self,
        imaging: Imaging,
        channels: tuple[Channel, ...],
        ports: int,
        sync_wait_ns: int,
        lossless: bool,
        replay: Replay | None,
        on_event: OnEvent,
    ) -> None:
        self.dropped = 0
        self.overflowed = 0
        self.incomplete = 0
        self.scan_rates = {channel: Rate() for channel in channels}
        self.finished = threading.Event()
        self.turns = 0
        self._imaging = imaging
        self._channels = channels
        self._ports = ports
        self._replay = replay
        self._is_exact = replay is not None and bool(replay.marks)
        is_unpaced = replay is not None and not replay.is_paced
        self._is_lossless = lossless or self._is_exact or is_unpaced
        self._sync: Joiner = (
            MarkedSync(replay.marks)
            if replay is not None and replay.marks
            else Sync(channels, sync_wait_ns)
        )
        self._on_event = on_event
        self._drop_limit = RateLimit()
        self._dropped_told = 0
        self._is_excused = False  # the dual scans to be dropped next are not worth a warning
        self._announced: dict[int, tuple[Channel, ...]] = {}  # what each port's device sends
        self._clocks: dict[int, int] = {}  # the newest time on each replayed port that goes on
        self._ended: set[int] = set()
        self._deliveries: queue.Queue[Delivery | None] = queue.Queue(QUEUED_DELIVERIES)
        self._commands: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._overflow_lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pipeline")

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread after the frame that it is at."""
        self._stopping.set()
        self._wake()
        if self._thread.is_alive():
            self._thread.join()

    @property
    def is_alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    @property
    def late(self) -> int:
        """Scans dropped because their dual scan had gone on without them."""
        return self._sync.late

    def deliver(self, delivery: Delivery) -> None:
        """Take what a port read; called by port threads. Waits only if nothing may be lost."""
        while not self._stopping.is_set():
            try:
                self._deliveries.put(delivery, timeout=IDLE_S if self._is_lossless else 0)
                return
            except queue.Full:
                if not self._is_lossless:
                    self._discard_oldest()

    def tare(self) -> Future[Mapping[str, Any]]:
        """Ask for a new reference; for any thread. The future gets its `scans`.

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
        self._ask(lambda: self._imaging.start_tare(answer))
        return answer

    def set_tier(self, tier: Tier) -> None:
        """Ask for a tier; for any thread."""
        self._ask(lambda: setattr(self._imaging, "tier", tier))

    def set_budget(self, budget_ms: float | None) -> None:
        """Ask for a time budget; for any thread."""
        self._ask(lambda: setattr(self._imaging, "budget_ms", budget_ms))

    def _run(self) -> None:
        self._begin()
        while not self._stopping.is_set():
            self.turns += 1
            lost, resets = set(self._sync.lost), self._sync.resets
            ready = self._gather()
            self._tell_changes(lost, resets)
            for dual in ready if self._is_lossless else self._newest(ready):
                if self._stopping.is_set():
                    break
                self.turns += 1
                reference = self._imaging.reference
                self._imaging.process(dual, self._sync.lost)
                if self._imaging.reference is not reference:
                    self._is_excused = True
            while not self._commands.empty():
                self._commands.get()()
            self._imaging.check_tare()
            if len(self._ended) == self._ports:
                self.finished.set()

    def _begin(self) -> None:
        reference = self._replay.reference if self._replay else None
        if self._is_exact:
            return  # the marks bring their references along
        if reference is None:
            self._imaging.start_tare()
        else:
            self._imaging.use_reference(reference, time.time_ns())

    def _gather(self) -> list[DualScan]:
        """Wait for deliveries, for a bounded time; return the dual scans that they complete."""
        ready: list[DualScan] = []
        try:
            delivery = self._deliveries.get(timeout=self._wait_s())
            while True:
                if delivery is not None:
                    ready += self._join(delivery)
                delivery = self._deliveries.get_nowait()
        except queue.Empty:
            pass
        if self._replay is None:
            ready += self._sync.advance(time.monotonic_ns())
        self.incomplete += sum(len(dual.scans) < len(self._channels) for dual in ready)
        return ready

    def _wait_s(self) -> float:
        deadline_ns = self._sync.deadline_ns
        if deadline_ns is None or self._replay is not None:
            return IDLE_S
        return min(IDLE_S, max(0.0, (deadline_ns - time.monotonic_ns()) * 1e-9))

    def _join(self, delivery: Delivery) -> list[DualScan]:
        ready: list[DualScan] = []
        self._note_channels(delivery)
        for scan in delivery.scans:
            self.scan_rates[scan.channel].add(scan.monotonic_ns)
            ready += self._sync.push(scan)
        if self._replay is not None:
            ready += self._follow_clock(delivery, self._replay.is_paced)
        return ready

    def _note_channels(self, delivery: Delivery) -> None:
        """Do not wait for a channel that no device says it sends."""
        if delivery.channels is None or self._announced.get(delivery.port) == delivery.channels:
            return
        self._announced[delivery.port] = delivery.channels
        if len(self._announced) == self._ports:
            announced = {c for channels in self._announced.values() for c in channels}
            self._sync.lost.update(set(self._channels) - announced)

    def _follow_clock(self, delivery: Delivery, is_paced: bool) -> list[DualScan]:
        """Let waits end by the recording's clock."""
        if delivery.has_ended:
            self._ended.add(delivery.port)
            self._clocks.pop(delivery.port, None)
        else:
            self._clocks[delivery.port] = delivery.clock_ns
        if len(self._ended) == self._ports:
            return self._sync.finish()
        # Ports that are read as fast as they are taken run ahead of one another: only what the
        # slowest one has passed is over. A port not heard yet is the slowest.
        if is_paced:
            return self._sync.advance(max(self._clocks.values(), default=0))
        if len(self._clocks) + len(self._ended) < self._ports:
            return []
        return self._sync.advance(min(self._clocks.values()))

    def _newest(self, ready: list[DualScan]) -> list[DualScan]:
        self.dropped += max(0, len(ready) - 1)
        if ready and self._is_excused:  # a new reference takes a while to prepare for
            self._is_excused, self._dropped_told = False, self.dropped
        if self.dropped > self._dropped_told and self._drop_limit.allows():
            self._on_event(
                "scans_dropped",
                "warning",
                f"{self.dropped - self._dropped_told} dual scans left out, "
                f"{self.dropped} since the start",
                "give the daemon more of the processor, or set a faster tier or a budget",
            )
            self._dropped_told = self.dropped
        return ready[-1:]

    def _tell_changes(self, lost: set[Channel], resets: int) -> None:
        for channel in sorted(self._sync.lost - lost):
            name = channel.name.lower()
            self._on_event(
                "channel_lost",
                "warning",
                f"no {name} scans in time; maps go on without them",
                "check that channel's cable; if its scans come late, raise sync_wait_ms",
            )
        for channel in sorted(lost - self._sync.lost):
            self._on_event(
                "channel_back",
                "info",
                f"{channel.name.lower()} scans come again",
                "" if self._imaging.has_reference(channel) else "tare: it has no reference yet",
            )
        if self._sync.resets > resets:
            self._on_event(
                "device_restarted",
                "warning",
                "the scan counter went back",
                "tare again if the device lost its settings",
            )

    def _discard_oldest(self) -> None:
        with self._overflow_lock, contextlib.suppress(queue.Empty):
            self._deliveries.get_nowait()
            self.overflowed += 1

    def _ask(self, command: Callable[[], None]) -> None:
        self._commands.put(command)
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(queue.Full):  # then it is busy, and looks soon
            self._deliveries.put_nowait(None)
