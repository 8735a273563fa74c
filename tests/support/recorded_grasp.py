"""A recording of a small grasp: two contacts come, one slides, one is too light to be measured."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from frame_fields import frame_fields
from tactomo.recordings.recording import Origin
from tactomo.recordings.recording_writer import RecordingWriter
from tactomo_client import Contact
from tactomo_client.messages import array_to_wire, encode_message
from tactomo_models.arrays import Image

SENSOR = "left"
START_NS = 1_700_000_000_000_000_000
MONOTONIC_NS = 5_000_000_000
PERIOD_NS = 50_000_000
FRAMES = 80
POSITIONS_MM = np.linspace(-75.0, 75.0, 51)
FIRST_PRESSED, LIGHT_FROM, LAST_PRESSED = 20, 40, 70


def contacts_of(number: int) -> list[Contact]:
    """Return what is pressed in a frame, counted from 0."""
    found = []
    if FIRST_PRESSED <= number < LAST_PRESSED:
        pressure = 150.0 + 0.5 * (number - FIRST_PRESSED)
        found.append(
            Contact(
                1,
                x_mm=-30.0 + 0.75 * (number - FIRST_PRESSED),
                y_mm=-20.0,
                area_mm2=700.0,
                magnitude=0.1 + 1e-3 / 3 * number,
                magnitude_sigma=0.005,
                pressure_kpa=pressure,
                x_sigma_mm=0.2,
                y_sigma_mm=0.3,
                area_sigma_mm2=20.0,
                pressure_sigma_kpa=2.5,
                force_n=pressure * 0.7,
                force_sigma_n=2.0,
                pressure_range="within",
            )
        )
    if LIGHT_FROM <= number < LAST_PRESSED:
        found.append(Contact(2, 10.0, 40.0, 350.0, 0.0, 0.004, None, pressure_range="below"))
    return found


def images_of(number: int) -> dict[str, Image | None]:
    """Return the images of a frame; the first ones have none, as before the tare."""
    if number < 5:
        return {"map": None, "pressure_kpa": None, "structure": None}
    x, y = np.meshgrid(POSITIONS_MM, POSITIONS_MM)
    pressure = np.zeros((51, 51), np.float32)
    structure = np.zeros((51, 51), np.float32)
    for contact in contacts_of(number):
        inside = np.hypot(x - contact.x_mm, y - contact.y_mm) < math.sqrt(
            contact.area_mm2 / math.pi
        )
        structure[inside] = 1.0
        pressure[inside] = np.nan if contact.pressure_kpa is None else contact.pressure_kpa
    return {
        "map": np.nan_to_num(pressure) * np.float32(1e-3),
        "pressure_kpa": pressure,
        "structure": structure,
    }


def messages_of(number: int, changes: Mapping[str, Any]) -> list[tuple[str, bytes]]:
    """Return what a daemon publishes for one dual scan, with some fields otherwise."""
    at_ns = START_NS + number * PERIOD_NS
    monotonic_ns = MONOTONIC_NS + number * PERIOD_NS
    contacts = contacts_of(number)
    own: dict[str, Any] = {
        "session": "run",
        "scan_counter": 1000 + number,
        "acquired_realtime_ns": at_ns,
        "tier": "quiet" if not contacts else "fit",
        "flags": ["misfit_high"] if number in (33, 34) else [],
        "misfit": 1.0 + 0.01 * (number % 7),
    }
    fields = frame_fields(number, monotonic_ns, contacts) | own | dict(changes)
    images = {
        name: None if image is None else array_to_wire(image)
        for name, image in images_of(number).items()
    }
    extent = {"x_mm": [-75.0, 75.0], "y_mm": [-75.0, 75.0], "magnitude_max": 0.25}
    return [
        ("map", encode_message(SENSOR, "map", fields | images | extent | dict(changes))),
        ("contacts", encode_message(SENSOR, "contacts", fields)),
    ]


def write_grasp(
    path: Path,
    numbers: Sequence[int] = range(FRAMES),
    change: Callable[[int], Mapping[str, Any]] = lambda _: {},
) -> Path:
    """Write the recording; frames that are left out of `numbers` were lost on the way.

    `change` says of each frame which fields are otherwise.
    """
    writer = RecordingWriter(path, Origin(SENSOR, "paper_square", "ab" * 32, ("/dev/x",), "0.1.0"))
    for number in numbers:
        at_ns = START_NS + number * PERIOD_NS
        for topic, data in [("port/0", b"\0bytes\0"), *messages_of(number, change(number))]:
            writer.write(topic, data, at_ns, at_ns)
    writer.flush()
    writer.close()
    return path
