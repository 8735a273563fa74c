"""A frame's scans against the reference: what every method is given."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from tactomo_protocol import Channel

from tactomo_models.scans.changes import Changes
from tactomo_models.scans.companion_forces import CompanionForce, SheetsAndCompanions
from tactomo_models.scans.plausibility import Flag


@dataclass(frozen=True)
class Measurement:
    """One frame's relative voltage changes."""

    #: of each channel that has a usable scan; the others are absent
    changes: Mapping[Channel, Changes]
    flags: Flag = field(default_factory=lambda: Flag(0))  #: what stands in the way of trusting them
    #: those of `flags` that the reference brings along: these scans have nothing to add
    standing_flags: Flag = field(default_factory=lambda: Flag(0))
    #: in words, which electrodes are left out, and which channel's gain is another one
    faults: tuple[str, ...] = ()
    #: seconds spent in each stage of this frame so far
    stage_s: dict[str, float] = field(default_factory=dict)
    may_drift: bool = True  #: whether a drift since the tare may explain what contacts do not
    #: of each companion that has a usable reading
    companions: Mapping[str, CompanionForce] = field(default_factory=dict)
    #: of each whose reading may be of before the sheets last moved
    late_companions: Mapping[str, CompanionForce] = field(default_factory=dict)

    @property
    def data(self) -> Mapping[Channel, Changes]:
        """The changes, with the companions that are fitted beside them."""
        if not self.companions:
            return self.changes
        return SheetsAndCompanions(self.changes, self.companions)

    @property
    def is_quiet(self) -> bool:
        """Whether there is something to see, and nothing presses."""
        return bool(self.changes) and all(each.quiet for each in self.changes.values())

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time spent inside to a stage's seconds."""
        start_s = time.perf_counter()
        yield
        self.stage_s[stage] = self.stage_s.get(stage, 0.0) + time.perf_counter() - start_s
