"""A frame, a sensor, an event as Foxglove's messages: what is drawn, and the numbers to plot.

Lengths are in metres here, as Foxglove wants them. Everything is in the sensor's own frame, named
as the sensor: origin at the sheet's centre, x to the right, y up, z out of the pressed side.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any, Final

import numpy as np
from foxglove import messages as fox
from numpy.typing import NDArray
from tactomo_client import Contact, Frame, appearance
from tactomo_client.appearance import Placement

Pixels = NDArray[np.uint8]

TALLEST: Final = 0.25
"""Height of the disc at the top of the pressure range, as a share of the sheet's width."""
FLAT_M: Final = 0.001  # height of a disc whose pressure is not known
STALE_ALPHA: Final = 0.45
WHITE: Final = fox.Color(r=1.0, g=1.0, b=1.0, a=1.0)
GREY: Final = fox.Color(r=0.55, g=0.55, b=0.55, a=1.0)
LIGHT_TOUCH: Final = fox.Color(r=0.45, g=0.62, b=0.85, a=0.9)
LEVELS: Final = {
    "info": fox.LogLevel.Info,
    "warning": fox.LogLevel.Warning,
    "error": fox.LogLevel.Error,
}

_FLOAT: Final = fox.PackedElementFieldNumericType.Float32
_BYTE: Final = fox.PackedElementFieldNumericType.Uint8
_UPRIGHT: Final = fox.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)


def to_timestamp(time_ns: int) -> fox.Timestamp:
    """Return nanoseconds since 1970 as Foxglove's timestamp."""
    return fox.Timestamp(*divmod(time_ns, 1_000_000_000))


def transforms(sensor: str, placement: Placement, time_ns: int) -> fox.FrameTransforms:
    """Return where the sensor hangs."""
    x, y, z, w = placement.quaternion
    return fox.FrameTransforms(
        transforms=[
            fox.FrameTransform(
                timestamp=to_timestamp(time_ns),
                parent_frame_id=placement.parent,
                child_frame_id=sensor,
                translation=fox.Vector3(x=placement.x_m, y=placement.y_m, z=placement.z_m),
                rotation=fox.Quaternion(x=x, y=y, z=z, w=w),
            )
        ]
    )


def grid(frame: Frame, description: Mapping[str, Any], time_ns: int, stale: str) -> fox.Grid | None:
    """Return the map as a grid: its colours, and the numbers behind them as fields of their own.

    The fields are `pressure_kpa`, `magnitude` (|Δσ|/σ₀) and `structure`, as far as the frame has
    them; NaN where there is no value. None for a frame without images.
    """
    pixels, shown = (
        appearance.map_pixels(frame, description),
        appearance.shown_image(frame, description),
    )
    if pixels is None or shown is None or frame.x_mm is None or frame.y_mm is None:
        return None
    images = [
        ("pressure_kpa", frame.pressure_kpa),
        ("magnitude", frame.map),
        ("structure", frame.structure),
    ]
    values = known(images)
    rows, columns, _ = pixels.shape
    colours = ("red", "green", "blue", "alpha")
    cells = np.zeros((rows, columns), [(n, "u1") for n in colours] + [(n, "<f4") for n in values])
    for number, name in enumerate(colours[:3]):
        cells[name] = _faded(pixels, stale)[..., number]
    cells["alpha"] = np.where(appearance.known_nodes(frame, shown[0]), 255, 0)
    for name, image in values.items():
        cells[name] = image
    (left, right), (bottom, top) = frame.x_mm, frame.y_mm
    dx, dy = (right - left) * 1e-3 / (columns - 1), (top - bottom) * 1e-3 / (rows - 1)
    corner = fox.Vector3(x=left * 1e-3 - dx / 2, y=bottom * 1e-3 - dy / 2, z=0.0)
    return fox.Grid(
        timestamp=to_timestamp(time_ns),
        frame_id=frame.sensor,
        pose=fox.Pose(position=corner, orientation=_UPRIGHT),
        column_count=columns,
        cell_size=fox.Vector2(x=dx, y=dy),
        row_stride=columns * cells.itemsize,
        cell_stride=cells.itemsize,
        fields=_fields(cells.dtype),
        data=cells.tobytes(),
    )


def _fields(cells: np.dtype[Any]) -> list[fox.PackedElementField]:
    return [
        fox.PackedElementField(name=name, offset=offset, type=_BYTE if kind == np.uint8 else _FLOAT)
        for name, (kind, offset, *_) in (cells.fields or {}).items()
    ]


def image(frame: Frame, description: Mapping[str, Any], time_ns: int, stale: str) -> Any:
    """Return the map as a picture for the Image panel, y up; None for a frame without images."""
    pixels = appearance.map_pixels(frame, description)
    if pixels is None:
        return None
    rows, columns, _ = pixels.shape
    return fox.RawImage(
        timestamp=to_timestamp(time_ns),
        frame_id=frame.sensor,
        width=columns,
        height=rows,
        encoding="rgb8",
        step=3 * columns,
        data=np.flipud(_faded(pixels, stale)).tobytes(),
    )


def image_annotations(
    frame: Frame, description: Mapping[str, Any], time_ns: int, stale: str
) -> fox.ImageAnnotations | None:
    """Return the contacts as circles and labels on that picture."""
    shown = appearance.shown_image(frame, description)
    if shown is None or frame.x_mm is None or frame.y_mm is None:
        return None
    at = to_timestamp(time_ns)
    colour = GREY if stale else WHITE
    step_mm = (frame.x_mm[1] - frame.x_mm[0]) / (shown[0].shape[1] - 1)
    circles, texts = [], []
    for contact in frame.contacts:
        x = (contact.x_mm - frame.x_mm[0]) / step_mm + 0.5
        y = (frame.y_mm[1] - contact.y_mm) / step_mm + 0.5
        diameter = contact_diameter_mm(contact) / step_mm
        circles.append(
            fox.CircleAnnotation(
                timestamp=at,
                position=fox.Point2(x=x, y=y),
                diameter=diameter,
                thickness=0.3,
                outline_color=colour,
                metadata=_metadata(contact),
            )
        )
        texts.append(
            fox.TextAnnotation(
                timestamp=at,
                position=fox.Point2(x=x - diameter / 2, y=y - diameter / 2 - 0.5),
                text=label(contact),
                font_size=2.2,
                text_color=colour,
                background_color=fox.Color(r=0.0, g=0.0, b=0.0, a=0.5),
            )
        )
    return fox.ImageAnnotations(timestamp=at, circles=circles, texts=texts)


def contacts_scene(
    frame: Frame, description: Mapping[str, Any], time_ns: int, stale: str
) -> fox.SceneUpdate:
    """Return the contacts as discs, the higher the harder, with their numbers above them.

    `stale` says in words that this is old; it is shown over the sheet, and all turns grey.
    """
    at = to_timestamp(time_ns)
    everything = fox.SceneEntityDeletion(timestamp=at, type=fox.SceneEntityDeletionType.All)
    entities = [
        fox.SceneEntity(
            timestamp=at,
            frame_id=frame.sensor,
            id=f"contact {contact.id}",
            metadata=_metadata(contact),
            cylinders=[_disc(contact, description, stale)],
            texts=[_floating_label(contact, description, stale)],
        )
        for contact in frame.contacts
    ]
    if stale:
        above = _pose(0.0, 0.6 * float(description.get("height_mm") or 150.0), 0.02)
        red = fox.Color(r=1.0, g=0.35, b=0.3, a=1.0)
        words = _text(stale.replace("; ", "\n"), above, red, 16.0)
        entities.append(
            fox.SceneEntity(timestamp=at, frame_id=frame.sensor, id="stale", texts=[words])
        )
    return fox.SceneUpdate(deletions=[everything], entities=entities)


def _disc(contact: Contact, description: Mapping[str, Any], stale: str) -> fox.CylinderPrimitive:
    diameter_m = contact_diameter_mm(contact) * 1e-3
    height_m = disc_height_m(contact, description)
    return fox.CylinderPrimitive(
        pose=_pose(contact.x_mm, contact.y_mm, height_m / 2),
        size=fox.Vector3(x=diameter_m, y=diameter_m, z=height_m),
        bottom_scale=1.0,
        top_scale=1.0,
        color=_disc_colour(contact, description, stale),
    )


def _floating_label(
    contact: Contact, description: Mapping[str, Any], stale: str
) -> fox.TextPrimitive:
    above = _pose(contact.x_mm, contact.y_mm, disc_height_m(contact, description) + 0.006)
    return _text(label(contact), above, GREY if stale else WHITE, 12.0)


def _pose(x_mm: float, y_mm: float, z_m: float) -> fox.Pose:
    return fox.Pose(position=fox.Vector3(x=x_mm * 1e-3, y=y_mm * 1e-3, z=z_m), orientation=_UPRIGHT)


def _text(text: str, pose: fox.Pose, colour: fox.Color, pixels: float) -> fox.TextPrimitive:
    return fox.TextPrimitive(
        pose=pose, billboard=True, font_size=pixels, scale_invariant=True, color=colour, text=text
    )


def contact_diameter_mm(contact: Contact) -> float:
    """Return the diameter of a disc of the contact's area."""
    return 2.0 * math.sqrt(max(contact.area_mm2, 0.0) / math.pi)


def disc_height_m(contact: Contact, description: Mapping[str, Any]) -> float:
    """Return how high a contact's disc is: by its pressure, flat where that is not known."""
    level = _level(contact, description)
    tallest_m = TALLEST * float(description.get("width_mm") or 150.0) * 1e-3
    return FLAT_M if level is None else max(FLAT_M, min(level, 1.2) * tallest_m)


def _level(contact: Contact, description: Mapping[str, Any]) -> float | None:
    """Return how hard is pressed as a share of the range; None where that is not known."""
    if contact.pressure_kpa is not None:
        return contact.pressure_kpa / float(description.get("pressure_max_kpa") or 300.0)
    if contact.magnitude is not None and contact.pressure_range == "unknown":
        return contact.magnitude / float(description.get("magnitude_max") or 0.25)
    return None


def _disc_colour(contact: Contact, description: Mapping[str, Any], stale: str) -> fox.Color:
    if stale:
        return fox.Color(r=0.5, g=0.5, b=0.5, a=STALE_ALPHA)
    level = _level(contact, description)
    if level is None:
        return LIGHT_TOUCH
    at = min(max(level, 0.0), 1.0) * (len(appearance.COLOURS) - 1)
    channels = zip(*appearance.COLOURS, strict=True)
    red, green, blue = (np.interp(at, range(len(appearance.COLOURS)), c) / 255 for c in channels)
    return fox.Color(r=float(red), g=float(green), b=float(blue), a=0.6)


def sheet_scene(sensor: str, description: Mapping[str, Any], time_ns: int) -> fox.SceneUpdate:
    """Return the sensor itself: the sheet's outline, what can be pressed, and its electrodes."""
    white, thin = fox.Color(r=0.9, g=0.9, b=0.9, a=1.0), fox.Color(r=0.6, g=0.6, b=0.6, a=0.7)
    width, height = float(description["width_mm"]), float(description["height_mm"])
    lines = [_outline(description, width, height, white, 2.0)]
    inner = description.get("sensing_width_mm"), description.get("sensing_height_mm")
    if inner[0] and inner[1] and inner != (width, height):
        lines.append(_outline(description, float(inner[0]), float(inner[1]), thin, 1.0))
    cubes, texts = [], []
    for number, (x, y) in enumerate(description.get("electrodes_mm") or []):
        cubes.append(_electrode(x, y, width))
        texts.append(_text(str(number), _pose(1.07 * x, 1.07 * y, 0.0), thin, 11.0))
    entity = fox.SceneEntity(
        timestamp=to_timestamp(time_ns),
        frame_id=sensor,
        id="sheet",
        frame_locked=True,
        lines=lines,
        cubes=cubes,
        texts=texts,
        metadata=[fox.KeyValuePair(key="model", value=str(description.get("model")))],
    )
    return fox.SceneUpdate(entities=[entity])


def _outline(
    description: Mapping[str, Any],
    width_mm: float,
    height_mm: float,
    colour: fox.Color,
    pixels: float,
) -> fox.LinePrimitive:
    if description.get("shape") == "disc":
        turns = np.linspace(0.0, 2.0 * np.pi, 96, endpoint=False)
        xy = np.column_stack([np.cos(turns) * width_mm, np.sin(turns) * height_mm]) / 2
    else:
        xy = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width_mm / 2, height_mm / 2)
    return fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineLoop,
        pose=fox.Pose(position=fox.Vector3(), orientation=_UPRIGHT),
        thickness=pixels,
        scale_invariant=True,
        points=[fox.Point3(x=x, y=y, z=0.0) for x, y in (xy * 1e-3).tolist()],
        color=colour,
    )


def _electrode(x_mm: float, y_mm: float, width_mm: float) -> fox.CubePrimitive:
    side = 0.02 * width_mm * 1e-3
    return fox.CubePrimitive(
        pose=_pose(x_mm, y_mm, 0.0),
        size=fox.Vector3(x=side, y=side, z=side / 2),
        color=fox.Color(r=0.85, g=0.65, b=0.3, a=1.0),
    )


def log(sensor: str, event: Mapping[str, Any], time_ns: int) -> fox.Log:
    """Return an event as a line of the log."""
    words = f"{event['name']}: {event.get('detail') or ''}"
    if event.get("next_step"):
        words += f" -> {event['next_step']}"
    return fox.Log(
        timestamp=to_timestamp(time_ns),
        level=LEVELS.get(str(event.get("severity")), fox.LogLevel.Unknown),
        message=words,
        name=sensor,
        file=str(event["name"]),
    )


def label(contact: Contact) -> str:
    """Return what a contact is, in a few words: identity, pressure, force, place."""
    place = f"({contact.x_mm:.0f}, {contact.y_mm:.0f}) mm"
    force = f"{words} at " if (words := appearance.force_words(contact)) else ""
    return f"{contact.id}: {appearance.pressure_words(contact)}\n{force}{place}"


def _metadata(contact: Contact) -> list[fox.KeyValuePair]:
    return [
        fox.KeyValuePair(key=name, value=f"{value:.6g}" if isinstance(value, float) else str(value))
        for name, value in contact_numbers(contact).items()
    ]


def contact_numbers(contact: Contact) -> dict[str, Any]:
    """Return what is known of a contact; what is unknown is left out."""
    return known((field.name, getattr(contact, field.name)) for field in fields(Contact))


def _faded(pixels: Pixels, stale: str) -> Pixels:
    """Return the colours, or greys of half their brightness for what is old."""
    if not stale:
        return pixels
    grey = pixels.mean(axis=-1, keepdims=True) * 0.5 + 40
    return np.repeat(grey, 3, axis=-1).astype(np.uint8)


def known(fields: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return those whose value is known: Foxglove's JSON schemas have no place for null."""
    return {name: value for name, value in fields if value is not None}
