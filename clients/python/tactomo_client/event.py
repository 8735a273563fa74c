"""What happened, as the daemon tells it: an `Event`."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tactomo_client.filled import filled
from tactomo_client.messages import Message


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened, such as ``port_lost``; STREAM.md lists them all.

    Example::

        for event in subscribe("left_forearm", kind="event"):
            if event.severity == "error":
                print(event.name, event.detail, event.next_step)

    """

    sensor: str
    session: str
    """Changes when the daemon restarts; `sequence` starts anew then."""
    sequence: int
    """Counts the events; a gap means that some were missed."""
    name: str
    severity: str = "info"
    """``info``, ``warning`` or ``error``."""
    detail: str = ""
    """What happened, in words."""
    next_step: str = ""
    """What to do about it, in words; may be empty."""
    fields: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)
    """The whole message, as in STREAM.md."""
    _received_ns: int = field(default=0, repr=False, compare=False)
    _stale_after_s: float = field(default=math.inf, repr=False, compare=False)

    @property
    def age_s(self) -> float:
        """Seconds since it came."""
        return (time.monotonic_ns() - self._received_ns) * 1e-9

    @property
    def is_stale(self) -> bool:
        """Whether it came longer ago than the subscription's `stale_after_s`, if it has one."""
        return self.age_s > self._stale_after_s


def event_from_message(message: Message, received_ns: int, stale_after_s: float) -> Event:
    """Return the event in a message that came at `received_ns`, by the monotonic clock.

    Raises:
        MessageError: a field is missing or of the wrong type.

    """
    return filled(
        Event,
        message.fields,
        fields=message.fields,
        _received_ns=received_ns,
        _stale_after_s=stale_after_s,
    )
