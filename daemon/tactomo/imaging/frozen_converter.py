"""A converter that is frozen: its scans repeat earlier ones while their counter goes on.

See `tactomo_models.scans.repeats`. A channel that is frozen all through its first tare cannot be
told from a source without noise.
"""

from __future__ import annotations

from tactomo_models import Reference
from tactomo_models.scans.repeats import Repeats
from tactomo_models.sensor.pattern import Pairs

from tactomo.events import OnEvent
from tactomo.scans import Volts


class FrozenConverters:
    """Leaves out what repeats itself. Belongs to one thread."""

    def __init__(self, pairs: Pairs, on_event: OnEvent) -> None:
        self._on_event = on_event
        self._repeats = Repeats(pairs)

    def forget(self) -> None:
        """Take the next dual scan for the first one."""
        self._repeats.forget()

    def without(self, volts: Volts, reference: Reference | None) -> Volts:
        """What was measured of a dual scan; told when that changes for a channel.

        A channel that repeats itself is left out; voltages of one that does so in part are NaN.
        """
        measured: Volts = {}
        for channel, scan in volts.items():
            found = self._repeats.find(channel, scan, reference)
            if found is None:
                measured[channel] = scan
                continue
            parts, repeated = found
            if repeated.any():
                what = f"{channel} {', '.join(parts) or 'scans'}"
                self._on_event(
                    "converter_frozen",
                    f"{what} repeat earlier ones; maps go on without them",
                    "switch that channel's board off and on; if its scans still repeat, its "
                    "converter or firmware is at fault; if its noise really fell to a tenth, tare",
                    channel,
                )
            else:
                self._on_event("converter_back", f"{channel} scans are measured again", "", channel)
            if (left := found.without(scan)) is not None:
                measured[channel] = left
        return measured
