"""The fields of one frame's message, as a daemon of this version fills them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from tactomo_client import Contact


def frame_fields(
    number: int, at_ns: int, contacts: Sequence[Contact] = (), **changes: Any
) -> dict[str, Any]:
    """Return the fields of frame `number`, acquired at `at_ns` of both clocks; some otherwise."""
    return {
        "session": "a",
        "sequence": number,
        "scan_counter": number,
        "acquired_realtime_ns": at_ns,
        "acquired_monotonic_ns": at_ns,
        "device_us": at_ns // 1000,
        "age_ns": 7_000_000,
        "tier": "fit",
        "tier_reason": None,
        "flags": [],
        "misfit": 1.0,
        "contacts": [dataclasses.asdict(contact) for contact in contacts],
        **changes,
    }
