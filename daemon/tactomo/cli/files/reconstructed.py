"""What `tactomo reconstruct` has made: flags in words, contacts in a table, maps in a picture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from tactomo_client import Contact, Frame
from tactomo_client.appearance import force_words, pressure_words
from tactomo_models import Flag, SensorDescription

from tactomo.cli.console import Console
from tactomo.cli.files.export import ARRAY_COLUMNS
from tactomo.cli.output import say, table
from tactomo.cli.plot.course import telling_moments
from tactomo.imaging.frames import ends_mm
from tactomo.service.health_issues import FLAG_ADVICE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CONTACTS_SHOWN: Final = 12
COLUMNS: Final = tuple(name for name in Contact.__dataclass_fields__ if name != "id")


def print_summary(maps: Path) -> None:
    """Say how many frames have which flag, and list the first contacts."""
    with np.load(maps) as arrays:
        flags, count = arrays["flags"], len(arrays["contact_frame"])
        contacts = _contacts(arrays, range(min(count, CONTACTS_SHOWN)))
    names = [name for value in flags for name in Flag(int(value)).names()]
    for name in sorted(set(names), key=lambda each: -names.count(each)):
        say(
            f"{names.count(name)} of {len(flags)} frames are flagged {name}: {FLAG_ADVICE[name][0]}"
        )
    if not names:
        say("no frame is flagged")
    if not contacts:
        say("no contact is found")
        return
    shown = table("frame", "x mm", "y mm", "area mm²", "pressure", "force")
    for frame, contact in contacts:
        place = (f"{value:.1f}" for value in (contact.x_mm, contact.y_mm, contact.area_mm2))
        shown.add_row(str(frame), *place, pressure_words(contact), force_words(contact))
    Console().print(shown)
    if count > CONTACTS_SHOWN:
        say(f"and {count - CONTACTS_SHOWN} contacts more: contact_* in {maps}")


def draw_methods(made: Mapping[str, Path], sensor: SensorDescription, title: str) -> Figure:
    """Return a picture of the frames that tell most: a row for each method's file."""
    from matplotlib.figure import Figure

    from tactomo.cli.plot.page import STRIP_IN, WIDTH_IN, draw_strip

    with np.load(next(iter(made.values()))) as arrays:
        counts = np.bincount(arrays["contact_frame"], minlength=len(arrays["flags"]))
    pressed = [frozenset(map(str, range(count))) for count in counts.tolist()]
    chosen = telling_moments([float(i) for i in range(len(counts))], pressed)
    figure = Figure(figsize=(WIDTH_IN, STRIP_IN * len(made) + 0.4), layout="constrained")
    figure.suptitle(title, fontsize=12, x=0.01, ha="left", parse_math=False)
    rows: Any = figure.subfigures(len(made), 1, squeeze=False)
    for row, (method, file) in zip(rows[:, 0], made.items(), strict=True):
        titles = [f"{method}, frame {index}" for index in chosen]
        draw_strip(row, _frames(file, chosen, sensor), sensor, titles)
    return figure


def _frames(file: Path, chosen: Sequence[int], sensor: SensorDescription) -> list[Frame]:
    """Return some frames of a file as a stream would have carried them."""
    with np.load(file) as arrays:
        is_chosen = np.isin(arrays["contact_frame"], chosen)
        contacts = _contacts(arrays, np.flatnonzero(is_chosen).tolist())
        images = {name: arrays[name][chosen] for name in ("map", "pressure_kpa", "structure")}
        flags = arrays["flags"][chosen]
    envelope: dict[str, Any] = {
        **{"session": "", "sensor": sensor.name, "sequence": 0},
        **dict.fromkeys(("acquired_realtime_ns", "acquired_monotonic_ns", "age_ns"), 0),
        **dict.fromkeys(("device_us", "skew_ms", "tier", "tier_reason", "misfit")),
        **{"x_mm": tuple(ends_mm(sensor.map_x_m)), "y_mm": tuple(ends_mm(sensor.map_y_m))},
        **{"_age_at_receipt_ns": 0, "_received_ns": None, "_stale_after_s": float("inf")},
    }
    return [
        Frame(
            **envelope,
            **_images_of(images, row),
            scan_counter=index,
            flags=frozenset(Flag(int(flags[row])).names()),
            contacts=tuple(contact for frame, contact in contacts if frame == index),
        )
        for row, index in enumerate(chosen)
    ]


def _images_of(images: Mapping[str, Any], row: int) -> dict[str, Any]:
    """Return a frame's images; None for one that is NaN throughout, which it does not have."""
    own = {name: image[row] for name, image in images.items()}
    return {name: None if np.isnan(image).all() else image for name, image in own.items()}


def _contacts(arrays: Any, rows: Sequence[int]) -> list[tuple[int, Contact]]:
    """Return contacts in some rows, each with its frame, numbered within that from 1."""
    columns = {name: arrays[ARRAY_COLUMNS.get(name, f"contact_{name}")] for name in COLUMNS}
    frames = arrays["contact_frame"]
    found: list[tuple[int, Contact]] = []
    for row in rows:
        values = {name: _known(column[row].tolist()) for name, column in columns.items()}
        first = int(np.searchsorted(frames, frames[row]))  # frames come in their order
        found.append((int(frames[row]), Contact(row - first + 1, **values)))
    return found


def _known(value: Any) -> Any:
    """Return None for NaN, a bound that bounds nothing, and what only a mount has."""
    if isinstance(value, list):
        return tuple(value) if np.isfinite(value).all() else None
    return None if isinstance(value, float) and not math.isfinite(value) else value
