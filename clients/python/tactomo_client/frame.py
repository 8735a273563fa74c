"""What a subscriber receives: a `Frame`, one dual scan's outcome, and the `Contact`s in it.

Both are immutable. A value that is not known is None, never 0 or NaN: a skin whose magnitude
channel is out still reports where it is touched, with `magnitude` and `pressure_kpa` None.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, TypeAlias

from tactomo_client.errors import MessageError
from tactomo_client.messages import MAP, Message, array_from_wire, clock_id, is_integer

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Image: TypeAlias = "NDArray[np.float32]"


TOUCHES_SEEN = frozenset(
    (
        "magnitude_missing",
        "invalid_voltage",
        "electrode_fault",
        "saturated",
        "channels_skewed",
        "untaught",
    )
)
"""Flags under which every touch is still seen: see STREAM.md. Of any other nobody knows."""


PRESSURE_RANGES = ("unknown", "within", "below", "above")
"""What a contact's `pressure_range` may be; where it has to be a number, its place in here."""


class Answer(Enum):
    """What `exceeds` answers: compare it, as in ``is Answer.NO``.

    It is neither true nor false, so that no `if` takes CANNOT_TELL for one of the others.
    """

    YES = "yes"
    NO = "no"
    CANNOT_TELL = "cannot tell"

    def __bool__(self) -> bool:
        raise TypeError("an Answer is one of three: compare it, such as 'is Answer.YES'")


@dataclass(frozen=True, slots=True)
class Contact:
    """One pressed area. It keeps its `id` for as long as it is followed from frame to frame."""

    id: int
    x_mm: float  #: centre, from the middle of the skin to the right, seen from the pressed side
    y_mm: float  #: centre, from the middle of the skin upwards
    area_mm2: float
    #: |Δσ|/σ₀ inside the contact: how much the conductivity changed, a ratio
    magnitude: float | None
    magnitude_sigma: float | None  #: standard uncertainty of `magnitude`
    pressure_kpa: float | None
    #: Standard uncertainty of `x_mm`; None where the method gives none
    x_sigma_mm: float | None = None
    y_sigma_mm: float | None = None  #: standard uncertainty of `y_mm`
    area_sigma_mm2: float | None = None  #: standard uncertainty of `area_mm2`
    #: Standard uncertainty of `pressure_kpa`, the sensor's calibration included
    pressure_sigma_kpa: float | None = None
    #: Pressure times area; a lower bound where ``above``
    force_n: float | None = None
    force_sigma_n: float | None = None  #: standard uncertainty of `force_n`
    #: ``within``; ``below``: touched, too lightly to be measured, `pressure_kpa` is None;
    #: ``above``: may be beyond the range, `pressure_kpa` is a lower bound, 95 %; ``unknown``
    pressure_range: str = "unknown"
    #: Highest pressure under it; `pressure_kpa` is a mean over its area
    peak_kpa: float | None = None
    peak_sigma_kpa: float | None = None  #: standard uncertainty of `peak_kpa`
    #: Upper bound of its highest pressure, 95 %, whatever `pressure_range` says; None: no bound
    max_kpa: float | None = None
    #: Exponent γ of the pressure (1 - ρ²)^γ from the middle to the edge: 0 flat, 0.5 Hertz
    edge: float | None = None
    #: Whether presses at known places say where it is, by `tactomo teach`; else the physics alone
    #: does
    taught: bool = False

    def exceeds(self, limit_kpa: float) -> Answer:
        """Return whether it presses with `limit_kpa` or more.

        YES goes by the best estimate of its highest pressure (the lower bound of 95 % of one that
        is ``above``), NO by the upper bound of 95 %. So noise moves the answer near the limit to
        and fro: stop at one, go on below a lower one.
        """
        least_kpa = self.pressure_kpa if self.peak_kpa is None else self.peak_kpa
        if least_kpa is not None and least_kpa >= limit_kpa:
            return Answer.YES
        if self.max_kpa is not None and self.max_kpa < limit_kpa:
            return Answer.NO
        return Answer.CANNOT_TELL


_MAY_BE_UNKNOWN = [name for name, kind in Contact.__annotations__.items() if "None" in kind]


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """What the skin felt at one instant, and how far to trust it.

    The images are float32 arrays of shape (ny, nx), read-only; `map[iy, ix]` is the value at the
    node `iy` from the bottom and `ix` from the left, whose first and last positions are in
    `y_mm` and `x_mm`. An image is None when it could not be computed, or when the subscription is
    to contacts alone.
    """

    sensor: str
    session: str  #: changes when the daemon restarts; contact ids and `sequence` start anew then
    sequence: int  #: counts the messages of this kind; a gap means that frames were missed
    scan_counter: int
    #: When the scan was acquired, nanoseconds since 1970 (UTC): see STREAM.md for what that is
    acquired_realtime_ns: int
    acquired_monotonic_ns: int  #: the same instant on that computer's monotonic clock
    device_us: int | None  #: the device's own clock, microseconds
    delay_ns: int | None  #: from then until the daemon had read the scan's last byte
    #: The magnitude scan's time less the structure scan's; None where that is not known
    skew_ms: float | None
    #: What made the frame: ``quiet``, ``fit``, ``network``, ..., or an own method's name
    tier: str | None
    tier_reason: str | None
    #: What to be wary of, such as ``misfit_high``; empty when all is well. See STREAM.md.
    flags: frozenset[str]
    #: Rms of what the model left unexplained, in units of the noise: about 1 is good
    misfit: float | None
    #: Correlation of the map with the truth that a network expects, 0 to 1; None where none was
    #: asked
    confidence: float | None
    contacts: tuple[Contact, ...]
    #: Of all contacts together, N; 0 where nothing presses, None where that of one is not known, a
    #: lower bound where one is ``above``
    force_n: float | None
    force_sigma_n: float | None  #: standard uncertainty of `force_n`; None where unknown
    map: Image | None  #: |Δσ|/σ₀ of the magnitude channel, a ratio
    pressure_kpa: Image | None
    structure: Image | None  #: pressed (1) or not (0), with everything between for in between
    x_mm: tuple[float, float] | None
    y_mm: tuple[float, float] | None
    _age_at_receipt_ns: int = field(repr=False)
    _received_ns: int | None = field(repr=False)
    _stale_after_s: float = field(repr=False)

    @property
    def age_s(self) -> float:
        """Seconds since the scan was acquired, what buffers held it up by included.

        Of a recorded frame: until it was published; it grows no older.
        """
        since_receipt_ns = 0
        if self._received_ns is not None:
            since_receipt_ns = time.monotonic_ns() - self._received_ns
        return (self._age_at_receipt_ns + since_receipt_ns) * 1e-9

    @property
    def is_stale(self) -> bool:
        """Whether this frame is older than the subscription's `stale_after_s`."""
        return self.age_s > self._stale_after_s

    @property
    def is_known(self) -> bool:
        """Whether every touch would be among `contacts`: if there is none, nothing presses.

        False where the frame is stale, or a flag says that touches may be missing.
        """
        return self.flags <= TOUCHES_SEEN and not self.is_stale

    def exceeds(self, limit_kpa: float) -> Answer:
        """Return whether any contact presses with `limit_kpa` or more.

        YES if one does. NO only if none does, the frame is fresh and nothing flags it.
        """
        answers = [contact.exceeds(limit_kpa) for contact in self.contacts]
        if Answer.YES in answers:
            return Answer.YES
        is_sure = Answer.CANNOT_TELL not in answers and not self.flags and not self.is_stale
        return Answer.NO if is_sure else Answer.CANNOT_TELL


def frame_from_message(message: Message, received_ns: int | None, stale_after_s: float) -> Frame:
    """Return the frame in a `map` or `contacts` message.

    Args:
        message: the message.
        received_ns: when it came, by the monotonic clock; None for one that was recorded.
        stale_after_s: the age in seconds from which the frame is stale.

    Raises:
        MessageError: a field is missing or of the wrong type.
    """
    fields = message.fields
    has_images = message.kind == MAP
    misfit, confidence = fields["misfit"], fields.get("confidence")
    contacts = fields.get("contacts")
    if not isinstance(contacts, list):
        raise MessageError("field 'contacts' is not a list")
    return Frame(
        sensor=message.sensor,
        session=fields["session"],
        sequence=fields["sequence"],
        scan_counter=_integer(fields, "scan_counter"),
        acquired_realtime_ns=_integer(fields, "acquired_realtime_ns"),
        acquired_monotonic_ns=_integer(fields, "acquired_monotonic_ns"),
        device_us=fields["device_us"],
        delay_ns=fields.get("delay_ns"),
        skew_ms=fields.get("skew_ms"),
        tier=fields["tier"],
        tier_reason=fields["tier_reason"],
        flags=frozenset(fields["flags"]),
        misfit=None if misfit is None else float(misfit),
        confidence=None if confidence is None else float(confidence),
        contacts=tuple(_contact(contact) for contact in contacts),
        force_n=_number_or_none(fields, "force_n"),
        force_sigma_n=_number_or_none(fields, "force_sigma_n"),
        map=_image(fields, "map") if has_images else None,
        pressure_kpa=_image(fields, "pressure_kpa") if has_images else None,
        structure=_image(fields, "structure") if has_images else None,
        x_mm=_extent(fields, "x_mm") if has_images else None,
        y_mm=_extent(fields, "y_mm") if has_images else None,
        _age_at_receipt_ns=age_at_receipt_ns(fields, received_ns),
        _received_ns=received_ns,
        _stale_after_s=stale_after_s,
    )


def age_at_receipt_ns(fields: dict[str, Any], received_ns: int | None) -> int:
    """Return the age in ns of a message that came at `received_ns` (monotonic; None: recorded).

    Exact where publisher and subscriber read the same clock; otherwise the age at publication,
    which leaves out the time that the message was on its way.
    """
    acquired_ns: int | None = fields["acquired_monotonic_ns"]
    age_at_publication_ns: int | None = fields["age_ns"]
    if received_ns is not None and acquired_ns is not None and is_our_clock(fields):
        return max(0, received_ns - acquired_ns)
    return max(0, age_at_publication_ns or 0)


def is_our_clock(fields: Mapping[str, Any]) -> bool:
    """Whether a message was stamped by this computer's monotonic clock."""
    return bool(clock_id()) and fields.get("clock_id") == clock_id()


def _contact(value: object) -> Contact:
    if not isinstance(value, dict):
        raise MessageError("a contact is not a map")
    pressure_range = value.get("pressure_range", "unknown")
    if not isinstance(pressure_range, str):
        raise MessageError("field 'pressure_range' is not text")
    taught = value.get("taught", False)
    if not isinstance(taught, bool):
        raise MessageError("field 'taught' is not true or false")
    return Contact(
        id=_integer(value, "id"),
        x_mm=_number(value, "x_mm"),
        y_mm=_number(value, "y_mm"),
        area_mm2=_number(value, "area_mm2"),
        pressure_range=pressure_range,
        taught=taught,
        **{name: _number_or_none(value, name) for name in _MAY_BE_UNKNOWN},
    )


def _image(fields: dict[str, Any], name: str) -> Image | None:
    if fields.get(name) is None:
        return None
    image = array_from_wire(fields[name])
    if image.ndim != 2 or image.dtype.name != "float32":
        raise MessageError(f"field {name!r} is not a two-dimensional array of float32")
    return image


def _extent(fields: dict[str, Any], name: str) -> tuple[float, float]:
    value = fields.get(name)
    if not isinstance(value, list) or len(value) != 2:
        raise MessageError(f"field {name!r} is not [first, last]")
    ends = {"first": value[0], "last": value[1]}
    return _number(ends, "first"), _number(ends, "last")


def _integer(fields: Mapping[str, object], name: str) -> int:
    value = fields.get(name)
    if not is_integer(value):
        raise MessageError(f"field {name!r} is not an integer of 64 bits")
    return value


def _number(fields: Mapping[str, object], name: str) -> float:
    value = fields.get(name)
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise MessageError(f"field {name!r} is not a finite number")
    return float(value)


def _number_or_none(fields: Mapping[str, object], name: str) -> float | None:
    return None if fields.get(name) is None else _number(fields, name)
