"""What goes to the page: frames as compact binary messages, everything else as JSON text.

A binary message is one frame: the length of its header (32 bits, little-endian), the header (JSON,
padded with spaces to a multiple of four bytes), then the images' values (float32, little-endian,
row 0 at the bottom), in the order in which the header's `images` names them. `page/link.js` reads
it.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from typing import Any

import numpy as np
from tactomo_client import Frame

IMAGES = ("map", "pressure_kpa", "structure")


def frame_message(frame: Frame) -> bytes:
    """Return the binary message of a frame; its age is the age now."""
    images = {name: image for name in IMAGES if (image := getattr(frame, name)) is not None}
    header = {
        "sent_ms": sent_ms(),
        "age_ms": frame.age_s * 1e3,
        "session": frame.session,
        "sequence": frame.sequence,
        "scan_counter": frame.scan_counter,
        "tier": frame.tier,
        "tier_reason": frame.tier_reason,
        "flags": sorted(frame.flags),
        "misfit": frame.misfit,
        "confidence": frame.confidence,
        "contacts": [dataclasses.asdict(contact) for contact in frame.contacts],
        "x_mm": frame.x_mm,
        "y_mm": frame.y_mm,
        "images": [{"name": name, "shape": image.shape} for name, image in images.items()],
    }
    text = json_text(header).encode()
    text += b" " * (-len(text) % 4)
    values = [np.ascontiguousarray(image, "<f4").tobytes() for image in images.values()]
    return b"".join([len(text).to_bytes(4, "little"), text, *values])


def sent_ms() -> float:
    """Return when a message is sent, in ms of this process's clock, by which a page dates it."""
    return time.monotonic() * 1e3


def json_text(value: Any) -> str:
    """Return `value` as JSON; what JSON cannot say, such as NaN and bytes, becomes null."""
    return json.dumps(_plain(value), ensure_ascii=False, separators=(",", ":"))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, str | int) or value is None else None
