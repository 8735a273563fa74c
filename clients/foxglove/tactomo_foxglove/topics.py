"""What is said of a sensor, and on which topics: the bridge says it live, an export to a file.

=====================  ==========================  =================================================
topic                  schema                      what
=====================  ==========================  =================================================
/tf                    foxglove.FrameTransforms    where the sensor hangs
/SENSOR/sheet          foxglove.SceneUpdate        outline and electrodes
/SENSOR/contacts       foxglove.SceneUpdate        a disc for each contact, its height the pressure
/SENSOR/grid           foxglove.Grid               the map: colours, pressure_kpa, magnitude, ...
/SENSOR/image          foxglove.RawImage           the map as a picture
/SENSOR/annotations    foxglove.ImageAnnotations   the contacts on that picture
/SENSOR/frame          tactomo.Frame (JSON)        the numbers: contacts, misfit, flags, timing
/SENSOR/health         tactomo.Health (JSON)       live only: age, rates, latency, staleness
/SENSOR/events         foxglove.Log                live only: the daemon's events
=====================  ==========================  =================================================

What is unknown is left out of the JSON messages. A contact there has a `trace`, which it keeps for
as long as it is followed (`tactomo_client.traces`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, Final

import foxglove
from foxglove import channels
from tactomo_client import Contact, Frame
from tactomo_client.placement import Placement
from tactomo_client.traces import Traces

from tactomo_foxglove import messages
from tactomo_foxglove.messages import contact_numbers, known

_INTEGER: Final = {"type": "integer"}
_NUMBER: Final = {"type": "number"}
_TEXT: Final = {"type": "string"}
_TRUTH: Final = {"type": "boolean"}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _list(of: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": of}


def _numbers(*names: str) -> dict[str, Any]:
    return dict.fromkeys(names, _NUMBER)


CONTACT_SCHEMA: Final = _object(
    **{
        field.name: {"int": _INTEGER, "str": _TEXT, "bool": _TRUTH}.get(str(field.type), _NUMBER)
        for field in fields(Contact)
    },
    trace=_INTEGER,
)
FRAME_SCHEMA: Final = {
    "title": "tactomo.Frame",
    **_object(
        sequence=_INTEGER,
        scan_counter=_INTEGER,
        session=_TEXT,
        tier=_TEXT,
        tier_reason=_TEXT,
        flags=_list(_TEXT),
        flag_count=_INTEGER,
        contact_count=_INTEGER,
        contacts=_list(CONTACT_SCHEMA),
        **_numbers("misfit", "confidence", "age_ms", "delay_ms", "skew_ms", "period_ms"),
        **_numbers("force_n", "pressure_max_kpa"),
        missed_frames=_INTEGER,
    ),
}
_PERCENTILES: Final = _object(**_numbers("p50", "p99"))
HEALTH_SCHEMA: Final = {
    "title": "tactomo.Health",
    **_object(
        state=_TEXT,
        is_stale=_TRUTH,
        tier_requested=_TEXT,
        recording=_TEXT,
        rates=_object(**_numbers("frames_hz", "magnitude_hz", "structure_hz")),
        latency_ms=_PERCENTILES,
        **_numbers("age_s", "uptime_s"),
        **dict.fromkeys(("frames", "dropped_scans", "incomplete_scans", "late_scans"), _INTEGER),
    ),
}


class SensorTopics:
    """One sensor's topics in a context, that is towards a server or into a file.

    Times are nanoseconds since 1970: `log_time_ns` when it is said, None for now.
    """

    def __init__(
        self,
        sensor: str,
        context: foxglove.Context,
        transforms: channels.FrameTransformsChannel,
        placement: Placement,
    ) -> None:
        self.sensor = sensor
        # the sensor, as `status` has it; empty until `sheet` has said it
        self.description: Mapping[str, Any] = {}
        self._placement = placement
        self._last: Frame | None = None
        self._traces = Traces()
        self._transforms = transforms

        def topic(name: str) -> str:
            return f"/{sensor}/{name}"

        self._sheet = channels.SceneUpdateChannel(topic("sheet"), context=context)
        self._contacts = channels.SceneUpdateChannel(topic("contacts"), context=context)
        self._grid = channels.GridChannel(topic("grid"), context=context)
        self._image = channels.RawImageChannel(topic("image"), context=context)
        self._annotations = channels.ImageAnnotationsChannel(topic("annotations"), context=context)
        self._frame = foxglove.Channel(topic("frame"), schema=FRAME_SCHEMA, context=context)
        self._health = foxglove.Channel(topic("health"), schema=HEALTH_SCHEMA, context=context)
        self._events = channels.LogChannel(topic("events"), context=context)

    def sheet(self, description: Mapping[str, Any], time_ns: int) -> None:
        """Say what the sensor is and where it hangs."""
        self.description = description
        self._sheet.log(messages.sheet_scene(self.sensor, description, time_ns), log_time=time_ns)
        self._hang(time_ns)

    def frame(self, frame: Frame, time_ns: int, age_s: float | None) -> None:
        """Say what a frame shows, and its numbers; `age_s` is None where nobody knows it."""
        self._hang(time_ns)
        self._show(frame, time_ns, "")
        numbers = _frame_numbers(frame, self._last, age_s)
        contacts = [{**contact_numbers(c), "trace": n} for c, n in self._traces.of(frame)]
        self._frame.log(numbers | {"contacts": contacts}, log_time=time_ns)
        self._last = frame

    def stale(self, frame: Frame, words: str, time_ns: int) -> None:
        """Show the newest frame as an old one: grey, with `words` over the sheet."""
        self._hang(time_ns)
        self._show(frame, time_ns, words)

    def health(self, fields: Mapping[str, Any], time_ns: int) -> None:
        """Say how the daemon is."""
        self._health.log(dict(fields), log_time=time_ns)

    def event(self, event: Mapping[str, Any], time_ns: int) -> None:
        """Say that something happened."""
        self._events.log(messages.log(self.sensor, event, time_ns), log_time=time_ns)

    def _hang(self, time_ns: int) -> None:
        self._transforms.log(
            messages.transforms(self.sensor, self._placement, time_ns), log_time=time_ns
        )

    def _show(self, frame: Frame, time_ns: int, stale: str) -> None:
        """Draw a frame, as far as anybody looks."""
        drawings: tuple[tuple[Any, Callable[..., Any]], ...] = (
            (self._contacts, messages.contacts_scene),
            (self._grid, messages.grid),
            (self._image, messages.image),
            (self._annotations, messages.image_annotations),
        )
        for channel, draw in drawings:
            if channel.has_sinks() and (drawn := draw(frame, self.description, time_ns, stale)):
                channel.log(drawn, log_time=time_ns)


def _frame_numbers(frame: Frame, last: Frame | None, age_s: float | None) -> dict[str, Any]:
    follows = last is not None and last.session == frame.session
    forces = [c.force_n for c in frame.contacts if c.force_n is not None]
    pressures = [c.pressure_kpa for c in frame.contacts if c.pressure_kpa is not None]
    return known(
        {
            "sequence": frame.sequence,
            "scan_counter": frame.scan_counter,
            "session": frame.session,
            "tier": frame.tier,
            "tier_reason": frame.tier_reason,
            "flags": sorted(frame.flags),
            "flag_count": len(frame.flags),
            "contact_count": len(frame.contacts),
            "misfit": frame.misfit,
            "confidence": frame.confidence,
            "age_ms": None if age_s is None else age_s * 1e3,
            "delay_ms": None if frame.delay_ns is None else frame.delay_ns * 1e-6,
            "skew_ms": frame.skew_ms,
            "period_ms": None
            if last is None or not follows
            else (frame.acquired_monotonic_ns - last.acquired_monotonic_ns) * 1e-6,
            "missed_frames": 0
            if last is None or not follows
            else max(0, frame.sequence - last.sequence - 1),
            "force_n": sum(forces) if forces or not frame.contacts else None,
            "pressure_max_kpa": max(pressures, default=None if frame.contacts else 0.0),
        }.items()
    )
