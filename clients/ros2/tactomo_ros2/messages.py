"""A frame as ROS 2 messages of standard types, for bags and for live publishers alike.

docs/ros2.md has the topics and their frames. Stamps are when the scan was acquired. What is unknown
is NaN, or absent.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore
from tactomo_client import Contact, Frame, Status
from tactomo_client.appearance import surface_nodes, towards
from tactomo_client.schema import PRESSURE_RANGES, Mount, table_row
from tactomo_client.touch import CONTACT_COLUMNS, images_of

TYPES: Final = get_typestore(Stores.ROS2_HUMBLE)
"""Definitions; their hashes are the same up to Kilted and, but for Humble, part of the wire."""
CONTACT_POINT: Final = np.dtype(
    [
        *((axis, "<f4") for axis in "xyz"),
        *(
            (name, {"id": "<u4", "pressure_range": "u1", "taught": "u1"}.get(name, "<f8"))
            for name in CONTACT_COLUMNS
        ),
    ]
)
MAP_POINT: Final = np.dtype(
    [
        *((axis, "<f4") for axis in "xyz"),
        *((name, "<f4") for name in ("pressure_kpa", "sigma_kpa", "magnitude", "structure")),
        ("valid", "u1"),
    ]
)
Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
_POINT_FIELD: Final = {"u1": "UINT8", "u4": "UINT32", "f4": "FLOAT32", "f8": "FLOAT64"}


class RosMessage(NamedTuple):
    """A message as ROS 2 transports and bags carry it."""

    topic: str
    type: str
    cdr: bytes


def topic_types(sensor: str) -> dict[str, str]:
    """Return the type of each topic of a sensor."""
    name = topic_name(sensor)
    return {
        f"/{name}/map": "sensor_msgs/msg/PointCloud2",
        f"/{name}/contacts": "sensor_msgs/msg/PointCloud2",
        f"/{name}/contact_wrenches": "geometry_msgs/msg/WrenchStamped",
        f"/{name}/contact_poses": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    }


def topic_name(sensor: str) -> str:
    """Return a sensor's name as ROS topics may have it: letters, digits and single underscores."""
    name = re.sub(r"[\W_]+", "_", sensor, flags=re.ASCII).strip("_")
    return f"s{name}" if not name or name[0].isdigit() else name


def ros_messages(
    frame: Frame,
    time_ns: int,
    age_s: float | None,
    mount: Mount | None = None,
) -> Iterator[RosMessage]:
    """Yield what a frame says; a frame without images has no map.

    Args:
        frame: the frame.
        time_ns: when it was acquired, ROS time: nanoseconds since 1970.
        age_s: how old it was when it was published; None where nobody knows it.
        mount: the link that carries the sheet, by the sensor's status; None: the map is flat, in
            the sensor's own frame. Contacts know their link themselves.
    """
    types = topic_types(frame.sensor)
    cloud, contacts, wrenches, poses, tf, _ = types
    header = _new("std_msgs/msg/Header", stamp=_stamp(time_ns), frame_id=frame.sensor)
    level = "STALE" if frame.is_stale else "WARN" if frame.flags else "OK"
    told = "stale" if frame.is_stale else ", ".join(sorted(frame.flags)) or "ok"
    yield _diagnostics(frame.sensor, time_ns, told, _trust(frame, age_s), level)
    said: list[tuple[str, Any]] = []
    if (points := _map_points(frame, mount)) is not None:
        said.append((cloud, _cloud(points, header if mount is None else _in(header, mount.frame))))
    of_contacts = _in(header, next((c.frame for c in frame.contacts if c.frame), frame.sensor))
    said.append((contacts, _cloud(_contact_points(frame), of_contacts)))
    for contact in frame.contacts:
        said.append((wrenches, _wrench(frame, contact, header.stamp)))
        said.append((poses, _pose(contact, header)))
    if transforms := _transforms(frame, header):
        said.append((tf, _new("tf2_msgs/msg/TFMessage", transforms=transforms)))
    for topic, message in said:
        yield RosMessage(topic, types[topic], bytes(TYPES.serialize_cdr(message, types[topic])))


def _in(header: Any, frame_id: str) -> Any:
    return _new("std_msgs/msg/Header", stamp=header.stamp, frame_id=frame_id)


def _new(kind: str, **values: Any) -> Any:
    return TYPES.types[kind](**values)


def _stamp(time_ns: int) -> Any:
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    return _new("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def _vector(x: float, y: float, z: float, kind: str = "Vector3") -> Any:
    return _new(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def _cloud(points: NDArray[np.void], header: Any) -> Any:
    """Return points of shape (n,), or (rows, columns) of a sheet, as a cloud."""
    rows, columns = (1, len(points)) if points.ndim == 1 else points.shape
    point_field = TYPES.types["sensor_msgs/msg/PointField"]
    return _new(
        "sensor_msgs/msg/PointCloud2",
        header=header,
        height=rows,
        width=columns,
        fields=[
            point_field(
                name=name,
                offset=offset,
                datatype=getattr(point_field, _POINT_FIELD[kind.str[1:]]),
                count=1,
            )
            for name, (kind, offset, *_) in (points.dtype.fields or {}).items()
        ],
        is_bigendian=False,
        point_step=points.itemsize,
        row_step=columns * points.itemsize,
        data=np.frombuffer(points.tobytes(), np.uint8),
        is_dense="valid" not in (points.dtype.names or ()) or bool(points["valid"].all()),
    )


def _map_points(frame: Frame, mount: Mount | None) -> NDArray[np.void] | None:
    """Return the sheet's nodes, (ny, nx); None for a frame without images."""
    images = images_of(frame)
    shape = next((image.shape for image in images.values() if image is not None), None)
    if shape is None or frame.x_mm is None or frame.y_mm is None:
        return None
    points = np.zeros(shape, MAP_POINT)
    points["x"] = np.linspace(*frame.x_mm, shape[1]) * 1e-3
    points["y"] = np.linspace(*frame.y_mm, shape[0])[:, None] * 1e-3
    for name, image in images.items():
        points[name] = np.nan if image is None else image
    points["sigma_kpa"] = _sigma_kpa(frame, points)
    if mount is not None:
        on_link = surface_nodes(mount.surface_m, shape)
        points["x"], points["y"], points["z"] = np.moveaxis(on_link, -1, 0)
    points["valid"] = np.isfinite(points["pressure_kpa"]) & frame.is_known
    return points


def _sigma_kpa(frame: Frame, points: NDArray[np.void]) -> NDArray[np.float64]:
    """Return for each pressed node the standard uncertainty of its contact's pressure, else NaN.

    A node's contact is the one whose disc of equal area is the nearest.
    """
    sigma = np.full(points.shape, np.nan)
    if frame.contacts:
        x, y, area, of_contact = np.array(
            [(c.x_mm, c.y_mm, c.area_mm2, c.pressure_sigma_kpa) for c in frame.contacts], float
        ).T[..., None, None]
        outside_mm = np.hypot(points["x"] * 1e3 - x, points["y"] * 1e3 - y) - np.sqrt(area / np.pi)
        pressed = points["pressure_kpa"] > 0
        sigma[pressed] = of_contact.ravel()[outside_mm.argmin(axis=0)][pressed]
    return sigma


def _contact_points(frame: Frame) -> NDArray[np.void]:
    points = np.zeros(len(frame.contacts), CONTACT_POINT)
    for point, contact in zip(points, frame.contacts, strict=True):
        cells = table_row(contact)
        for name in CONTACT_COLUMNS:
            value = cells[name]
            if name == "pressure_range":
                value = PRESSURE_RANGES.index(value) if value in PRESSURE_RANGES else 0
            point[name] = np.nan if value is None else value
        _, position, _ = _whereabouts(contact, frame.sensor)
        point["x"], point["y"], point["z"] = position
    return points


def _wrench(frame: Frame, contact: Contact, stamp: Any) -> Any:
    """Return the force on the sheet at a contact's centre: normal to it, into it is negative.

    The sheet feels neither shear nor twist: the other components are 0 and say nothing.
    """
    force_n = np.nan if contact.force_n is None else contact.force_n
    wrench = _new(
        "geometry_msgs/msg/Wrench", force=_vector(0.0, 0.0, -force_n), torque=_vector(0.0, 0.0, 0.0)
    )
    header = _new("std_msgs/msg/Header", stamp=stamp, frame_id=_contact_frame(frame, contact))
    return _new("geometry_msgs/msg/WrenchStamped", header=header, wrench=wrench)


def _pose(contact: Contact, header: Any) -> Any:
    """Return a contact's centre; its z is the sheet's normal there.

    On a mounted sheet the larger one of the centre's two uncertainties stands for both, since a
    contact does not say how the sheet's x lies on the link.
    """
    variances = [
        np.nan if sigma is None else (sigma * 1e-3) ** 2
        for sigma in (contact.x_sigma_mm, contact.y_sigma_mm)
    ]
    covariance = np.zeros((6, 6))
    covariance[[0, 1], [0, 1]] = variances
    if contact.normal is not None:
        tangent = np.eye(3) - np.outer(contact.normal, contact.normal)
        covariance[:3, :3] = np.max(variances) * tangent
    parent, position, (x, y, z, w) = _whereabouts(contact, header.frame_id)
    pose = _new(
        "geometry_msgs/msg/Pose",
        position=_vector(*position, "Point"),
        orientation=_new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
    )
    with_covariance = _new(
        "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance.ravel()
    )
    header = _in(header, parent)
    return _new("geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=with_covariance)


def _transforms(frame: Frame, header: Any) -> list[Any]:
    hung = []
    for contact in frame.contacts:
        parent, position, (x, y, z, w) = _whereabouts(contact, frame.sensor)
        pose = _new(
            "geometry_msgs/msg/Transform",
            translation=_vector(*position),
            rotation=_new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )
        transform = _new(
            "geometry_msgs/msg/TransformStamped",
            header=_in(header, parent),
            child_frame_id=_contact_frame(frame, contact),
            transform=pose,
        )
        hung.append(transform)
    return hung


def _whereabouts(contact: Contact, sensor: str) -> tuple[str, Vector, Quaternion]:
    """Return the frame that a contact is in, its centre in m, and how its own frame is turned."""
    if contact.position_m is None or contact.normal is None or contact.frame is None:
        return sensor, (contact.x_mm * 1e-3, contact.y_mm * 1e-3, 0.0), (0.0, 0.0, 0.0, 1.0)
    return contact.frame, contact.position_m, towards(contact.normal)


def _contact_frame(frame: Frame, contact: Contact) -> str:
    return f"{frame.sensor}/contact_{contact.id}"


def stale_diagnostics(sensor: str, frame: Frame | None, now_ns: int) -> RosMessage:
    """Return that no frame comes; `frame` is the last that came, None where none ever did."""
    known = {} if frame is None else _trust(frame, frame.age_s)
    told = "no frame yet" if frame is None else f"no frame for {frame.age_s:.1f} s"
    return _diagnostics(sensor, now_ns, f"{told}: is the daemon running?", known, "STALE")


def issue_diagnostics(status: Status, now_ns: int) -> RosMessage:
    """Return what the daemon finds wrong, and what to do about it."""
    severities = {issue.severity for issue in status.issues}
    level = "ERROR" if "error" in severities else "WARN" if severities else "OK"
    told = "; ".join(issue.what for issue in status.issues) or status.state
    steps = {issue.what: issue.next_step for issue in status.issues}
    return _diagnostics(status.sensor, now_ns, told, steps, level, ": daemon")


def _trust(frame: Frame, age_s: float | None) -> dict[str, Any]:
    names = (
        *("tier", "tier_reason", "misfit", "confidence", "session", "sequence", "scan_counter"),
        *("acquired_realtime_ns", "acquired_monotonic_ns", "device_us", "delay_ns", "skew_ms"),
    )
    return {
        "is_known": frame.is_known,
        "age_s": age_s,
        "contacts": len(frame.contacts),
        "flags": " ".join(sorted(frame.flags)),
        **{name: getattr(frame, name) for name in names},
    }


def _diagnostics(
    sensor: str, now_ns: int, told: str, known: Mapping[str, Any], level: str, part: str = ""
) -> RosMessage:
    status: Any = TYPES.types["diagnostic_msgs/msg/DiagnosticStatus"]
    values = [
        _new("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
        for key, value in known.items()
        if value is not None
    ]
    one = status(
        level=getattr(status, level),
        name=f"tactomo: {sensor}{part}",
        message=told,
        hardware_id=sensor,
        values=values,
    )
    header = _new("std_msgs/msg/Header", stamp=_stamp(now_ns), frame_id=sensor)
    message = _new("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[one])
    kind = topic_types(sensor)["/diagnostics"]
    return RosMessage("/diagnostics", kind, bytes(TYPES.serialize_cdr(message, kind)))
