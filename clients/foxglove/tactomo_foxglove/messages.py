"""A frame, a sensor, an event as Foxglove's messages: what is drawn, and the numbers to plot.

Lengths are in metres here, as Foxglove wants them. Everything is in the sensor's own frame, named
as the sensor: origin at the sheet's centre, x to the right, y up, z out of the pressed side. Where
the sensor's description has a mount, everything is in the link's frame, on the sheet's surface.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any, Final

import numpy as np
from foxglove import messages as fox
from numpy.typing import NDArray
from tactomo_client import Contact, Frame, appearance
from tactomo_client.touch import images_of

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


def frame_of(sensor: str, description: Mapping[str, Any]) -> str:
    """Return the frame that the sensor is drawn in: its own, or that of the link it is on."""
    return str((description.get("mount") or {"frame": sensor})["frame"])


def transforms(child: str, time_ns: int) -> fox.FrameTransforms:
    """Return that the sensor, or the link that carries it, is at the world's origin."""
    return fox.FrameTransforms(
        transforms=[
            fox.FrameTransform(
                timestamp=to_timestamp(time_ns),
                parent_frame_id="world",
                child_frame_id=child,
                translation=fox.Vector3(),
                rotation=_UPRIGHT,
            )
        ]
    )


def grid(frame: Frame, description: Mapping[str, Any], time_ns: int, stale: str) -> fox.Grid | None:
    """Return the map as a grid: its colours, and the numbers behind them as fields of their own.

    The fields are `pressure_kpa`, `magnitude` (|Δσ|/σ₀) and `structure`, as far as the frame has
    them; NaN where there is no value. None for a frame without images, and for a sheet on a
    surface, which `surface` draws.
    """
    if description.get("mount"):
        return None
    pixels = appearance.map_pixels(frame, description)
    shown = appearance.shown_image(frame, description)
    if pixels is None or shown is None or frame.x_mm is None or frame.y_mm is None:
        return None
    values = known(images_of(frame).items())
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


def surface(
    frame: Frame, description: Mapping[str, Any], time_ns: int, stale: str
) -> fox.SceneUpdate | None:
    """Return the map on the surface that carries the sheet; None for a flat one, or no images."""
    mount = description.get("mount")
    pixels = appearance.map_pixels(frame, description)
    shown = appearance.shown_image(frame, description)
    if not mount or pixels is None or shown is None:
        return None
    rows, columns, _ = pixels.shape
    known = appearance.known_nodes(frame, shown[0])
    node = np.arange(rows * columns).reshape(rows, columns)
    left, right = node[:-1, :-1], node[:-1, 1:]
    below = np.stack([left, right, right + columns], axis=-1)
    above = np.stack([left, right + columns, left + columns], axis=-1)
    corners = np.concatenate([below.reshape(-1, 3), above.reshape(-1, 3)])
    corners = corners[known.ravel()[corners].all(axis=1)]
    points = appearance.surface_nodes(mount["surface_m"], (rows, columns)).reshape(-1, 3)
    colours = _faded(pixels, stale).reshape(-1, 3) / 255
    triangles = fox.TriangleListPrimitive(
        pose=fox.Pose(position=fox.Vector3(), orientation=_UPRIGHT),
        points=[fox.Point3(x=x, y=y, z=z) for x, y, z in points.tolist()],
        colors=[fox.Color(r=r, g=g, b=b, a=1.0) for r, g, b in colours.tolist()],
        indices=corners.ravel().tolist(),
    )
    entity = fox.SceneEntity(
        timestamp=to_timestamp(time_ns),
        frame_id=str(mount["frame"]),
        id="map",
        triangles=[triangles],
    )
    return fox.SceneUpdate(entities=[entity])


def _fields(cells: np.dtype[Any]) -> list[fox.PackedElementField]:
    return [
        fox.PackedElementField(name=name, offset=offset, type=_BYTE if kind == np.uint8 else _FLOAT)
        for name, (kind, offset, *_) in (cells.fields or {}).items()
    ]


def contacts_scene(
    frame: Frame, description: Mapping[str, Any], time_ns: int, stale: str
) -> fox.SceneUpdate:
    """Return the contacts as discs, the higher the harder, with their numbers above them.

    `stale` says in words that this is old; it is shown over the sheet, and all turns grey.
    """
    at = to_timestamp(time_ns)
    everything = fox.SceneEntityDeletion(timestamp=at, type=fox.SceneEntityDeletionType.All)
    entities = []
    for contact in frame.contacts:
        above = _above(contact, disc_height_m(contact, description) + 0.006)
        entities.append(
            fox.SceneEntity(
                timestamp=at,
                frame_id=contact.frame or frame.sensor,
                id=f"contact {contact.id}",
                metadata=_metadata(contact),
                cylinders=[_disc(contact, description, stale)],
                arrows=_force_arrow(contact, description, stale),
                texts=[_text(label(contact), above, GREY if stale else WHITE, 12.0)],
            )
        )
    if stale:
        height_mm = float(description.get("height_mm") or 150.0)
        (point,) = _points(description, np.array([(0.0, 0.6 * height_mm)])).tolist()
        above = _at(point[0], point[1], point[2] + 0.02)
        red = fox.Color(r=1.0, g=0.35, b=0.3, a=1.0)
        words = _text(stale.replace("; ", "\n"), above, red, 16.0)
        entities.append(
            fox.SceneEntity(
                timestamp=at,
                frame_id=frame_of(frame.sensor, description),
                id="stale",
                texts=[words],
            )
        )
    return fox.SceneUpdate(deletions=[everything], entities=entities)


def _disc(contact: Contact, description: Mapping[str, Any], stale: str) -> fox.CylinderPrimitive:
    diameter_m = 2e-3 * math.sqrt(max(contact.area_mm2, 0.0) / math.pi)  # of the same area
    height_m = disc_height_m(contact, description)
    return fox.CylinderPrimitive(
        pose=_above(contact, height_m / 2),
        size=fox.Vector3(x=diameter_m, y=diameter_m, z=height_m),
        bottom_scale=1.0,
        top_scale=1.0,
        color=_disc_colour(contact, description, stale),
    )


def _force_arrow(
    contact: Contact, description: Mapping[str, Any], stale: str
) -> list[fox.ArrowPrimitive]:
    """Return the force on a mounted sheet: from outside to the contact, as long as it is high."""
    if contact.normal is None or contact.force_n is None:
        return []
    length_m = 2 * disc_height_m(contact, description) + 0.01
    inwards = [-part for part in contact.normal]
    # An arrow lies along x: from z to x is a quarter turn about y.
    x, y, z, w = appearance.towards(inwards)
    half = math.sqrt(0.5)
    turned = fox.Quaternion(x=half * (x + z), y=half * (y - w), z=half * (z - x), w=half * (w + y))
    return [
        fox.ArrowPrimitive(
            pose=_above(contact, length_m, turned),
            shaft_length=0.7 * length_m,
            shaft_diameter=0.002,
            head_length=0.3 * length_m,
            head_diameter=0.005,
            color=GREY if stale else WHITE,
        )
    ]


def _above(contact: Contact, height_m: float, turned: fox.Quaternion | None = None) -> fox.Pose:
    """Return the pose of what is at a height above a contact; it stands there if not `turned`."""
    if contact.position_m is None or contact.normal is None:
        return _at(contact.x_mm * 1e-3, contact.y_mm * 1e-3, height_m)
    place = [p + height_m * n for p, n in zip(contact.position_m, contact.normal, strict=True)]
    x, y, z, w = appearance.towards(contact.normal)
    return fox.Pose(
        position=fox.Vector3(x=place[0], y=place[1], z=place[2]),
        orientation=turned or fox.Quaternion(x=x, y=y, z=z, w=w),
    )


def _at(x: float, y: float, z: float) -> fox.Pose:
    return fox.Pose(position=fox.Vector3(x=x, y=y, z=z), orientation=_UPRIGHT)


def _points(description: Mapping[str, Any], xy_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where places (N, 2) of the sheet are, (N, 3) in metres."""
    if not (mount := description.get("mount")):
        return np.column_stack([xy_mm * 1e-3, np.zeros(len(xy_mm))])
    size_mm = (float(description["width_mm"]), float(description["height_mm"]))
    share = np.clip(xy_mm / size_mm + 0.5, 0.0, 1.0)
    return appearance.surface_points(mount["surface_m"], share[:, 0], share[:, 1])


def _text(text: str, pose: fox.Pose, colour: fox.Color, pixels: float) -> fox.TextPrimitive:
    return fox.TextPrimitive(
        pose=pose, billboard=True, font_size=pixels, scale_invariant=True, color=colour, text=text
    )


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
    red, green, blue = (appearance.colours(np.array(level)) / 255).tolist()
    return fox.Color(r=red, g=green, b=blue, a=0.6)


def sheet_scene(sensor: str, description: Mapping[str, Any], time_ns: int) -> fox.SceneUpdate:
    """Return the sensor itself: the sheet's outline, what can be pressed, and its electrodes."""
    white, thin = fox.Color(r=0.9, g=0.9, b=0.9, a=1.0), fox.Color(r=0.6, g=0.6, b=0.6, a=0.7)
    width = float(description["width_mm"])
    lines = [_line(description, ring, white, 2.0) for ring in description.get("outline_mm") or ()]
    if description.get("sensing_outline_mm") != description.get("outline_mm"):
        inner = description.get("sensing_outline_mm") or ()
        lines += [_line(description, ring, thin, 1.0) for ring in inner]
    electrodes = np.array(description.get("electrodes_mm") or []).reshape(-1, 2)
    names = _points(description, electrodes * (1.0 if description.get("mount") else 1.07))
    cubes = [_electrode(_at(*point), width) for point in _points(description, electrodes).tolist()]
    texts = [
        _text(str(number), _at(*point), thin, 11.0) for number, point in enumerate(names.tolist())
    ]
    entity = fox.SceneEntity(
        timestamp=to_timestamp(time_ns),
        frame_id=frame_of(sensor, description),
        id="sheet",
        frame_locked=True,
        lines=lines,
        cubes=cubes,
        texts=texts,
        metadata=[fox.KeyValuePair(key="model", value=str(description.get("model")))],
    )
    return fox.SceneUpdate(entities=[entity])


def _line(
    description: Mapping[str, Any],
    ring_mm: Sequence[Sequence[float]],
    colour: fox.Color,
    pixels: float,
) -> fox.LinePrimitive:
    """Return a closed line, which follows a mounted sheet's surface."""
    corners = np.array(ring_mm, float)
    share = np.linspace(0.0, 1.0, 13 if description.get("mount") else 2)[:-1, None]
    ahead = np.roll(corners, -1, axis=0) - corners
    xy = (corners[:, None] + share * ahead[:, None]).reshape(-1, 2)
    return fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineLoop,
        pose=fox.Pose(position=fox.Vector3(), orientation=_UPRIGHT),
        thickness=pixels,
        scale_invariant=True,
        points=[fox.Point3(x=x, y=y, z=z) for x, y, z in _points(description, xy).tolist()],
        color=colour,
    )


def _electrode(pose: fox.Pose, width_mm: float) -> fox.CubePrimitive:
    side = 0.02 * width_mm * 1e-3
    return fox.CubePrimitive(
        pose=pose,
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
