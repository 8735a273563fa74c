"""What the stream's messages say: the one definition of each field's name, type, unit and meaning.

`make schema` writes STREAM.md's tables and the C++ client's structures from this page: a comment is
a field's meaning, the end of its name its unit (or ``Unit: V.`` in the comment), ``None`` in its
type *or nil*. What a daemon of another version does not send has the default; `Absent` stands for
that in the type of what is never nil.

Everything is immutable. A value that is not known is None, never 0 or NaN: a skin whose magnitude
channel is out still reports where it is touched, with `magnitude` and `pressure_kpa` None.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated, Any, Final, TypeAlias

from tactomo_client.filled import Image, Received, Volts

STALE_AFTER_S: Final = 3.0  #: a daemon sends its status every second; after so long it is gone
FRAME_STALE_AFTER_S: Final = 0.5  #: a frame's age from which it is old

Absent: TypeAlias = None
Unsigned: TypeAlias = Annotated[int, range(2**64)]

TOUCHES_SEEN = frozenset(
    (
        "magnitude_missing",
        "invalid_voltage",
        "electrode_fault",
        "saturated",
        "channels_skewed",
        "untaught",
        "companion_missing",
        "companion_disputed",
    )
)
"""Flags under which every touch is still seen: see STREAM.md. Of any other nobody knows."""


PRESSURE_RANGES = ("unknown", "within", "below", "above")
"""What a contact's `pressure_range` may be; where it has to be a number, its place in here."""


class Answer(Enum):
    """The answer of `exceeds`: compare the answer, as in ``is Answer.NO``.

    An answer in a bare `if` raises TypeError, so that CANNOT_TELL is never taken for YES or NO.
    """

    YES = "yes"
    NO = "no"
    CANNOT_TELL = "cannot tell"

    def __bool__(self) -> bool:
        raise TypeError("an Answer is one of three: compare it, such as 'is Answer.YES'")


@dataclass(frozen=True, slots=True)
class Contact:
    """One pressed area. A contact keeps its `id` while it is tracked from frame to frame."""

    #: The contact's identity, kept while the contact moves less than 25 mm from frame to frame and
    #: through gaps of up to 5 frames. Where two contacts merge, the contact nearer to the middle of
    #: both keeps its identity. An identity that ended is not used again in this session
    id: int
    x_mm: float  #: Centre, to the right of the skin's middle, seen from the pressed side
    y_mm: float  #: Centre, upwards from the skin's middle
    area_mm2: float  #: Pressed area
    magnitude: float | None = None  #: |Δσ|/σ₀, mean over the contact's area. Unit: ratio.
    magnitude_sigma: float | None = None  #: Standard uncertainty of `magnitude`. Unit: ratio.
    #: Pressure, mean over the contact's area; nil when unknown: see `pressure_range`
    pressure_kpa: float | None = None
    x_sigma_mm: float | None = None  #: Standard uncertainty of `x_mm`; nil where unknown
    y_sigma_mm: float | None = None  #: Standard uncertainty of `y_mm`; nil where unknown
    area_sigma_mm2: float | None = None  #: Standard uncertainty of `area_mm2`; nil where unknown
    #: Standard uncertainty of `pressure_kpa`, the calibration's included; nil unless ``within``
    pressure_sigma_kpa: float | None = None
    #: Force: pressure times area, or learnt from presses of known force (`taught`). A lower bound
    #: (95 %) where ``above``. Known even where ``below`` or ``unknown``, if the response has no
    #: onset and the highest pressure is bounded: a small hard and a large light press have the same
    #: force
    force_n: float | None = None
    #: Standard uncertainty of `force_n`; nil where `force_n` is nil or a lower bound, and where the
    #: uncertainty of the area is unknown
    force_sigma_n: float | None = None
    #: ``within``: the pressure is measured. ``below``: the touch is too light for the magnitude
    #: channel; `pressure_kpa` is nil. ``above``: the upper bound (95 %) exceeds the range of the
    #: response or calibration; `pressure_kpa` is a lower bound (95 %) and `max_kpa` nil.
    #: ``unknown``: no magnitude channel, no response, or too uncertain. Noise near a limit does not
    #: change the range (hysteresis). Treat an absent field as ``unknown``
    pressure_range: str = "unknown"
    #: Highest pressure under the contact: above `pressure_kpa` where the object is soft. Nil where
    #: unknown, a lower bound (95 %) where ``above``
    peak_kpa: float | None = None
    #: Standard uncertainty of `peak_kpa`; nil unless ``within``
    peak_sigma_kpa: float | None = None
    #: Upper bound (95 %) of the highest pressure under the contact, also where `pressure_range` is
    #: ``below`` or ``unknown``. Nil where nothing bounds the pressure: no magnitude channel, no
    #: uncertainty, or ``above``
    max_kpa: float | None = None
    #: Profile exponent γ: the pressure falls towards the edge as (1 − ρ²)^γ. 0 is flat, 0.5 is
    #: Hertzian; nil where unknown. What falls is taken for Hertzian, as under balls and fingers:
    #: of a pressure that falls more steeply, such as a cone's, the peak and its bounds are too low
    edge: float | None = None
    #: Whether `x_mm`, `y_mm` and their uncertainties come from presses at known places (`tactomo
    #: teach`); so does `force_n` where the forces were known
    taught: bool = False
    #: Centre on the sheet's surface, in the frame `frame`. `position_m`, `normal` and `frame` are
    #: nil where the sensor description has no ``[mount]``
    position_m: tuple[float, float, float] | None = None
    #: Unit vector out of the sheet at `position_m`, in the frame `frame`: the object pushes against
    #: the normal
    normal: tuple[float, float, float] | None = None
    frame: str | None = None  #: Name of the robot's link that carries the sheet

    def exceeds(self, limit_kpa: float) -> Answer:
        """Return whether the contact presses with `limit_kpa` or more.

        YES goes by the best estimate of the highest pressure (the lower bound, 95 %, where the
        contact is ``above``), NO by the upper bound (95 %). Noise changes the answer near the
        limit: stop at one limit, and continue below a lower limit.
        """
        least_kpa = self.pressure_kpa if self.peak_kpa is None else self.peak_kpa
        if least_kpa is not None and least_kpa >= limit_kpa:
            return Answer.YES
        if self.max_kpa is not None and self.max_kpa < limit_kpa:
            return Answer.NO
        return Answer.CANNOT_TELL


def table_row(contact: Contact) -> dict[str, Any]:
    """Return a contact's fields as the cells of a table: each number of a vector is its own cell.

    `position_m` becomes `position_x_m`, `position_y_m` and `position_z_m`, `normal` likewise;
    `frame` becomes `mount_frame`, since a table's rows belong to a frame of another kind.
    """
    cells: dict[str, Any] = {}
    for name in wire_fields(Contact):
        value = getattr(contact, name)
        if name in ("position_m", "normal"):
            stem, _, unit = name.partition("_")
            cells |= {
                f"{stem}_{axis}{unit and '_'}{unit}": None if value is None else value[number]
                for number, axis in enumerate("xyz")
            }
        else:
            cells["mount_frame" if name == "frame" else name] = value
    return cells


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Envelope:
    """What every message of every kind begins with, after `schema`, `sensor` and `kind`."""

    #: A new random value at each start of the daemon. When `session` changes, contact identities
    #: and `sequence` begin anew
    session: str
    #: Rises by one with each message of this kind in this session. A gap means missed messages
    sequence: Unsigned
    #: When the dual scan was acquired (see below), on the wall clock of the daemon's computer: UTC
    #: since 1970. In ``status`` and ``event``: of the newest dual scan, nil before the first
    acquired_realtime_ns: int | None
    #: The same instant on that computer's ``CLOCK_MONOTONIC``, which nobody sets. Compare and
    #: subtract these times: the wall clock may jump
    acquired_monotonic_ns: int | None
    #: Time from acquisition until the daemon had read the last byte of the dual scan
    delay_ns: int | None = None
    #: ``device``: the acquisition time comes from the device's clock, so the age includes delays in
    #: buffers. ``arrival``: the device has no clock or the daemon does not know the clock yet; the
    #: age excludes delays in buffers
    dated_by: str | None = None
    #: Identity of the monotonic clock (on Linux the boot id, ``/proc/sys/kernel/random/boot_id``);
    #: may be empty
    clock_id: str = ""
    #: Time of the dual scan on the device's clock, 0 to 2^53 − 1: the time of the magnitude scan,
    #: where there is one
    device_us: int | None
    #: Time of the magnitude scan minus time of the structure scan. Exact where one device took
    #: both; nil where a scan is missing or the clocks of two devices are not known yet
    skew_ms: float | None = None
    #: Time from acquisition to publication: the age of the data when they left the daemon
    age_ns: int | None
    #: The method that made the frame: ``quiet`` (nothing pressed, nothing solved), ``tikhonov``,
    #: ``noser``, ``fit`` (a few contacts), ``levelset`` (a free form), ``network`` (a trained
    #: network alone), or another method by its name. Recordings of earlier versions may say
    #: ``hybrid``: fitted outlines that a second network refined
    tier: str | None
    tier_reason: str | None  #: Why this method, in words for people
    flags: frozenset[str]  #: Reasons to distrust the frame; see Flags. Empty: none
    #: Rms of the residual in units of the measured noise. About 1 is good. Above 2 the frame is
    #: flagged ``misfit_high``, except where ``network`` has a `confidence` of 0.9 or more, or where
    #: a linear method explains half of the changes. Above 1.5 over both channels, ``auto`` shows
    #: the network's map. In a ``quiet`` frame: rms of the changes in units of the noise and of the
    #: description's ``stability`` (0.3 %); a frame is quiet below 1.24 (208 voltages)
    misfit: float | None
    #: Correlation with the truth that the network expects of its map, 0 to 1; nil where no network
    #: made the map
    confidence: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contacts(Envelope):
    """What a ``contacts`` message has."""

    sensor: str
    acquired_realtime_ns: int
    acquired_monotonic_ns: int
    #: The dual scan's counter on the device (32 bits, wraps). All messages of one dual scan have
    #: the same counter
    scan_counter: int
    #: The pressed areas. **An empty list means "nothing pressed"** only if the message is not stale
    #: and every touch is seen (see Stale, or nothing pressed?)
    contacts: tuple[Contact, ...]
    #: Force of all contacts together: 0 where nothing is pressed, nil where the force of a contact
    #: is nil, a lower bound where a contact is ``above``. In these two cases, the force of a fitted
    #: companion of the whole sheet is told, where there is one
    force_n: float | None = None
    #: Standard uncertainty of `force_n`. Smaller than the root sum of squares where contacts touch:
    #: their errors cancel. Nil where the uncertainty of a contact's force is nil and no companion
    #: tells it, and where nothing is pressed
    force_sigma_n: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame(Contacts):
    """What the skin felt at one instant, and how far to trust it.

    The images are float32 arrays of shape (ny, nx), read-only; `map[iy, ix]` is the value at the
    node `iy` from the bottom and `ix` from the left, whose first and last positions are in
    `y_mm` and `x_mm`. An image is None when it could not be computed, or when the subscription is
    to contacts alone.
    """

    #: |Δσ|/σ₀ of the magnitude channel at each node; ``map[iy][ix]``, row 0 at the bottom.
    #: Unit: ratio.
    map: Image | None = None
    #: Pressure at each node; nil when the sensor has no magnitude channel or the method gives no
    #: pressure. **0 only where nothing touches**; NaN under a contact whose pressure is unknown
    #: (``below`` or ``unknown``); a lower bound under a contact that is ``above``
    pressure_kpa: Image | None = None
    structure: Image | None = None  #: How surely each node is pressed, 0 to 1
    #: Position of the first and the last column. Columns are evenly spaced
    x_mm: tuple[float, float] | Absent = None
    y_mm: tuple[float, float] | Absent = None  #: Position of the first and the last row
    #: Upper end of a sensible colour scale for `map`. Unit: ratio.
    magnitude_max: float | None = None
    _age_at_receipt_ns: int = field(repr=False)
    _received_ns: int | None = field(repr=False)
    _stale_after_s: float = field(repr=False)

    @property
    def age_s(self) -> float:
        """Seconds since the scan was acquired, delays in buffers included.

        A recorded frame has its age at publication.
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
        """Whether every touch is among `contacts`: an empty list means that nothing presses.

        False where the frame is stale, or a flag says that touches may be missing.
        """
        return self.flags <= TOUCHES_SEEN and not self.is_stale

    def exceeds(self, limit_kpa: float) -> Answer:
        """Return whether any contact presses with `limit_kpa` or more.

        YES if a contact does. NO only if no contact does and the frame is fresh and without flags.
        """
        answers = [contact.exceeds(limit_kpa) for contact in self.contacts]
        if Answer.YES in answers:
            return Answer.YES
        is_sure = Answer.CANNOT_TELL not in answers and not self.flags and not self.is_stale
        return Answer.NO if is_sure else Answer.CANNOT_TELL


@dataclass(frozen=True, slots=True)
class Event(Received):
    """Something that happened, such as ``port_lost``; STREAM.md lists them all.

    Example::

        for event in subscribe("left_forearm", kind="event"):
            if event.severity == "error":
                print(event.name, event.detail, event.next_step)
    """

    sensor: str
    session: str
    sequence: Unsigned
    name: str  #: One of the events below
    severity: str = "info"  #: ``info``, ``warning`` or ``error``
    detail: str = ""  #: What happened, in words
    next_step: str = ""  #: What to do, in words; may be empty


@dataclass(frozen=True, slots=True)
class EventKind:
    """How one kind of event is told."""

    severity: str  # ``info``, ``warning`` or ``error``
    # how long after one the next is told at the earliest; twice as long, up to a minute, while it
    # goes on. 0: each
    period_s: float = 0.0
    end: str = ""  # the event that says that it is over: until then it is told once
    at_skin: bool = False  # whether its next step is at the skin, its boards and its cables


INFO: Final = EventKind("info")
WARNING: Final = EventKind("warning")
ERROR: Final = EventKind("error")
FREQUENT: Final = EventKind("warning", period_s=1.0)
SKIN: Final = EventKind("warning", at_skin=True)
SKIN_FREQUENT: Final = EventKind("warning", period_s=1.0, at_skin=True)


class Events:
    """All events by name."""

    tared = INFO  #: A new reference is in force
    #: The reference was not taken: the scans differ too much (somebody presses), or no scans came
    tare_refused = WARNING
    #: By the reference kept from before, something seems to lie on the skin: the kept reference
    #: stays in use. Or a tare was taken while contacts were shown, or right after such a tare and
    #: under the same load. See the flag of this name
    reference_disputed = SKIN
    #: At the start, neither drift nor contacts explain the difference from the kept reference: the
    #: skin seems to be another one. The new reference is used
    skin_changed = SKIN
    #: The skin is at rest by the kept reference, or by the reference before a disputed tare
    reference_confirmed = INFO
    #: The reference cannot be written for the next start, or the kept reference cannot be read
    reference_not_kept = EventKind("warning", period_s=600.0)
    #: A change is neither clearly a contact nor clearly drift: the reference does not follow the
    #: change. ``baseline`` in the status shows this while it lasts
    baseline_refused = EventKind("warning", period_s=600.0, at_skin=True)
    #: Scans of one channel are missing; maps continue from the other channel
    channel_lost = EventKind("warning", end="channel_back", at_skin=True)
    channel_back = EventKind("info", at_skin=True)  #: The missing channel sends scans again
    #: A companion of the sensor description has had no reading within its limits for 1 s: see the
    #: flag ``companion_missing``
    companion_lost = EventKind("warning", end="companion_back", at_skin=True)
    companion_back = INFO  #: The companion reads again within its limits
    #: A device sends readings of a companion whose index the sensor description does not have
    companion_unknown = EventKind("warning", period_s=600.0, at_skin=True)
    #: Scans of one channel repeat one of their last 16, but for less than a tenth of the tare's
    #: noise, while their counter rises: the daemon treats them as missing. Of drives or measuring
    #: pairs that repeat bit for bit, the daemon leaves out those alone (``invalid_voltage``). A
    #: converter that is frozen during the first tare cannot be told from a source without noise;
    #: `tactomo doctor` then reports "no noise at all". Where the noise really fell so far, tare
    converter_frozen = EventKind("warning", end="converter_back", at_skin=True)
    converter_back = INFO  #: The channel's scans change again
    #: A port was closed, unplugged, or cannot be opened. The daemon keeps trying
    port_lost = EventKind("error", end="port_back")
    port_back = INFO  #: The port is open again
    corrupt_packets = SKIN_FREQUENT  #: Packets on a port were damaged in transit
    #: Scans of a channel arrived after later scans and are left out
    scans_disordered = SKIN_FREQUENT
    scans_dropped = FREQUENT  #: Reconstruction lagged: dual scans were left out
    #: Reconstruction lagged because other programs use the processor: each frame gets half as much
    #: time as before
    processor_shared = EventKind("warning", end="processor_free")
    processor_free = INFO  #: Each frame gets its full time again
    method_failed = FREQUENT  #: A method of your own failed: the frame was made by ``tikhonov``
    #: A defect in tactomo: a dual scan gave no frame
    reconstruction_failed = EventKind("error", period_s=1.0)
    #: A device was reset: its scan counter and its clock went back
    device_restarted = SKIN_FREQUENT
    #: The scan counter went back, the clock did not: somebody zeroed the counter
    counters_zeroed = EventKind("info", period_s=1.0)
    #: A device's clock jumped or went back. Scans are dated by arrival until the clock is known
    #: again
    device_clock_jumped = SKIN_FREQUENT
    #: A device's clock stands still or runs at an impossible rate. Scans are dated by arrival
    device_clock_unusable = SKIN
    #: The two channels' counters are out of step: see the flag. The daemon asks two boards to zero
    #: their counters
    channels_skewed = EventKind("warning", end="channels_in_step", at_skin=True)
    channels_in_step = INFO  #: The two channels' counters are in step again
    #: The computer's clock was set, or the computer slept. Only ``acquired_realtime_ns`` follows it
    wall_clock_jumped = WARNING
    #: A device's scans are not used: ``refusal`` of its port in the status says why
    device_refused = EventKind("error", period_s=1.0, end="device_speaks")
    #: A pressure calibration or a teaching is not used: the file is damaged, or of another sensor,
    #: device or skin
    calibration_refused = WARNING
    #: The pressure calibration and the teaching were read again and are in force
    calibration_reloaded = INFO
    #: A port, or the sensor at a start, has another device than before, and the new device is used.
    #: Exchange the cables back, or tare if the skin is another one
    device_changed = SKIN_FREQUENT
    #: Nothing came over an open port for 3 s (or three periods of a slower device, or as long as
    #: its protocol allows). The daemon asks the device again; later the daemon reopens the port,
    #: ever more rarely
    device_silent = EventKind("warning", period_s=30.0, end="device_speaks", at_skin=True)
    #: Bytes came but no packet, for as long: a wrong baud rate, or no skin
    device_garbled = EventKind("warning", period_s=30.0, end="device_speaks", at_skin=True)
    #: A device sends packets but no scans, for as long, although the daemon asked it to start
    device_idle = EventKind("warning", period_s=30.0, end="device_speaks", at_skin=True)
    device_speaks = INFO  #: The device is no longer silent, garbled, idle or refused
    #: An FTDI adapter holds bytes back for long, and the daemon may not change that
    latency_timer = WARNING
    #: A device's packets are intact but break [the protocol](../firmware_protocol/PROTOCOL.md):
    #: another version, a field out of range, or scans unlike the *hello*. These packets are not
    #: used
    firmware_fault = EventKind("warning", period_s=30.0, at_skin=True)
    #: A device sends packets but has acknowledged no command for 3 s
    command_unanswered = EventKind("warning", period_s=600.0)
    command_refused = WARNING  #: A device did not carry out a command of the daemon
    recording_started = INFO
    recording_stopped = INFO
    #: A client whose key is not allowed tried to connect; the event names its address and public
    #: key
    client_refused = FREQUENT
    #: A file in the list of clients holds no key; or other users could write to the list, and
    #: nobody new is admitted
    client_key_unusable = WARNING
    #: The disk is full, too slow or gone, or the file was deleted. The stream continues
    recording_failed = ERROR
    recording_resumed = INFO  #: The recording continues: the disk has room again, or answers again
    #: The disk has not answered for 5 s. Data wait in memory, up to 64 MiB
    recording_stalled = WARNING
    recording_rotated = INFO  #: The recording continues in the next file
    #: The next file cannot be created: the recording continues in the present file
    rotation_failed = WARNING
    #: An old recording was deleted to keep within ``keep_gb`` or ``keep_days``
    recording_deleted = INFO
    #: A defect in tactomo: a message would have broken this specification and was not sent;
    #: ``sequence`` has a gap
    message_unsent = EventKind("error", period_s=1.0)
    #: A connection sent more than 2 MB without a complete message and was cut
    connection_cut = FREQUENT
    subscribers_cut = WARNING  #: Subscriptions took more than 1 MiB: all connections were cut
    replay_ended = INFO  #: The replay has reached the end of the recording


EVENTS: Final[Mapping[str, EventKind]] = {
    name: kind for name, kind in vars(Events).items() if isinstance(kind, EventKind)
}


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Of durations, ms."""

    p50: float
    p99: float


@dataclass(frozen=True, slots=True)
class MagnitudeResponse:
    """The table by which a relative change of conductivity becomes a pressure."""

    pressure_kpa: tuple[float, ...]
    relative_change: tuple[float, ...]  #: as many; may be negative


@dataclass(frozen=True, slots=True)
class Calibration:
    """A pressure calibration: what it rests on, and how good it is."""

    taken: str = ""  #: When, ISO 8601, UTC
    readings: int = 0  #: Number of load-cell readings that the calibration rests on
    #: Lowest and highest pressure of the calibration: a contact is ``below`` or ``above`` outside
    range_kpa: tuple[float, ...] = ()
    #: Standard uncertainty of the calibration, median over the range; included in a contact's
    #: `pressure_sigma_kpa`
    sigma_kpa: float | Absent = None
    #: Pressure from which the channel responds; nil where the lightest reading already shows a
    #: response
    onset_kpa: float | None = None
    #: How much higher a falling load reads than a rising load; nil where only one of the two was
    #: taken
    hysteresis_kpa: float | None = None
    #: The devices that were calibrated; with other devices the calibration is not in force. Empty:
    #: any device
    device_ids: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Taught:
    """What presses at known places have taught a skin."""

    taken: str = ""  #: when, ISO 8601, UTC
    presses: int = 0
    median_mm: float | Absent = None  #: median localisation error on held-out presses
    untaught_median_mm: float | Absent = None  #: the same without teaching


@dataclass(frozen=True, slots=True)
class Mount:
    """The robot's link that carries the sheet, and where the sheet lies on the link."""

    frame: str  #: The link's name
    kind: str  #: ``plane``, ``cylinder`` or ``surface``
    #: Points of the sheet in the link's frame, m: rows from the bottom, evenly spaced over the
    #: bounding box
    surface_m: tuple[tuple[tuple[float, float, float], ...], ...]


@dataclass(frozen=True, slots=True)
class SensorDescription:
    """The sensor: its sheet, its electrodes and what it answers to."""

    model: str = ""  #: The sensor description's name, such as ``paper_square``
    sha256: str = ""  #: Hash of the description
    #: The description's file on the daemon's computer; nil for a shipped description
    file: str | None = None
    shape: str = ""  #: ``rectangle``, ``disc`` or ``polygon``
    width_mm: float | Absent = None  #: Width of the sheet's bounding box
    height_mm: float | Absent = None  #: Height of the sheet's bounding box
    sensing_width_mm: float | Absent = None  #: Width of the area that can be pressed, centred
    sensing_height_mm: float | Absent = None  #: Height of the area that can be pressed, centred
    #: Corners, x and y, of each ring of the sheet's outline: the outer ring counter-clockwise, then
    #: the holes
    outline_mm: tuple[tuple[tuple[float, float], ...], ...] = ()
    #: Corners of each ring of the area that can be pressed, which may be several pieces
    sensing_outline_mm: tuple[tuple[tuple[float, float], ...], ...] = ()
    #: Centre of each electrode, x and y, electrode 0 first
    electrodes_mm: tuple[tuple[float, float], ...] = ()
    #: Radius of each electrode that is a round pad inside the sheet; 0 of those on a rim
    pad_radii_mm: tuple[float, ...] = ()
    modalities: tuple[str, ...] = ()  #: The sensor's channels: ``magnitude``, ``structure``
    magnitude_max: float | None = None  #: As in ``map``. Unit: ratio.
    #: Highest pressure of the response in force: the calibration's, else the description's
    pressure_max_kpa: float | None = None
    #: The table that turns |Δσ|/σ₀ into pressure (linear between its entries): the calibration's,
    #: else the description's
    magnitude_response: MagnitudeResponse | None = None
    #: The pressure calibration in force, see below; nil where the description's table is used or
    #: there is no magnitude channel. `calibration`, `pressure_max_kpa` and `magnitude_response` may
    #: change while the daemon runs
    calibration: Calibration | None = None
    #: The teaching in force (presses at known places); may change while the daemon runs
    taught: Taught | None = None
    #: Where the sheet lies on the robot; nil where the description does not say
    mount: Mount | None = None


@dataclass(frozen=True, slots=True)
class Source:
    """Where scans come from."""

    #: ``replay``: a recording; ``twin``: the *hello* says that the device is simulated; ``device``:
    #: any other, emulators of foreign protocols included, since these protocols cannot say that a
    #: device is simulated; ``unknown``: before the first *hello*
    kind: str = "unknown"


@dataclass(frozen=True, slots=True)
class Device:
    """What a device says of itself."""

    device_id: str = ""
    firmware: str = ""
    channels: tuple[str, ...] = ()
    electrodes: int | Absent = None
    samples_per_scan: int | Absent = None
    scan_rate_hz: float | Absent = None


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """How the daemon knows a device's clock."""

    #: ``settling``, ``settled``, ``unusable`` (stands still or runs at an impossible rate) or
    #: ``absent`` (the protocol has no clock)
    state: str = ""
    offset_ns: int | None = None  #: the daemon's monotonic clock minus the device's clock
    rate_ppm: float | None = None  #: how slow the device's clock runs
    #: delay of scans beyond the smallest delay; a bad hub shows here
    delay_ms: Percentiles | None = None
    jumps: int = 0


@dataclass(frozen=True, slots=True)
class Port:
    """One port that the daemon reads."""

    url: str  #: As configured
    protocol: str = "tactomo"  #: What the device speaks: ``tactomo``, or a foreign protocol
    connected: bool = False  #: Whether the port is open
    #: ``closed`` (the daemon tries several times a second), ``starting`` (just opened),
    #: ``running``, ``idle`` (packets but no valid scans for 3 s, or three periods of a slower
    #: device), ``faulty`` (as ``idle``, and packets break the protocol), ``garbage`` (bytes but no
    #: packets: a wrong baud rate?), ``silent`` (no bytes), ``refused``, or ``ended`` (replay)
    state: str = ""
    problem: str | None = None  #: Why the port is closed or unusable, in words
    device: Device | None = None  #: From the device's *hello*; nil before the first
    bytes: int = 0  #: Bytes received
    packets: int = 0  #: Packets received
    corrupt: int = 0  #: Packets damaged in transit: a fault of the line
    faulty: int = 0  #: Intact packets that break the protocol: a fault of the firmware
    #: Increase of `packets`, `corrupt` and `faulty` in the last minute
    received_last_minute: Mapping[str, int] = field(default_factory=dict)
    #: Why the device's scans are not used; nil where they are used. The device does not fit the
    #: description, is not in the sensor's ``device_ids``, sends a channel that another port
    #: carries, or (foreign protocols) cannot be understood or refused its configuration
    refusal: str | None = None
    #: Scans that were not used: from an unknown or refused device, unlike the *hello*, or of a
    #: channel that the sensor does not have
    unused_scans: int = 0
    reopened: int = 0  #: How often the daemon reopened the port because the device was silent
    #: Longest time that an FTDI adapter holds bytes back; nil for other ports
    latency_timer_ms: int | None = None
    clock: DeviceClock | Absent = None  #: The device's clock


@dataclass(frozen=True, slots=True)
class Rates:
    """Per second; None for a channel that the sensor does not have."""

    magnitude_hz: float | None = None  #: scans that arrive; nil: no such channel
    structure_hz: float | None = None  #: likewise
    frames_hz: float = 0.0  #: frames published


@dataclass(frozen=True, slots=True)
class ScanTally:
    """What became of every single scan since the start."""

    received: int = 0
    used: int = 0  #: part of a frame
    late: int = 0  #: as in `late_scans`
    repeated: int = 0  #: arrived before
    dropped: int = 0  #: newer scans had come, or an exact replay does not use them
    waiting: int = 0  #: for the other channel or for processing


@dataclass(frozen=True, slots=True)
class WallClock:
    """Whether the computer's clock was set while the daemon ran."""

    jumps: int = 0  #: how often the clock was set
    last_jump_s: float | None = None  #: the last change


@dataclass(frozen=True, slots=True)
class Reference:
    """The unloaded scans that changes are measured against."""

    scans: int  #: number of dual scans averaged
    taken_realtime_ns: int  #: when, nanoseconds since 1970 (UTC)


@dataclass(frozen=True, slots=True)
class ChannelDrift:
    """How far one channel's voltages have drifted since the tare."""

    gain: float  #: their common relative change
    uneven: float  #: the rms of their relative changes beyond that


@dataclass(frozen=True, slots=True)
class Baseline:
    """How the reference follows the skin's drift."""

    #: ``off``, ``waiting`` for a first good frame after a tare, ``following`` while nothing
    #: presses, ``held`` while something presses, ``refused``: a change is neither clearly a contact
    #: nor clearly drift
    state: str = "off"
    refusal: str | None = None  #: why, in words
    moves: int = 0  #: how often the reference has moved since the tare
    drift: Mapping[str, ChannelDrift] = field(default_factory=dict)  #: since the tare, by channel


@dataclass(frozen=True, slots=True)
class Companion:
    """What a companion of the sensor description, such as a load cell, said of the newest frame."""

    #: ``fitted`` beside the sheets; left out as ``disputed`` (it contradicts the sheets), ``late``
    #: (of before the sheets last moved) or ``missing`` (no reading within its limits); ``unused``
    #: where nothing presses, or by a method that takes none
    state: str
    reading: float | None  #: in its own unit
    force_n: float | None  #: by gain and offset, since the tare
    force_sigma_n: float | None  #: its standard uncertainty


@dataclass(frozen=True, slots=True)
class Plan:
    """What frames are given for the method and the budget that were asked for."""

    tier: str = ""  #: the method in use
    #: fraction of the requested work (``budget_ms``, or the method's own); below 1 while other
    #: programs use the processor
    share: float = 1.0


@dataclass(frozen=True, slots=True)
class Replay:
    """How far a replay is, and how it goes on: the control command ``replay`` changes that."""

    position_s: float  #: on the recording's own clock, seconds from its beginning
    duration_s: float
    speed: float  #: factor of the recorded speed; 0: as fast as possible
    paused: bool = False
    loop: bool = False
    waits_for_page: bool = False  #: paused until a viewer's page is open
    #: whether frames are made of the dual scans and the references that the live ones were made of;
    #: ``tare`` is then refused
    exact: bool = False
    #: `sequence` of the last ``map`` message before the replay moved: later maps are of the new
    #: position
    maps_before: int = 0


@dataclass(frozen=True, slots=True)
class RecordingProgress:
    """The recording that runs."""

    path: str  #: on the daemon's computer
    bytes: int  #: written
    queued_bytes: int = 0  #: waiting for the disk


@dataclass(frozen=True, slots=True)
class Recorder:
    """Recordings since the daemon's start."""

    files: int = 0  #: recordings begun
    deleted: int = 0  #: recordings deleted to keep within the limits
    failures: int = 0
    failure: str | None = None  #: why the last recording stopped, until the next recording begins
    #: why a wanted recording does not run; the recording resumes by itself
    waits_for: str | None = None


@dataclass(frozen=True, slots=True)
class Trouble:
    """The last event of a name that was no ``info``."""

    name: str  #: as in ``event``
    severity: str
    detail: str
    next_step: str = ""
    realtime_ns: int | Absent = None  #: when, nanoseconds since 1970 (UTC)
    age_s: float | Absent = None  #: how long before the status


@dataclass(frozen=True, slots=True)
class EventCounts:
    """What happened since the daemon's start, for those who were not there."""

    counts: Mapping[str, int] = field(default_factory=dict)  #: how often, by the event's name
    #: the latest warning or error of each name, newest first, at most 8
    troubles: tuple[Trouble, ...] = ()


@dataclass(frozen=True, slots=True)
class HealthIssue:
    """One thing that is wrong with a sensor or its daemon."""

    severity: str  #: ``error`` or ``warning``
    what: str  #: in words
    next_step: str  #: what to do about it, in words


@dataclass(frozen=True, slots=True)
class Process:
    """What the daemon takes of its computer."""

    pid: int
    cpu_s: float  #: processor time since the start
    memory_bytes: int | None  #: resident memory
    threads: int


@dataclass(frozen=True, slots=True)
class Status(Received):
    """State of a daemon, received every second with or without data.

    A stale status means that the daemon is gone, hangs, or cannot be reached. `fields` holds
    everything that a daemon of another version sends beyond these names.

    Example::

        status = Daemon().status()
        print(status.state, [port.problem for port in status.ports])
    """

    session: str = ""
    sequence: Unsigned = 0
    sensor: str = ""
    flags: frozenset[str] = frozenset()  # the newest frame's, as are `tier` and `misfit`
    tier: str | None = None
    misfit: float | None = None
    version: str = ""  #: The daemon's version
    #: ``waiting_for_port`` (a port is not open yet), ``waiting_for_data``, ``taring``, ``running``,
    #: ``late`` (scans arrive, but reconstruction lags by more than a stale sensor's limit),
    #: ``stale`` (no data for 1 s, or three periods of a slower device); of a replay also ``paused``
    #: or ``ended``
    state: str = ""
    #: Everything that is wrong at present, errors first; empty where all is well. A program that
    #: shows a sensor's health prints these issues and judges for itself only whether messages
    #: arrive
    issues: tuple[HealthIssue, ...] = ()
    uptime_s: float = 0.0  #: Time since the daemon's start
    control: str = ""  #: Address of the control socket on the daemon's computer
    description: SensorDescription | Absent = None  #: The sensor, see below
    source: Source = field(default_factory=Source)  #: Origin of the scans
    replay: Replay | None = None  #: Progress of a replay; nil where the ports are live
    ports: tuple[Port, ...] = ()  #: One for each port, see below
    rates: Rates = field(default_factory=Rates)  #: Per second
    dropped_scans: int = 0  #: Dual scans left out because newer dual scans had come
    #: Dual scans without a scan of one channel. A channel that has sent nothing yet counts after 3
    #: s
    incomplete_scans: int = 0
    #: Increase of `frames`, `dropped_scans` and `incomplete_scans` in the last minute
    last_minute: Mapping[str, int] = field(default_factory=dict)
    #: Scans left out because they arrived after their dual scan had been processed
    late_scans: int = 0
    #: What became of each scan since the start. The counts add up, except for the few scans in
    #: transit while they are read
    scan_tally: ScanTally = field(default_factory=ScanTally)
    channel_skew_ms: Percentiles | None = None  #: Absolute value of `skew_ms`
    #: Whether the computer's clock was set while the daemon ran
    wall_clock: WallClock = field(default_factory=WallClock)
    #: The scans that changes are measured against; nil before a tare
    reference: Reference | None = None
    #: How the reference follows the skin's drift
    baseline: Baseline = field(default_factory=Baseline)
    #: What the sensor's companions said of the newest frame, by name
    companions: Mapping[str, Companion] = field(default_factory=dict)
    #: Processing time of each stage of the pipeline
    stage_ms: Mapping[str, Percentiles] = field(default_factory=dict)
    latency_ms: Percentiles | None = None  #: Time from the last byte read to publication
    #: The methods that the sensor can be reconstructed by: ``auto``, tactomo's own, and methods
    #: installed or named at the daemon's start
    methods: tuple[str, ...] = ()
    tier_requested: str = ""  #: The requested method, one of `methods`
    #: Requested work per frame, in milliseconds of a 2.5 GHz core; nil: the method's own
    budget_ms: float | None = None
    #: Method and work in force, from `tier_requested` and `budget_ms`
    plan: Plan = field(default_factory=Plan)
    recording: RecordingProgress | None = None  #: Nil when nothing is recorded
    recorder: Recorder = field(default_factory=Recorder)  #: Recordings since the start
    subscribers: int = 0  #: Number of subscriptions
    #: Scans received since the start, by channel
    scans: Mapping[str, int] = field(default_factory=dict)
    frames: int = 0  #: Frames published since the start
    #: What happened since the start, for programs that connected later
    events: EventCounts = field(default_factory=EventCounts)
    process: Process | Absent = None  #: The daemon's use of its computer


@dataclass(frozen=True, slots=True)
class Scan:
    """What was measured: what a ``scan`` message has beyond the envelope."""

    scan_counter: int  #: As in ``map``
    #: The magnitude channel's voltages, drive by drive; nil when the channel is missing. Unit: V.
    magnitude: Volts | None = None
    structure: Volts | None = None  #: The structure channel's. Unit: V.


def wire_fields(kind: type) -> tuple[str, ...]:
    """Return the names of a message's or a part's own fields, in the order of their definition."""
    names: dict[str, Any] = kind.__dataclass_fields__  # type: ignore[attr-defined]
    return tuple(name for name in names if not name.startswith("_") and name != "fields")
