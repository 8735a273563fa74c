"""Taking a reference: the mean of some dual scans of the unloaded skin, and their noise.

`Taring` is the pipeline's: it begins tares, gives them up and answers who asked. Somebody who
presses meanwhile would be averaged into the reference, so scans that move while they are collected
are refused. A press that lasts and stays the same cannot be told from a bare skin whose reference
is out of date: whoever tares is told how many contacts were shown meanwhile, and such a reference
is disputed.

A reference tells how the sheets were made, which takes about a second to find. That is done beside
the frames, which are made against the reference before until then.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from tactomo_models import ModelError, Reference
from tactomo_models.arrays import FloatArray
from tactomo_models.scans.companion_forces import CompanionReading
from tactomo_models.scans.tare import Tare
from tactomo_protocol import Channel

from tactomo.errors import CommandError
from tactomo.events import OnEvent
from tactomo.memory import trim_memory
from tactomo.plain import counted
from tactomo.timing import Rate

MOVEMENT_LIMIT: Final = 1e-3
"""Relative change of the voltages, rms, that a skin at rest does not reach within a second."""
SMALLEST_SHARE: Final = 1e-3
"""Voltages below this share of the largest one do not count for more than it when compared."""

NO_DATA_S: Final = 3.0
"""How long a tare on command waits for usable dual scans before it gives up; where they come more
slowly, a few of their periods."""

Volts = FloatArray


@dataclass(eq=False)
class Taring:
    """Takes references for one sensor. For use by the pipeline thread.

    Its own thread finds how sheets were made: it is handed a reference, and hands back a future.
    """

    _scans: int  # dual scans for each reference
    _channels: Collection[Channel]  # those of the sensor
    _frame_rate: Rate  # how often frames come
    _take: Callable[[Reference], Tare]  # finds what a reference tells; for any thread
    # whether frames wait for that, so that each is made against what was taken before
    _waits: bool
    # called with a tare, whether somebody asked for it, and how many contacts were shown meanwhile;
    # returns whether it is in force, and not an older one
    _put_in_force: Callable[[Tare, bool, int], bool]
    # called with why none was taken while there is none; returns whether an older one is in force
    _fall_back: Callable[[str], bool]
    _on_event: OnEvent  # told what a tare became

    def __post_init__(self) -> None:
        self.has_reference = False  # then a tare that is refused is not begun again
        self._tare: _Scans | None = None
        self._deadline_s = 0.0
        # while it is found out what they tell: the next tare waits for it, whoever asks meanwhile
        self._taken: _Scans | None = None
        self._finder = ThreadPoolExecutor(1, "sheets")  # the thread starts with the first tare

    @property
    def is_on(self) -> bool:
        """Whether a reference is being taken; for any thread."""
        return self._tare is not None or self._taken is not None

    def close(self) -> None:
        """Find no more; for any thread, once the pipeline has ended."""
        self._finder.shutdown(cancel_futures=True)

    def start(self, answer: Future[Mapping[str, Any]] | None = None) -> None:
        """Take a reference from the dual scans to come; `answer` gets what it became, or why."""
        self._tare = self._tare or _Scans(self._scans)
        self._put_off()
        if answer is not None:
            self._tare.answers.append(answer)

    def check(self) -> None:
        """Put in force what is ready; give up a tare on command for which nothing comes."""
        if (taken := self._taken) is not None:
            self._put_off()
            if not self._waits and not taken.told.done():
                return
            self._finish(taken)
        if (tare := self._tare) and tare.answers and time.monotonic() > self._deadline_s:
            self._tare = None
            self._refuse(
                tare,
                CommandError(
                    f"no usable dual scan for {self._patience_s:.3g} s",
                    "`tactomo status` shows what the ports say",
                    "no_data",
                ),
            )

    def add(
        self,
        volts: dict[Channel, Volts],
        lost: Collection[Channel],
        contacts: int,
        companions: Collection[CompanionReading] = (),
    ) -> None:
        """Take one dual scan, if a reference is being taken; with enough, put it in force.

        Args:
            volts: (M,) of each channel that is there.
            lost: channels that are not to be expected.
            contacts: how many were shown in this frame.
            companions: their readings, within their limits.
        """
        tare = self._tare
        needed = {channel for channel in self._channels if channel not in lost}
        if tare is None or self._taken or not needed or not needed <= volts.keys():
            return
        self._put_off()
        tare.contacts = max(tare.contacts, contacts)
        if not tare.add(volts, needed, companions):
            return
        self._tare = None
        try:
            reference = tare.reference()
        except CommandError as refusal:
            self._refuse(tare, refusal)
            return
        except ModelError as error:
            self._refuse(tare, _refusal_of(error))
            return
        tare.told = self._finder.submit(self._take, reference)
        self._taken = tare
        self.check()

    def _finish(self, tare: _Scans) -> None:
        contacts = tare.contacts
        try:
            known = tare.told.result()
            is_new = self._put_in_force(known, bool(tare.answers), contacts)
        except ModelError as error:
            self._refuse(tare, _refusal_of(error))
            return
        finally:  # to put it in force takes a while: until then the tare is on
            self._taken = None
        trim_memory()
        if not is_new:
            return
        shown = f"; shown meanwhile: {counted(contacts, 'contact')}" if contacts else ""
        self._on_event("tared", f"{known.reference.scans} dual scans{shown}")
        for answer in tare.answers:  # when all is in force: a status asked for now shows it
            answer.set_result({"scans": known.reference.scans, "contacts": contacts})

    def _refuse(self, tare: _Scans, refusal: CommandError) -> None:
        self._on_event("tare_refused", refusal.cause, refusal.next_step)
        if not self.has_reference and not self._fall_back(refusal.cause):
            self.start()  # without a reference there is nothing else to do
        for answer in tare.answers:
            answer.set_exception(refusal)

    def _put_off(self) -> None:
        self._deadline_s = time.monotonic() + self._patience_s

    @property
    def _patience_s(self) -> float:
        return max(NO_DATA_S, self._frame_rate.pace.few_s)


def _refusal_of(error: ModelError) -> CommandError:
    return CommandError(str(error), "", "tare_refused")


class _Scans:
    """Collects dual scans until there are enough of them."""

    def __init__(self, scans: int) -> None:
        self.answers: list[Future[Mapping[str, Any]]] = []
        self.contacts = 0  # how many were shown meanwhile, at most
        self.told: Future[Tare]  # what their reference tells, once there are enough
        self._wanted = scans
        self._volts: dict[Channel, list[Volts]] = {}
        self._readings: dict[str, list[float]] = {}  # of companions

    def add(
        self,
        volts: dict[Channel, Volts],
        needed: Collection[Channel],
        companions: Collection[CompanionReading],
    ) -> bool:
        """Take one dual scan; returns whether there are enough of every needed channel now."""
        for reading in companions:
            self._readings.setdefault(reading.name, []).append(reading.value)
        for channel, values in volts.items():
            self._volts.setdefault(channel, []).append(values)
        return all(len(self._volts.get(channel, ())) >= self._wanted for channel in needed)

    def reference(self) -> Reference:
        """Return the reference; raise CommandError where the scans moved too much for one."""
        stacks = {
            channel: np.stack(volts)
            for channel, volts in self._volts.items()
            if len(volts) >= self._wanted
        }
        for channel, stack in stacks.items():
            if not np.isfinite(stack).all():
                break  # which `Reference` refuses
            movement, noise = movement_and_noise(stack)
            if movement > max(noise, MOVEMENT_LIMIT):
                raise CommandError(
                    f"the {channel} channel moved by {movement:.2%} meanwhile "
                    f"(its noise is {noise:.2%})",
                    "take the load off the skin, then tare again",
                    "tare_refused",
                )
        sheets = map(stacks.get, (Channel.MAGNITUDE, Channel.STRUCTURE))
        at_rest = tuple((name, float(np.mean(each))) for name, each in self._readings.items())
        return replace(Reference.from_scans(*sheets), companions=at_rest or None)


def movement_and_noise(scans: Volts) -> tuple[float, float]:
    """Tell slow movement from noise in scans (n, M) of one channel, n at least 2.

    Half the mean square of successive differences estimates the noise whether or not there is a
    trend (von Neumann); what the variance has beyond it is movement. Both are relative to the
    voltages, rms over the measurements.
    """
    size = np.abs(scans.mean(axis=0))
    least = max(size.max() * SMALLEST_SHARE, np.finfo(float).tiny)
    relative = scans / np.maximum(size, least)  # small voltages count for no more than larger ones
    noise = 0.5 * np.mean(np.diff(relative, axis=0) ** 2)
    movement = np.mean(relative.var(axis=0, ddof=1)) - noise
    return float(np.sqrt(max(movement, 0.0))), float(np.sqrt(noise))
