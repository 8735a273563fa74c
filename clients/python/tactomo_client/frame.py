"""From a message to a `Frame`: its fields, and how old it is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tactomo_client.errors import MessageError
from tactomo_client.filled import filled
from tactomo_client.messages import MAP, Message, clock_id
from tactomo_client.schema import Contacts, Frame, wire_fields

_IMAGES = dict.fromkeys(set(wire_fields(Frame)) - set(wire_fields(Contacts)))


def frame_from_message(message: Message, received_ns: int | None, stale_after_s: float) -> Frame:
    """Return the frame in a `map` or `contacts` message.

    Args:
        message: the message.
        received_ns: when it came, by the monotonic clock; None for one that was recorded.
        stale_after_s: the age in seconds from which the frame is stale.

    Raises:
        MessageError: a field is missing or of the wrong type.
    """
    fields = message.fields
    has_images = message.kind == MAP
    frame = filled(
        Frame,
        fields,
        _age_at_receipt_ns=age_at_receipt_ns(fields, received_ns),
        _received_ns=received_ns,
        _stale_after_s=stale_after_s,
        **({} if has_images else _IMAGES),
    )
    if has_images and (frame.x_mm is None or frame.y_mm is None):
        raise MessageError("field 'x_mm' or 'y_mm' is missing")
    return frame


def age_at_receipt_ns(fields: dict[str, Any], received_ns: int | None) -> int:
    """Return the age in ns of a message that came at `received_ns` (monotonic; None: recorded).

    Exact where publisher and subscriber read the same clock; otherwise the age at publication,
    which leaves out the time that the message was on its way.
    """
    acquired_ns: int | None = fields["acquired_monotonic_ns"]
    age_at_publication_ns: int | None = fields["age_ns"]
    if received_ns is not None and acquired_ns is not None and is_our_clock(fields):
        return max(0, received_ns - acquired_ns)
    return max(0, age_at_publication_ns or 0)


def is_our_clock(fields: Mapping[str, Any]) -> bool:
    """Whether a message was stamped by this computer's monotonic clock."""
    return bool(clock_id()) and fields.get("clock_id") == clock_id()
