"""Playing cases: each method reconstructs them, frame after frame, and is scored.

One frame alone is run to its end, from a cold start, as a file's frames are. Several are followed
as the daemon does, under its budget, with its tares and, where a case says so, its reference that
follows the skin.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from tactomo_models.batch import BUDGET_S
from tactomo_models.drift.baseline import BaselineTracker
from tactomo_models.errors import ModelError
from tactomo_models.physics.artifact import load_or_build_artifact
from tactomo_models.reconstruct import Reconstructor
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.reconstruction import Reconstruction
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel
from threadpoolctl import threadpool_limits

from tactomo_lab.scenes.case import Case, Frame
from tactomo_lab.scenes.measures import Score, score


@dataclass(frozen=True)
class Variant:
    """A method and the compute time that it may take for a frame."""

    method: str  # its name
    # by a model of the work (`field_fit.Budget`); None leaves it to the case
    budget_s: float | None = None

    @property
    def budget_name(self) -> str:
        """The budget in words, "20 ms"; nothing where there is none."""
        if self.budget_s is None:
            return ""
        return f"{self.budget_s * 1e3:g} ms" if self.budget_s < 1 else f"{self.budget_s:g} s"


@dataclass(frozen=True)
class Outcome:
    """A frame of a case, what a variant of a method made of it, and how right that is."""

    variant: Variant
    case: Case
    frame: Frame
    made: Reconstruction
    score: Score

    @property
    def method(self) -> str:
        """The method's name."""
        return self.variant.method


class Player:
    """Reconstructs cases of one sensor, on one thread.

    Raises ModelError where a method is not to be had for the sensor.
    """

    def __init__(self, sensor: SensorDescription, method: str = "auto") -> None:
        self._reconstructor = Reconstructor(sensor, load_or_build_artifact(sensor), method=method)
        self._tare: Reference | None = None
        self._tracker: BaselineTracker | None = None  # of the case that is played, if followed

    def play(self, case: Case, variant: Variant) -> Iterator[Outcome]:
        """Reconstruct and score a case's frames from a cold start.

        Raises ModelError where the method is not to be had for this sensor, or is the user's own
        and failed.
        """
        reconstructor = self._reconstructor
        self._tracker = BaselineTracker(reconstructor) if case.is_followed else None
        if self._tracker is not None or self._tare is not case.tare:
            self._take(case.tare)
        reconstructor.method = variant.method
        own_s = BUDGET_S if case.is_still else None
        reconstructor.budget_s = own_s if variant.budget_s is None else variant.budget_s
        reconstructor.reset()
        identities: dict[str, int] = {}
        for frame in case.frames:
            if frame.tare is not None:
                self._take(frame.tare)
            scans = frame.scans.get(Channel.MAGNITUDE), frame.scans.get(Channel.STRUCTURE)
            with threadpool_limits(1):
                begin_s = time.thread_time()
                if self._tracker is None:
                    made = reconstructor.reconstruct(*scans, companions=frame.companions)
                else:
                    made = self._tracker.reconstruct(frame.time_s, *scans)
                seconds = time.thread_time() - begin_s
            if made.failure:  # the frame is another method's
                raise ModelError(made.failure)
            found = score(case, frame, made, seconds, identities)
            yield Outcome(variant, case, frame, made, found)

    def _take(self, tare: Reference) -> None:
        with threadpool_limits(1):
            use = self._reconstructor.use if self._tracker is None else self._tracker.begin
            use(self._reconstructor.take(tare))
        self._tare = tare


def play(cases: Iterable[Case], *methods: str | Variant) -> Iterator[Outcome]:
    """Reconstruct and score cases, each by one method after the other.

    Args:
        cases: of any sensors.
        *methods: of reconstruction, as `tactomo reconstruct` has them, or variants of such.

    Raises ModelError where a method is not to be had for a sensor, or is the user's own and failed.
    """
    variants = [Variant(m) if isinstance(m, str) else m for m in methods]
    players: dict[SensorDescription, Player] = {}
    for case in cases:
        sensor = case.description
        if case.is_still and sensor not in players:
            players[sensor] = Player(sensor)
            for variant in variants:  # what a method makes once is no part of a frame's time
                deque(players[sensor].play(case, variant), maxlen=0)
        for variant in variants:
            player = players[sensor] if case.is_still else Player(sensor, variant.method)
            yield from player.play(case, variant)
