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

    #: The contact's identity: kept while it moves less than 25 mm from frame to frame, and through
    #: gaps of up to 5 frames. Where two contacts merge, the one nearer to the middle of both lives
    #: on. An identity that ended is not used again in this session
    id: int
    x_mm: float  #: Its centre, from the skin's middle to the right, seen from the pressed side
    y_mm: float  #: Its centre, from the skin's middle upwards
    area_mm2: float  #: Its area
    magnitude: float | None = None  #: |Δσ|/σ₀ inside it. Unit: ratio.
    magnitude_sigma: float | None = None  #: Standard uncertainty of `magnitude`. Unit: ratio.
    #: Pressure on it, a mean over its area; nil when unknown: see `pressure_range`
    pressure_kpa: float | None = None
    x_sigma_mm: float | None = None  #: Standard uncertainty of `x_mm`; nil where there is none
    y_sigma_mm: float | None = None  #: Standard uncertainty of `y_mm`; likewise
    area_sigma_mm2: float | None = None  #: Standard uncertainty of `area_mm2`; likewise
    #: Standard uncertainty of `pressure_kpa`: the magnitude's and, where the sensor was calibrated,
    #: the calibration's. Nil but ``within``
    pressure_sigma_kpa: float | None = None
    #: Pressure times area; or as `taught` by presses of known force. Also in ``below`` and
    #: ``unknown`` where the sheet answers from no pressure on and the highest is bounded: small and
    #: hard or large and light, the force is known. A lower bound of 95 % where it is ``above``
    force_n: float | None = None
    #: Standard uncertainty of `force_n`; nil where that is nil or a lower bound, and where the
    #: area's is not known; or as `taught`
    force_sigma_n: float | None = None
    #: ``within``: measured. ``below``: touched, but too lightly for the magnitude channel to
    #: answer; the pressure is unknown, and `pressure_kpa` nil. ``above``: may be beyond what the
    #: sensor answers to or was calibrated to (the upper bound of 95 % is); `pressure_kpa` is a
    #: lower bound of 95 %, at most that range's top, and `max_kpa` nil. ``unknown``: no magnitude
    #: channel, no response, or too uncertain to tell. Noise alone does not change it: near a border
    #: a contact stays in the range it was in. Take an absent one for ``unknown``
    pressure_range: str = "unknown"
    #: Highest pressure under it: above `pressure_kpa` where it is soft. Nil where unknown, a lower
    #: bound of 95 % where it is ``above``
    peak_kpa: float | None = None
    peak_sigma_kpa: float | None = None  #: Standard uncertainty of `peak_kpa`; nil but ``within``
    #: Upper bound of its highest pressure, 95 %, also where `pressure_range` is ``below`` or
    #: ``unknown``: what a light touch cannot exceed. Nil where nothing bounds it: no magnitude
    #: channel, no uncertainty, or ``above``
    max_kpa: float | None = None
    #: How the pressure falls to the edge, γ of (1 − ρ²)^γ: 0 flat, 0.5 as Hertz has it; nil where
    #: unknown
    edge: float | None = None
    #: Whether presses at known places say where it is (`tactomo teach`): `x_mm`, `y_mm` and their
    #: uncertainties are then what was learnt, and `force_n` where forces were
    taught: bool = False
    #: Where it is on the robot: its centre on the sheet's surface, in the frame `frame`. It, the
    #: normal and the frame are nil where the sensor description has no ``[mount]``
    position_m: tuple[float, float, float] | None = None
    #: Unit vector out of the sheet there, in the frame `frame`: what presses pushes against it
    normal: tuple[float, float, float] | None = None
    frame: str | None = None  #: Name of the robot's link that carries the sheet

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

    #: A new random value each time the daemon starts. When it changes, contact ids and `sequence`
    #: begin anew
    session: str
    #: Rises by one with each message of this kind in this session. A gap means that some were
    #: missed
    sequence: Unsigned
    #: When the dual scan was acquired (see below), on the wall clock of the daemon's computer: UTC
    #: since 1970. For ``status`` and ``event``, of the newest dual scan; nil before the first
    acquired_realtime_ns: int | None
    #: The same instant on that computer's ``CLOCK_MONOTONIC``, which nobody sets. Order and
    #: subtract these; the wall clock jumps
    acquired_monotonic_ns: int | None
    #: From then until the daemon had read the dual scan's last byte
    delay_ns: int | None = None
    #: ``device``: by the device's clock, so what buffers hold up is in the age. ``arrival``: that
    #: clock is not known well enough yet, or is none; what buffers hold up goes unseen
    dated_by: str | None = None
    #: Identity of that monotonic clock (on Linux the boot id, ``/proc/sys/kernel/random/boot_id``);
    #: may be empty
    clock_id: str = ""
    #: The same dual scan's time on the device's own clock, 0 to 2^53 − 1: the magnitude scan's,
    #: where there is one
    device_us: int | None
    #: The magnitude scan's time less the structure scan's. Exact where one device took both; nil
    #: where one is missing, or two devices' clocks are not known well enough yet
    skew_ms: float | None = None
    #: Time from ``acquired`` to publication: the age that the data already had when they left the
    #: daemon
    age_ns: int | None
    #: What made the frame: ``quiet`` (nothing pressed, nothing solved), ``tikhonov``, ``noser``,
    #: ``fit`` (a few contacts), ``levelset`` (a free form), ``network`` (a trained network alone),
    #: or another method by its name. Recordings of earlier versions may say ``hybrid``: outlines
    #: that were fitted, then redrawn by a second network
    tier: str | None
    tier_reason: str | None  #: Why, in words for people
    flags: frozenset[str]  #: What to be wary of; see Flags. Empty: nothing
    #: Rms of what the model left unexplained, in units of the measured noise. About 1 is good;
    #: above 2 the frame is flagged ``misfit_high``, and above 1.5 over both channels where ``auto``
    #: has a network stand in. (Not of a ``network`` that is sure, with a `confidence` of 0.9; of a
    #: linear tier, only above half of what the changes themselves are, too.) Of a ``quiet`` frame
    #: it is what told so: the changes in units of the noise and of the description's ``stability``
    #: (0.3 %), which skins reach by themselves; 1.24 (208 voltages) and more is not quiet
    misfit: float | None
    #: Correlation of the map with the truth that a network expects, 0 to 1; nil where no network
    #: made the map
    confidence: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contacts(Envelope):
    """What a ``contacts`` message has."""

    sensor: str
    acquired_realtime_ns: int
    acquired_monotonic_ns: int
    #: The dual scan's counter on the device (32 bits, wraps); the messages of one dual scan share
    #: it
    scan_counter: int
    #: What is pressed now. **None means that nothing is pressed**, if the message is not stale and
    #: all touches are seen (see Stale, or nothing pressed?)
    contacts: tuple[Contact, ...]
    #: Force of all contacts together: 0 where nothing is pressed, nil where one contact's is, a
    #: lower bound where one is ``above``
    force_n: float | None = None
    #: Standard uncertainty of that: less than the contacts' own make where they touch, for the
    #: errors of one are then another's. Nil where one contact's is, and where nothing is pressed
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
    #: The same as pressure; nil when the sensor has no magnitude channel or the method gives none.
    #: **0 only where nothing touches**; NaN where a contact does whose pressure is not known
    #: (`pressure_range` is ``below`` or ``unknown``); a lower bound where it is ``above``
    pressure_kpa: Image | None = None
    structure: Image | None = None  #: How surely each node is pressed, 0 to 1
    #: Position of the first and the last column. The nodes between are evenly spaced
    x_mm: tuple[float, float] | Absent = None
    y_mm: tuple[float, float] | Absent = None  #: Position of the first and the last row
    #: The top of a sensible colour scale for `map`. Unit: ratio.
    magnitude_max: float | None = None
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
    name: str  #: See below
    severity: str = "info"  #: ``info``, ``warning`` or ``error``
    detail: str = ""  #: What happened, in words
    next_step: str = ""  #: What to do about it, in words; may be empty


@dataclass(frozen=True, slots=True)
class EventKind:
    """How one kind of event is told."""

    severity: str  # ``info``, ``warning`` or ``error``
    # how long after one the next is told at the earliest; twice as long, up to a minute, while it
    # goes on. 0: each
    period_s: float = 0.0
    end: str = ""  # the event that says that it is over: until then it is told once


INFO: Final = EventKind("info")
WARNING: Final = EventKind("warning")
ERROR: Final = EventKind("error")
FREQUENT: Final = EventKind("warning", period_s=1.0)


class Events:
    """All events by name."""

    tared = INFO  #: A new reference is in force
    #: The reference was not taken: scans too uneven (somebody presses), or none came
    tare_refused = WARNING
    #: Something seems to lie on the skin, by the reference kept from before, which is used; or a
    #: tare was taken while contacts were shown: see the flag of this name
    reference_disputed = WARNING
    #: At the start neither drift nor contacts explain how the skin differs from the reference kept
    #: from before: another skin, it seems. The new reference is used
    skin_changed = WARNING
    #: The skin is at rest by the reference that was kept, or by the one before a disputed tare
    reference_confirmed = INFO
    #: The reference cannot be kept for the next start, or the one kept cannot be read
    reference_not_kept = EventKind("warning", period_s=600.0)
    #: What is seen is neither a contact that explains it nor a drift that skins reach, or might be
    #: either: the reference does not follow it. ``baseline`` in the status says it for as long as
    #: it lasts
    baseline_refused = EventKind("warning", period_s=600.0)
    #: One channel's scans stay out; maps go on from the other
    channel_lost = EventKind("warning", end="channel_back")
    channel_back = INFO  #: They come again
    #: One channel's scans repeat bit for bit while their counter goes on, though they had noise at
    #: the tare: they are left out as missing. One that is frozen all through the first tare cannot
    #: be told from a source without noise: `tactomo doctor` says that there is no noise at all
    converter_frozen = EventKind("warning", end="converter_back")
    converter_back = INFO  #: They are measured again
    #: A port was closed, unplugged, or cannot be opened; it is tried again
    port_lost = EventKind("error", end="port_back")
    port_back = INFO  #: It is open again
    corrupt_packets = FREQUENT  #: Packets on a port were damaged on their way
    #: Scans of a channel come after those that follow them, and are left out
    scans_disordered = FREQUENT
    scans_dropped = FREQUENT  #: Reconstruction lagged and dual scans were left out
    #: It lagged because others take the processor: frames get half as much time as before
    processor_shared = EventKind("warning", end="processor_free")
    processor_free = INFO  #: Frames get all of their time again
    method_failed = FREQUENT  #: A method of your own failed: the frame is ``tikhonov``'s
    #: A mistake in tactomo: no frame came of a dual scan
    reconstruction_failed = EventKind("error", period_s=1.0)
    device_restarted = FREQUENT  #: A device was reset: its scan counter and its clock went back
    #: The scan counter went back, the clock did not: someone asked for it
    counters_zeroed = EventKind("info", period_s=1.0)
    #: A device's clock jumped or went back; scans are dated by arrival until it is known again
    device_clock_jumped = FREQUENT
    #: A device's clock stands still or runs at an impossible rate; scans are dated by arrival
    device_clock_unusable = WARNING
    #: The two channels' counters are out of step: see the flag. Two boards are asked to zero them
    channels_skewed = EventKind("warning", end="channels_in_step")
    channels_in_step = INFO  #: They are in step again
    #: The computer's clock was set, or the computer slept. Only ``acquired_realtime_ns`` follows it
    wall_clock_jumped = WARNING
    #: A device's scans are not used: ``refusal`` of its port in the status says why
    device_refused = EventKind("error", period_s=1.0, end="device_speaks")
    #: A pressure calibration or a teaching is there and not used: it is damaged, or of another
    #: sensor, device or skin
    calibration_refused = WARNING
    #: The pressure calibration and the teaching were read again; what there is, is in force
    calibration_reloaded = INFO
    #: Another device is at a port than before, and is used. Tare if it has another skin
    device_changed = FREQUENT
    #: Nothing came over an open port for 3 s (or three periods of a slower device, or as long as
    #: its protocol allows). It is asked again; later the port is closed and opened, ever more
    #: rarely
    device_silent = EventKind("warning", period_s=30.0, end="device_speaks")
    #: Bytes come, but no packet for as long: the wrong baud rate, or no skin
    device_garbled = EventKind("warning", period_s=30.0, end="device_speaks")
    #: A device speaks, but sent no scan for as long, although it was asked to start
    device_idle = EventKind("warning", period_s=30.0, end="device_speaks")
    device_speaks = INFO  #: It is out of these troubles, or is understood again
    #: An FTDI adapter holds bytes back for long, and may not be told otherwise
    latency_timer = WARNING
    #: A device's packets are intact and break [its protocol](../firmware_protocol/PROTOCOL.md):
    #: another version, a field out of its range, scans unlike its *hello*. They are not used
    firmware_fault = EventKind("warning", period_s=30.0)
    #: A device speaks, and for 3 s has acknowledged no command
    command_unanswered = EventKind("warning", period_s=600.0)
    command_refused = WARNING  #: A device did not carry out a command of the daemon's
    recording_started = INFO
    recording_stopped = INFO
    #: A client whose key is not allowed tried to connect: from where, and its public key
    client_refused = FREQUENT
    #: A file in the list of clients holds no key; or others could add to the list, and nobody new
    #: is let in
    client_key_unusable = WARNING
    #: The disk is full, too slow or gone, or the file was deleted; the stream goes on
    recording_failed = ERROR
    recording_resumed = INFO  #: It goes on: there is room again, or the disk answers again
    #: The disk has not answered for 5 s; what comes waits in memory, up to 64 MiB
    recording_stalled = WARNING
    recording_rotated = INFO  #: It goes on in the next file
    rotation_failed = WARNING  #: The next file cannot be created: it goes on in the present one
    recording_deleted = INFO  #: An old file, to keep to ``keep_gb`` or ``keep_days``
    #: A mistake in tactomo: a message would have broken this page; ``sequence`` has the gap
    message_unsent = EventKind("error", period_s=1.0)
    connection_cut = FREQUENT  #: A connection sent 2 MB and more that made no message, and was cut
    #: There were more subscriptions than the daemon keeps (1 MiB), and all connections were cut
    subscribers_cut = WARNING
    replay_ended = INFO  #: The recording is at its end


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
    readings: int = 0  #: How many readings of a load cell it rests on
    #: Between which two pressures it answers; below, a contact is ``below``, beyond, ``above``
    range_kpa: tuple[float, ...] = ()
    #: Its own standard uncertainty: median over the range. A contact's `pressure_sigma_kpa` has it
    #: in it
    sigma_kpa: float | Absent = None
    #: From where the channel answers; nil where its lightest reading did already
    onset_kpa: float | None = None
    #: By how much a falling load reads higher than a rising one; nil where only one of the two was
    #: taken
    hysteresis_kpa: float | None = None
    #: The devices that it was made with; with others it is not in force. Empty: any
    device_ids: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Taught:
    """What presses at known places have taught a skin."""

    taken: str = ""  #: when, ISO 8601, UTC
    presses: int = 0
    median_mm: float | Absent = None  #: error of place on presses that were held out
    untaught_median_mm: float | Absent = None  #: the same of the physics alone


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
    sha256: str = ""  #: Of the description
    file: str | None = None  #: Its file on the daemon's computer; nil for a shipped one
    shape: str = ""  #: ``rectangle`` or ``disc``
    width_mm: float | Absent = None  #: Of the sheet's bounding box
    height_mm: float | Absent = None  #: Likewise
    sensing_width_mm: float | Absent = None  #: Of the area that can be pressed, centred
    sensing_height_mm: float | Absent = None  #: Likewise
    #: Centre of each electrode, x and y, electrode 0 first
    electrodes_mm: tuple[tuple[float, float], ...] = ()
    modalities: tuple[str, ...] = ()  #: The channels it has: ``magnitude``, ``structure``
    magnitude_max: float | None = None  #: As in ``map``. Unit: ratio.
    #: The top of the pressure response in force: the calibration's, else the description's
    pressure_max_kpa: float | None = None
    #: The table by which |Δσ|/σ₀ becomes a pressure (linear between its entries): the
    #: calibration's, else the description's
    magnitude_response: MagnitudeResponse | None = None
    #: The pressure calibration in force, see below; nil where pressures go by the description's
    #: table, or there is no magnitude channel. It, `pressure_max_kpa` and `magnitude_response` may
    #: change while the daemon runs
    calibration: Calibration | None = None
    #: What presses at known places have taught this skin, if that is in force; may change while the
    #: daemon runs
    taught: Taught | None = None
    #: Where the sheet lies on the robot; nil where the description does not say
    mount: Mount | None = None


@dataclass(frozen=True, slots=True)
class Source:
    """Where scans come from."""

    #: ``replay``, of a recording; ``twin``, where the *hello* says that the device is simulated;
    #: ``device``, any other, an emulator of a foreign protocol included: such protocols cannot say
    #: so; ``unknown`` before the first *hello*
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

    #: ``settling``, ``settled``, ``unusable`` (stands still, or its rate cannot be) or ``absent``
    #: (the protocol has none)
    state: str = ""
    offset_ns: int | None = None  #: the daemon's monotonic clock less the device's
    rate_ppm: float | None = None  #: by how much the device's clock is slow
    #: how much later than need be scans come; a bad hub shows here
    delay_ms: Percentiles | None = None
    jumps: int = 0


@dataclass(frozen=True, slots=True)
class Port:
    """One port that the daemon reads."""

    url: str  #: As configured
    #: What its device speaks: ``tactomo``, or that of other people's hardware
    protocol: str = "tactomo"
    connected: bool = False  #: Whether it is open at present
    #: ``closed`` (tried several times a second), ``starting`` (just opened), ``running``, ``idle``
    #: (the device speaks, but sends no scans, or none that its *hello* allows: for 3 s, or three of
    #: its own periods where it is slower), ``faulty`` (likewise, and what comes breaks the
    #: protocol), ``garbage`` (bytes, but none of the protocol: the wrong baud rate?), ``silent``
    #: (nothing), ``refused``, or ``ended`` (of a replay)
    state: str = ""
    problem: str | None = None  #: Why it is closed or of no use, in words
    device: Device | None = None  #: From the device's *hello*; nil before the first
    bytes: int = 0  #: Received
    packets: int = 0  #: Received
    corrupt: int = 0  #: Packets that were damaged on their way: the line's doing
    faulty: int = 0  #: Intact packets that break the protocol: the firmware's doing
    #: By how much `packets`, `corrupt` and `faulty` have risen within it
    received_last_minute: Mapping[str, int] = field(default_factory=dict)
    #: Why the device's scans are not used, if they are not: it does not fit the description, is
    #: none of the sensor's ``device_ids``, sends a channel that another port carries, or (of a
    #: foreign protocol) cannot be understood or refused its configuration
    refusal: str | None = None
    #: Scans that were not used: of an unknown or refused device, unlike its *hello*, or of a
    #: channel that the sensor does not have
    unused_scans: int = 0
    reopened: int = 0  #: How often it was closed and opened because the device did not speak
    #: How long an FTDI adapter holds bytes back at most; nil for any other port
    latency_timer_ms: int | None = None
    clock: DeviceClock | Absent = None  #: The device's clock


@dataclass(frozen=True, slots=True)
class Rates:
    """Per second; None for a channel that the sensor does not have."""

    magnitude_hz: float | None = None  #: scans that arrive; nil: the sensor has no such channel
    structure_hz: float | None = None  #: likewise
    frames_hz: float = 0.0  #: frames published


@dataclass(frozen=True, slots=True)
class ScanTally:
    """What became of every single scan since the start."""

    received: int = 0
    used: int = 0  #: in a frame
    late: int = 0  #: as in `late_scans`
    repeated: int = 0  #: had come before
    dropped: int = 0  #: newer ones had come, or an exact replay does not use them
    waiting: int = 0  #: for their partner or their turn


@dataclass(frozen=True, slots=True)
class WallClock:
    """Whether the computer's clock was set while the daemon ran."""

    jumps: int = 0  #: how often it was set
    last_jump_s: float | None = None  #: by how much, the last time


@dataclass(frozen=True, slots=True)
class Reference:
    """The unloaded scans that changes are measured against."""

    scans: int  #: dual scans that it is made of
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
    #: presses, ``held`` while something does, ``refused``: what is seen cannot be told from a
    #: contact, nor from drift
    state: str = "off"
    refusal: str | None = None  #: why, in words
    moves: int = 0  #: how often the reference has moved since the tare
    drift: Mapping[str, ChannelDrift] = field(default_factory=dict)  #: since the tare, by channel


@dataclass(frozen=True, slots=True)
class Plan:
    """What frames are given for the method and the budget that were asked for."""

    tier: str = ""  #: the method
    modelled_ms: float | None = None  #: work, in milliseconds of a 2.5 GHz core
    #: of the time that was asked for; less than 1 while others take the processor
    share: float = 1.0
    #: where the measure between time and work, this machine's speed, comes from, in words
    source: str = ""


@dataclass(frozen=True, slots=True)
class Replay:
    """How far a replay is, and how it goes on: the control command ``replay`` changes that."""

    position_s: float  #: on the recording's own clock, seconds from its beginning
    duration_s: float
    speed: float  #: factor of the recorded speed; 0: as fast as it is taken
    paused: bool = False
    loop: bool = False
    waits_for_page: bool = False  #: paused until a viewer's page is open


@dataclass(frozen=True, slots=True)
class RecordingProgress:
    """The recording that runs."""

    path: str  #: on the daemon's computer
    bytes: int  #: written
    queued_bytes: int = 0  #: that wait for the disk


@dataclass(frozen=True, slots=True)
class Recorder:
    """Recordings since the daemon's start."""

    files: int = 0  #: begun
    deleted: int = 0  #: files, to keep to the rules
    failures: int = 0
    failure: str | None = None  #: why the last recording did not go on, until there is another
    #: why a recording that is wanted does not run, until it begins again by itself
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
    #: newest first, at most 8: the last of each event that was no info
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
    cpu_s: float  #: processor time within `uptime_s`
    memory_bytes: int | None  #: resident
    threads: int


@dataclass(frozen=True, slots=True)
class Status(Received):
    """How a daemon is; one comes every second, whether or not data do.

    A stale one: the daemon is gone, hangs, or cannot be reached. What a daemon sends beyond these
    names is in `fields`.

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
    #: ``waiting_for_port`` (one is not open yet), ``waiting_for_data``, ``taring``, ``running``,
    #: ``late`` (scans come, and the newest frame is as old as if none did: reconstruction lags),
    #: ``stale`` (there were data, none come: for 1 s, or three periods of what is slower), or, of a
    #: replay, ``paused`` or ``ended``
    state: str = ""
    #: All that the daemon finds wrong at present, errors first; empty where all is well. Whoever
    #: shows how a sensor is prints these, and judges nothing but whether messages come
    issues: tuple[HealthIssue, ...] = ()
    uptime_s: float = 0.0  #: Since the daemon's start
    control: str = ""  #: Address of the control socket, as it is bound on the daemon's computer
    description: SensorDescription | Absent = None  #: The sensor, see below
    source: Source = field(default_factory=Source)  #: Where scans come from
    replay: Replay | None = None  #: Of a replay; nil where the ports are live
    ports: tuple[Port, ...] = ()  #: One for each port, see below
    rates: Rates = field(default_factory=Rates)  #: Per second
    dropped_scans: int = 0  #: Dual scans left out because newer ones had come
    #: Dual scans of which one channel did not come; one that has not come yet at all counts when it
    #: has not for 3 s
    incomplete_scans: int = 0
    #: By how much `frames`, `dropped_scans` and `incomplete_scans` have risen within it: what was
    #: long ago is over
    last_minute: Mapping[str, int] = field(default_factory=dict)
    #: Scans that came after their dual scan had gone on without them, and were left out
    late_scans: int = 0
    #: What became of every single scan since the start. Each is counted, so they add up but for the
    #: few scans that change places while they are read
    scan_tally: ScanTally = field(default_factory=ScanTally)
    channel_skew_ms: Percentiles | None = None  #: The size of `skew_ms`
    #: Whether the computer's clock was set while the daemon ran
    wall_clock: WallClock = field(default_factory=WallClock)
    reference: Reference | None = None  #: What changes are measured against; nil before a tare
    #: How the reference follows the skin's drift
    baseline: Baseline = field(default_factory=Baseline)
    #: For each stage of the pipeline
    stage_ms: Mapping[str, Percentiles] = field(default_factory=dict)
    latency_ms: Percentiles | None = None  #: From the last byte read to publication
    #: The methods that ``set_tier`` takes: ``auto``, those of tactomo, and others that were
    #: installed or named at the daemon's start
    methods: tuple[str, ...] = ()
    tier_requested: str = ""  #: The method that was asked for, one of `methods`
    budget_ms: float | None = None  #: Time that a frame may take; nil: the method's own
    plan: Plan = field(default_factory=Plan)  #: What frames are given for these two
    recording: RecordingProgress | None = None  #: Nil when nothing is recorded
    recorder: Recorder = field(default_factory=Recorder)  #: Since the start
    subscribers: int = 0  #: Subscriptions in force
    #: Scans that came since the start, by the name of each channel that the sensor has
    scans: Mapping[str, int] = field(default_factory=dict)
    frames: int = 0  #: Frames published since the start
    #: What happened since the start, for those who were not there
    events: EventCounts = field(default_factory=EventCounts)
    process: Process | Absent = None  #: What the daemon takes of its computer


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
