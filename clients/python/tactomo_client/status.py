"""How a daemon is, as it tells every second: a `Status`, with what STREAM.md has under that name.

Names, units and meanings are those of STREAM.md. What a daemon of another version does not send has
the default; what it sends beyond these names is in `Status.fields`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from tactomo_client.filled import Received

STALE_AFTER_S: Final = 3.0  #: a daemon sends its status every second


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Of durations, ms."""

    p50: float
    p99: float


@dataclass(frozen=True, slots=True)
class MagnitudeResponse:
    """The table by which a relative change of conductivity becomes a pressure."""

    pressure_kpa: tuple[float, ...]
    relative_change: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Calibration:
    """A pressure calibration: what it rests on, and how good it is."""

    taken: str = ""  #: ISO 8601, UTC
    readings: int = 0
    range_kpa: tuple[float, ...] = ()  #: between which two pressures it answers
    sigma_kpa: float | None = None  #: its own standard uncertainty: median over the range
    #: From where the channel answers; None where its lightest reading did already
    onset_kpa: float | None = None
    #: By how much falling loads read higher; None where that was not measured
    hysteresis_kpa: float | None = None
    device_ids: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Taught:
    """What presses at known places have taught a skin."""

    taken: str = ""  #: ISO 8601, UTC
    presses: int = 0
    median_mm: float | None = None  #: error of place on presses that were held out
    untaught_median_mm: float | None = None  #: the same of the physics alone


@dataclass(frozen=True, slots=True)
class SensorDescription:
    """The sensor: its sheet, its electrodes and what it answers to."""

    model: str = ""  #: the description's name, such as ``paper_square``
    sha256: str = ""
    file: str | None = None  #: on the daemon's computer; None for a shipped one
    shape: str = ""  #: ``rectangle`` or ``disc``
    width_mm: float | None = None
    height_mm: float | None = None
    sensing_width_mm: float | None = None  #: of the area that can be pressed, centred
    sensing_height_mm: float | None = None
    #: Centre of each electrode, x and y, electrode 0 first
    electrodes_mm: tuple[tuple[float, float], ...] = ()
    modalities: tuple[str, ...] = ()  #: ``magnitude``, ``structure``, or both
    magnitude_max: float | None = None  #: the top of a sensible colour scale for `Frame.map`
    pressure_max_kpa: float | None = None
    magnitude_response: MagnitudeResponse | None = None
    #: Of pressure, in force; None where pressures go by the description
    calibration: Calibration | None = None
    taught: Taught | None = None  #: in force; None where the physics alone says where contacts are


@dataclass(frozen=True, slots=True)
class Source:
    """Where scans come from: ``device``, ``twin``, ``replay`` or ``unknown``."""

    kind: str = "unknown"


@dataclass(frozen=True, slots=True)
class Device:
    """What a device says of itself."""

    device_id: str = ""
    firmware: str = ""
    channels: tuple[str, ...] = ()
    electrodes: int | None = None
    samples_per_scan: int | None = None
    scan_rate_hz: float | None = None


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """How the daemon knows a device's clock."""

    state: str = ""  #: ``settling``, ``settled``, ``unusable`` or ``absent``
    offset_ns: int | None = None  #: the daemon's monotonic clock less the device's
    rate_ppm: float | None = None  #: by how much the device's clock is slow
    delay_ms: Percentiles | None = None  #: how much later than need be scans come
    jumps: int = 0


@dataclass(frozen=True, slots=True)
class Port:
    """One port that the daemon reads."""

    url: str
    protocol: str = "tactomo"
    connected: bool = False  #: whether it is open at present
    #: ``closed``, ``starting``, ``running``, ``idle``, ``garbage``, ``silent``, ``refused`` or
    #: ``ended``
    state: str = ""
    problem: str | None = None  #: why it is closed or of no use, in words
    device: Device | None = None  #: None before the device's first hello
    bytes: int = 0
    packets: int = 0
    corrupt: int = 0  #: packets that were damaged on their way
    faulty: int = 0  #: intact packets that break the protocol
    #: By how much `packets`, `corrupt` and `faulty` have risen within it
    received_last_minute: Mapping[str, int] = field(default_factory=dict)
    refusal: str | None = None  #: why the device's scans are not used, if they are not
    unused_scans: int = 0
    reopened: int = 0  #: how often it was closed and opened because the device did not speak
    #: How long an FTDI adapter holds bytes back at most; None for any other port
    latency_timer_ms: int | None = None
    clock: DeviceClock | None = None


@dataclass(frozen=True, slots=True)
class Rates:
    """Per second; None for a channel that the sensor does not have."""

    magnitude_hz: float | None = None
    structure_hz: float | None = None
    frames_hz: float = 0.0


@dataclass(frozen=True, slots=True)
class ScanTally:
    """What became of every single scan since the start."""

    received: int = 0
    used: int = 0
    late: int = 0
    repeated: int = 0
    dropped: int = 0
    waiting: int = 0


@dataclass(frozen=True, slots=True)
class WallClock:
    """Whether the computer's clock was set while the daemon ran."""

    jumps: int = 0
    last_jump_s: float | None = None


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

    state: str = "off"  #: ``off``, ``waiting``, ``following``, ``held`` or ``refused``
    refusal: str | None = None  #: why it does not follow, in words
    moves: int = 0  #: how often the reference has moved since the tare
    drift: Mapping[str, ChannelDrift] = field(default_factory=dict)  #: by channel


@dataclass(frozen=True, slots=True)
class Plan:
    """What frames are given for the method and the budget that were asked for."""

    tier: str = ""
    modelled_ms: float | None = None  #: work, in milliseconds of a 2.5 GHz core
    #: Of the time that was asked for; less than 1 while others take the processor
    share: float = 1.0
    source: str = ""  #: where the measure between time and work comes from, in words


@dataclass(frozen=True, slots=True)
class Replay:
    """How far a replay is, and how it goes on: the control command ``replay`` changes that."""

    position_s: float  #: on the recording's own clock, seconds from its beginning
    duration_s: float
    speed: float  #: factor of the recorded speed; 0: as fast as frames are made
    paused: bool = False
    loop: bool = False
    waits_for_page: bool = False  #: whether it is paused until a viewer's page is open


@dataclass(frozen=True, slots=True)
class RecordingProgress:
    """The recording that runs."""

    path: str  #: on the daemon's computer
    bytes: int
    queued_bytes: int = 0  #: what waits for the disk


@dataclass(frozen=True, slots=True)
class Recorder:
    """Recordings since the daemon's start."""

    files: int = 0
    deleted: int = 0  #: files that were deleted to keep to the rules
    failures: int = 0
    failure: str | None = None  #: why the last recording did not go on; None once there is another
    #: Why a recording that is wanted does not run, until it begins again by itself
    waits_for: str | None = None


@dataclass(frozen=True, slots=True)
class Trouble:
    """The last event of a name that was no ``info``."""

    name: str
    severity: str
    detail: str
    next_step: str = ""
    realtime_ns: int | None = None  #: when, nanoseconds since 1970 (UTC)
    age_s: float | None = None  #: how long before the status


@dataclass(frozen=True, slots=True)
class EventCounts:
    """What happened since the daemon's start, for those who were not there."""

    counts: Mapping[str, int] = field(default_factory=dict)  #: how often, by the event's name
    troubles: tuple[Trouble, ...] = ()  #: newest first


@dataclass(frozen=True, slots=True)
class Process:
    """What the daemon takes of its computer."""

    pid: int
    cpu_s: float
    memory_bytes: int | None
    threads: int


@dataclass(frozen=True, slots=True)
class Status(Received):
    """How a daemon is; one comes every second, whether or not data do.

    A stale one: the daemon is gone, hangs, or cannot be reached.

    Example::

        status = Daemon().status()
        print(status.state, [port.problem for port in status.ports])
    """

    session: str = ""  #: changes when the daemon restarts; `sequence` starts anew then
    sequence: int = 0
    sensor: str = ""
    version: str = ""
    #: ``waiting_for_port``, ``waiting_for_data``, ``taring``, ``running``, ``late`` (scans come,
    #: frames lag) or ``stale``
    state: str = ""
    uptime_s: float = 0.0
    flags: frozenset[str] = frozenset()  #: the newest frame's, as are `tier` and `misfit`
    tier: str | None = None
    misfit: float | None = None
    description: SensorDescription | None = None
    source: Source = field(default_factory=Source)
    replay: Replay | None = None  #: None where the ports are live
    ports: tuple[Port, ...] = ()
    rates: Rates = field(default_factory=Rates)
    dropped_scans: int = 0  #: dual scans left out because newer ones had come
    incomplete_scans: int = 0  #: dual scans of which one channel did not come
    #: By how much `frames`, `dropped_scans` and `incomplete_scans` have risen within it
    last_minute: Mapping[str, int] = field(default_factory=dict)
    late_scans: int = 0
    scan_tally: ScanTally = field(default_factory=ScanTally)
    channel_skew_ms: Percentiles | None = None
    wall_clock: WallClock = field(default_factory=WallClock)
    reference: Reference | None = None  #: None before the first tare
    baseline: Baseline = field(default_factory=Baseline)
    #: For each stage of the pipeline
    stage_ms: Mapping[str, Percentiles] = field(default_factory=dict)
    latency_ms: Percentiles | None = None  #: from the last byte read to publication
    methods: tuple[str, ...] = ()  #: those that `Daemon.set_method` takes
    tier_requested: str = ""  #: the method that was asked for
    budget_ms: float | None = None  #: time that a frame may take; None: the method's own
    plan: Plan = field(default_factory=Plan)
    recording: RecordingProgress | None = None
    recorder: Recorder = field(default_factory=Recorder)
    subscribers: int = 0  #: subscriptions in force
    #: Scans that came since the start, by channel
    scans: Mapping[str, int] = field(default_factory=dict)
    frames: int = 0  #: frames published since the start
    events: EventCounts = field(default_factory=EventCounts)
    process: Process | None = None
