"""What the daemon publishes, as the fields of STREAM.md: SI units in, millimetres and kPa out."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from tactomo_client.messages import array_to_wire
from tactomo_client.schema import Device, wire_fields
from tactomo_models import Contact, Flag, Reconstruction, SensorDescription
from tactomo_models.arrays import FloatArray
from tactomo_models.calibration.calibration_file import PressureCalibration
from tactomo_models.calibration.taught_skin import TaughtSkin
from tactomo_models.sensor.mount import Mount
from tactomo_protocol import Channel, Hello

from tactomo.acquisition.device_clock import DeviceClock
from tactomo.acquisition.port import PortReader
from tactomo.scans import DualScan, Timing
from tactomo.stream.publisher import NO_FRAME_YET

MM_PER_M: Final = 1e3
SURFACE_POINTS: Final = 25
"""Along x and along y, by which a status tells a curved sheet: around a whole cylinder the chords
between are 0.9 % of its radius within. Contacts have places of their own, which are exact."""


def scan_header(dual: DualScan, timing: Timing) -> dict[str, Any]:
    """Return the envelope's part that says when a dual scan was acquired."""
    last = dual.last
    return {
        **NO_FRAME_YET,
        "acquired_realtime_ns": last.realtime_ns - timing.delay_ns,
        "acquired_monotonic_ns": last.monotonic_ns - timing.delay_ns,
        "delay_ns": timing.delay_ns,
        "dated_by": "device" if timing.is_dated else "arrival",
        "device_us": dual.scans[0].device_us,
        "skew_ms": None if timing.skew_ns is None else timing.skew_ns * 1e-6,
        "flags": Flag.CHANNELS_SKEWED.names() if timing.is_skewed else [],
    }


def frame_header(dual: DualScan, timing: Timing, frame: Reconstruction) -> dict[str, Any]:
    """Return the same with what the reconstruction says about itself."""
    flags = frame.flags | (Flag.CHANNELS_SKEWED if timing.is_skewed else Flag(0))
    return {
        **scan_header(dual, timing),
        "tier": str(frame.tier),
        "tier_reason": frame.reason,
        "flags": sorted(flags.names()),
        "misfit": _finite(frame.misfit),
        "confidence": _finite(frame.confidence),
    }


def scan_fields(counter: int, volts: dict[Channel, FloatArray]) -> dict[str, Any]:
    """Return the fields of a `scan` message."""
    return {
        "scan_counter": counter,
        "magnitude": _array(volts.get(Channel.MAGNITUDE)),
        "structure": _array(volts.get(Channel.STRUCTURE)),
    }


def contacts_fields(counter: int, frame: Reconstruction) -> dict[str, Any]:
    """Return the fields of a `contacts` message."""
    return {
        "scan_counter": counter,
        "contacts": [_contact(c) for c in frame.contacts],
        "force_n": _finite(frame.force_n),
        "force_sigma_n": _finite(frame.force_sigma_n),
    }


def map_fields(
    counter: int, frame: Reconstruction, description: SensorDescription
) -> dict[str, Any]:
    """Return the fields of a `map` message."""
    return {
        **contacts_fields(counter, frame),
        "map": _array(frame.map),
        "pressure_kpa": _array(frame.pressure_kpa),
        "structure": _array(frame.structure),
        "x_mm": ends_mm(description.map_x_m),
        "y_mm": ends_mm(description.map_y_m),
        "magnitude_max": magnitude_max(description),
    }


def companion_fields(description: SensorDescription, frame: Reconstruction) -> dict[str, Any]:
    """Return what `status` says of each companion of the sensor, by its name."""
    return {
        name: {
            "state": "missing" if one is None else one.state,
            "reading": one and one.reading,
            "force_n": one and one.force_n,
            "force_sigma_n": one and one.sigma_n,
        }
        for name in description.companion
        for one in (frame.companions.get(name),)
    }


def description_fields(description: SensorDescription) -> dict[str, Any]:
    """Return what `status` says about the sensor."""
    width_m, height_m = description.width_m, description.height_m
    frame_m = 2 * description.sheet.frame_width_m
    return {
        "model": description.name,
        "sha256": description.sha256,
        "shape": description.sheet.shape,
        "width_mm": width_m * MM_PER_M,
        "height_mm": height_m * MM_PER_M,
        "sensing_width_mm": (width_m - frame_m) * MM_PER_M,
        "sensing_height_mm": (height_m - frame_m) * MM_PER_M,
        "outline_mm": _rings_mm(description, 0.0),
        "sensing_outline_mm": _rings_mm(description, description.sheet.frame_width_m),
        "electrodes_mm": (description.electrode_centres_m * MM_PER_M).tolist(),
        "pad_radii_mm": (np.nan_to_num(description.pad_radii_m) * MM_PER_M).tolist(),
        "modalities": list(description.channels),
        "magnitude_max": magnitude_max(description),
        "mount": description.mount and mount_fields(description, description.mount),
    }


def mount_fields(description: SensorDescription, mount: Mount) -> dict[str, Any]:
    """Return what `status` says about the link that carries the sheet, and where it lies."""
    x_m, y_m = (
        np.linspace(-length / 2, length / 2, SURFACE_POINTS)
        for length in (description.width_m, description.height_m)
    )
    places = np.stack(np.meshgrid(x_m, y_m), axis=-1)
    points, _ = mount.place(places.reshape(-1, 2))
    return {
        "frame": mount.frame,
        "kind": mount.kind,
        "surface_m": np.round(points, 6).reshape((*places.shape[:2], 3)).tolist(),
    }


def _rings_mm(description: SensorDescription, inset_m: float) -> list[list[list[float]]]:
    rings = description.sheet.outline.drawn(inset_m)
    return [np.round(ring * MM_PER_M, 3).tolist() for ring in rings]


def pressure_fields(
    description: SensorDescription, calibration: PressureCalibration | None
) -> dict[str, Any]:
    """Return what `status` says about how a change becomes a pressure."""
    response = description.magnitude.response if description.magnitude else None
    if response is None:
        return dict.fromkeys(("pressure_max_kpa", "magnitude_response", "calibration"))
    if calibration is None:
        kpa, change = response.pressure_kpa, response.relative_change
    else:
        kpa = calibration.pressure_kpa
        change = tuple(response.sign * magnitude for magnitude in calibration.magnitude)
    return {
        "pressure_max_kpa": max(kpa),
        "magnitude_response": {"pressure_kpa": list(kpa), "relative_change": list(change)},
        "calibration": calibration and calibration_fields(calibration),
    }


def calibration_fields(calibration: PressureCalibration) -> dict[str, Any]:
    """Return what `status` says about the pressure calibration in force."""
    low, high = calibration.curve.range_kpa
    return {
        "taken": calibration.taken,
        "readings": len(calibration.readings),
        "range_kpa": [low, high],
        "sigma_kpa": float(np.median(calibration.sigma_kpa)),
        "onset_kpa": calibration.onset_kpa,
        "hysteresis_kpa": calibration.hysteresis_kpa,
        "device_ids": list(calibration.subject.device_ids),
    }


def taught_fields(taught: TaughtSkin) -> dict[str, Any]:
    """Return what `status` says about what the skin was taught."""
    return {
        "taken": taught.taken,
        "presses": len(taught.xy_mm),
        "median_mm": taught.with_mm,
        "untaught_median_mm": taught.without_mm,
    }


def port_fields(port: PortReader) -> dict[str, Any]:
    """Return what `status` says about a port."""
    counts = port.protocol.counts
    return {
        "url": port.url,
        "protocol": port.protocol.name,
        "connected": port.is_open,
        "state": port.state,
        "problem": port.problem or None,
        "device": port.hello and device_fields(port.hello),
        "refusal": port.refusal or None,
        "bytes": port.bytes_read,
        "packets": counts.packets,
        "corrupt": counts.damaged,
        "faulty": counts.faulty,
        "unused_scans": port.unused,
        "reopened": port.reopened,
        "latency_timer_ms": port.connection.latency_timer_ms,
        "clock": _clock(port.clock, port.protocol.has_clock),
    }


def device_fields(hello: Hello) -> dict[str, Any]:
    """Return what `status` says about a device."""
    return {name: getattr(hello, name) for name in wire_fields(Device)}


def magnitude_max(description: SensorDescription) -> float | None:
    """Return the top of a sensible colour scale for the map, a ratio."""
    if description.magnitude is None:
        return None
    return max(abs(change) for change in description.magnitude.response.relative_change)


def _clock(clock: DeviceClock, is_there: bool) -> dict[str, Any]:
    line = clock.line
    return {
        "state": str(clock.state) if is_there else "absent",
        "offset_ns": None if line is None else line.lag_ns,
        "rate_ppm": None if line is None else line.rate * 1e6,
        "delay_ms": clock.delays.percentiles_ms(),
        "jumps": clock.jumps,
    }


def _contact(contact: Contact) -> dict[str, Any]:
    fields = {n: _finite(v) if isinstance(v, float) else v for n, v in contact.in_mm().items()}
    if not contact.frame:
        fields |= dict.fromkeys(("position_m", "normal", "frame"))
    return fields


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _array(array: NDArray[Any] | None) -> dict[str, Any] | None:
    return None if array is None else array_to_wire(array)


def ends_mm(positions_m: FloatArray) -> list[float]:
    """Return the first and the last of positions in millimetres, as a `map` message has them."""
    return [float(positions_m[0]) * MM_PER_M, float(positions_m[-1]) * MM_PER_M]
