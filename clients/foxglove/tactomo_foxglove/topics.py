"""What is said of a sensor, and on which topics: the bridge says it live, an export to a file.

docs/see_and_keep.md has the topics. What is unknown is left out of the JSON messages. A contact
there has a `trace`, which it keeps for as long as it is followed (`tactomo_client.touch`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from importlib import resources
from typing import IO, Any, Final

import foxglove
from foxglove import channels
from foxglove.channels import FrameTransformsChannel
from foxglove.mcap import MCAPWriteOptions
from tactomo_client import Contact, Frame
from tactomo_client.schema import wire_fields
from tactomo_client.touch import Traces

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


_JSON: Final = {
    **{"int": _INTEGER, "Unsigned": _INTEGER, "str": _TEXT, "bool": _TRUTH},
    "tuple[float, float, float]": _list(_NUMBER),
    "frozenset[str]": _list(_TEXT),
}
FRAME_NUMBERS: Final = (
    *("sequence", "scan_counter", "session", "tier", "tier_reason", "flags", "misfit"),
    *("confidence", "skew_ms", "force_n"),
)


def _fields(kind: type, *names: str) -> dict[str, Any]:
    """Return JSON's types of a part of a message, or of some of its fields, by `schema`."""
    known_types = kind.__dataclass_fields__  # type: ignore[attr-defined]
    types = {name: str(known_types[name].type) for name in names or wire_fields(kind)}
    return {name: _JSON.get(of.removesuffix(" | None"), _NUMBER) for name, of in types.items()}


FRAME_SCHEMA: Final = {
    "title": "tactomo.Frame",
    **_object(
        **_fields(Frame, *FRAME_NUMBERS),
        **dict.fromkeys(("flag_count", "contact_count", "missed_frames"), _INTEGER),
        **dict.fromkeys(("age_ms", "delay_ms", "period_ms", "pressure_max_kpa"), _NUMBER),
        contacts=_list(_object(**_fields(Contact), trace=_INTEGER)),
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
    ) -> None:
        self.sensor = sensor
        # the sensor, as `status` has it; empty until `sheet` has said it
        self.description: Mapping[str, Any] = {}
        self._last: Frame | None = None
        self._traces = Traces()
        self._transforms = transforms

        def topic(name: str) -> str:
            return f"/{sensor}/{name}"

        self._sheet = channels.SceneUpdateChannel(topic("sheet"), context=context)
        self._contacts = channels.SceneUpdateChannel(topic("contacts"), context=context)
        self._surface = channels.SceneUpdateChannel(topic("surface"), context=context)
        self._grid = channels.GridChannel(topic("grid"), context=context)
        self._frame = foxglove.Channel(topic("frame"), schema=FRAME_SCHEMA, context=context)
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

    def event(self, event: Mapping[str, Any], time_ns: int) -> None:
        """Say that something happened."""
        self._events.log(messages.log(self.sensor, event, time_ns), log_time=time_ns)

    def _hang(self, time_ns: int) -> None:
        self._transforms.log(
            messages.transforms(messages.frame_of(self.sensor, self.description), time_ns),
            log_time=time_ns,
        )

    def _show(self, frame: Frame, time_ns: int, stale: str) -> None:
        """Draw a frame, as far as anybody looks."""
        drawings: tuple[tuple[Any, Callable[..., Any]], ...] = (
            (self._contacts, messages.contacts_scene),
            (self._surface, messages.surface),
            (self._grid, messages.grid),
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
            **{name: getattr(frame, name) for name in FRAME_NUMBERS},
            "flags": sorted(frame.flags),
            "flag_count": len(frame.flags),
            "contact_count": len(frame.contacts),
            "age_ms": None if age_s is None else age_s * 1e3,
            "delay_ms": None if frame.delay_ns is None else frame.delay_ns * 1e-6,
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


PROFILE = "tactomo-foxglove"


def write_mcap(
    # in the order of their times: when each was acquired, nanoseconds since 1970; the frame; and
    # how old it was when it was published, seconds, if that is known
    frames: Iterable[tuple[int, Frame, float | None]],
    file: IO[bytes],  # a file opened for writing, which stays open
    sensor: str,  # the sensor's name
    description: Mapping[str, Any],  # the sensor, as `status` has it; empty where it is not known
) -> int:
    """Write frames as an MCAP file, one at a time; return how many. Raises OSError as files do."""
    context = foxglove.Context()
    transforms = FrameTransformsChannel("/tf", context=context)
    topics = SensorTopics(sensor, context, transforms)
    options = MCAPWriteOptions(profile=PROFILE, compression_threads=0)
    count = 0
    writer = foxglove.open_mcap(file, context=context, writer_options=options)
    for count, (time_ns, frame, age_s) in enumerate(frames, 1):
        if count == 1 and description:
            topics.sheet(description, time_ns)
        topics.frame(frame, time_ns, age_s)
        file.flush()  # the writer keeps to itself that a write has failed
    try:
        writer.close()
    except RuntimeError as error:  # so it says that an earlier write had failed
        raise OSError(f"the file could not be written: {error}") from error
    return count


def shipped_layout() -> str:
    """Return the shipped layout, of a sensor named `skin`."""
    return (resources.files("tactomo_foxglove") / "tactomo_layout.json").read_text("utf-8")


def layout_for(sensor: str) -> str:
    """Return the layout for a sensor of this name, to be imported in Foxglove."""
    text = shipped_layout()
    if not re.fullmatch(r"\w+", sensor):  # a message path quotes a topic of other characters
        text = text.replace('"/skin/frame.', '"\\"/skin/frame\\".')
    return text.replace("/skin/", f"/{sensor}/").replace('"skin"', f'"{sensor}"')
