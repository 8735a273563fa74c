"""What happened, as the daemon tells it: an `Event`."""

from __future__ import annotations

from dataclasses import dataclass

from tactomo_client.filled import Received


@dataclass(frozen=True, slots=True)
class Event(Received):
    """Something that happened, such as ``port_lost``; STREAM.md lists them all.

    Example::

        for event in subscribe("left_forearm", kind="event"):
            if event.severity == "error":
                print(event.name, event.detail, event.next_step)
    """

    sensor: str
    session: str  #: changes when the daemon restarts; `sequence` starts anew then
    sequence: int  #: counts the events; a gap means that some were missed
    name: str
    severity: str = "info"  #: ``info``, ``warning`` or ``error``
    detail: str = ""  #: what happened, in words
    next_step: str = ""  #: what to do about it, in words; may be empty
