"""What `tactomo doctor` looks at: scans of a skin at rest, and what is known of how they came.

From a daemon that runs, from a recording, or from an .npz file. The report says how a file was
read, since a wrong order of the voltages looks like a broken device.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tactomo_client import Keys
from tactomo_client.connection import Connection
from tactomo_client.messages import MAP, SCAN, STATUS, array_from_wire, topic
from tactomo_client.schema import STALE_AFTER_S
from tactomo_models import DescriptionError, load_description
from tactomo_models.array_files import NUMBERS, bounded
from tactomo_models.arrays import FloatArray
from tactomo_models.health.findings import Finding, Level
from tactomo_models.scans.plausibility import Layout
from tactomo_models.sensor.description_file import shipped_descriptions
from tactomo_models.sensor.named_pattern import NamedPattern, fitting_patterns
from tactomo_models.sensor.pattern import PatternLayout, scan_pairs
from tactomo_protocol import SCAN_COUNTERS, Channel, Hello, Scan, ScanFlag

from tactomo.cli.sensors import listening, of_this_version
from tactomo.errors import TactomoError
from tactomo.recordings.imported_scans import AT_REST, is_single_ended, load_arrays, read_scans
from tactomo.recordings.recording import Recording
from tactomo.running import running
from tactomo.service.health_issues import (
    CABLE_STEP,
    CORRUPT_NOTED,
    DROPPED_NOTED,
    FEWEST_INCOMPLETE,
    FIRMWARE_STEP,
)

CHANGES = "dv"
ISSUE_LEVELS = {"error": Level.FAULT, "warning": Level.ADVICE}
ANY_RING = "tank_disc"  # stands for a sheet that nobody has described, while its file is read


class Heard(NamedTuple):
    """How scans came in over the ports while they were examined."""

    packets: int  # packets that came
    corrupt: int  # packets that were damaged on their way
    faulty: int  # intact ones that break the protocol
    lost: int  # dual scans that the device took and nobody received, by gaps in the counter


@dataclass(frozen=True)
class Scans:
    """The scans of one channel."""

    volts: FloatArray  # (T, M)
    times_s: FloatArray | None  # (T,) when taken, on the device's clock; None where unknown
    saturated: int = 0  # how many of them the device called clipped


@dataclass
class Evidence:
    """What was gathered."""

    title: str  # of what
    layout: Layout  # the sensor's description, or a pattern alone
    scans: dict[str, Scans]  # of each channel
    heard: Heard | None = None  # how they came; None for a file of arrays
    left_out: int = 0  # dual scans that came and that the daemon left out meanwhile
    issues: tuple[Finding, ...] = ()  # what the daemon itself found wrong
    devices: tuple[str, ...] = ()  # their ids
    flags: frozenset[str] = frozenset()  # those that any frame had
    pressed: int = 0  # frames with a contact
    frames: int = 0  # frames that came
    notes: tuple[str, ...] = ()  # how it was read, for people


def of_daemon(
    sensor: str,
    stream: str,
    seconds: float,
    description: str | None,
    keys: Keys | None,
    progress: Callable[[float], None],
) -> Evidence:
    """Listen to a daemon; raise TactomoError where none answers, or it has no scans."""
    said: dict[str, list[dict[str, Any]]] = {MAP: [], SCAN: [], STATUS: []}
    with listening(stream, [topic(sensor, kind) for kind in said], keys) as connection:
        before = _first_status(connection, f"{stream} for a sensor {sensor!r}")
        begin_s = time.monotonic()
        while (passed_s := time.monotonic() - begin_s) < seconds:
            progress(passed_s)
            for message in connection.heard(min(0.2, seconds - passed_s)):
                said[message.kind].append(message.fields)
    is_ours = any(each.stream == stream for each in running("daemon"))
    with of_this_version():
        evidence = evidence_of_messages(said, [before, *said[STATUS]], description, is_ours)
        evidence.title += f", for {seconds:g} s"
    return evidence


def evidence_of_messages(
    said: Mapping[str, list[dict[str, Any]]],  # messages by their kind
    statuses: list[dict[str, Any]],  # from the one before on
    description: str | None,
    is_ours: bool,  # whether files that the status names may be opened
) -> Evidence:
    """Return what a daemon's messages tell; raises as data of other types do."""
    before, after = statuses[0], statuses[-1]
    maps, scans = said["map"], said["scan"]
    if not scans:
        raise TactomoError(
            f"the daemon of {after['sensor']} is {after['state']} and has no scans to examine",
            "`tactomo status` says what is wrong",
        )
    layout, notes = _layout_of_status(after, description, is_ours)
    heard = _heard_of_messages(scans, before, after)
    title = f"the daemon of {after['sensor']}"
    evidence = Evidence(title, layout, _scans_of_messages(scans), heard)
    evidence.notes = notes
    evidence.left_out = int(after["dropped_scans"] - before["dropped_scans"])
    evidence.issues = tuple(
        Finding("daemon", ISSUE_LEVELS[each["severity"]], each["what"], each["next_step"])
        for each in after.get("issues") or []
    )
    devices = (port["device"] for port in after["ports"])
    evidence.devices = tuple(each["device_id"] for each in devices if each)
    evidence.frames = len(maps)
    evidence.flags = frozenset(flag for frame in maps for flag in frame["flags"])
    evidence.pressed = sum(bool(frame["contacts"]) for frame in maps)
    return evidence


def _first_status(connection: Connection, where: str) -> dict[str, Any]:
    """Wait for a status; what came before it is forgotten."""
    end_s = time.monotonic() + STALE_AFTER_S
    while (left_s := end_s - time.monotonic()) > 0:
        for message in connection.heard(left_s):
            if message.kind == "status":
                return message.fields
    raise TactomoError(f"no daemon answers at {where}", "`tactomo status` shows its state")


def _layout_of_status(
    status: Mapping[str, Any], description: str | None, is_ours: bool
) -> tuple[Layout, tuple[str, ...]]:
    said = status["description"]
    file = said.get("file")
    try:
        is_file = file is not None or said["model"] not in shipped_descriptions()
        if description is None and is_file and not is_ours:
            raise DescriptionError(f"{file or said['model']}: a path that another program gave")
        known = load_description(description or file or said["model"])
    except DescriptionError:
        if description is not None:
            raise
        electrodes = len(said["electrodes_mm"])
        note = f"the description {said['model']} is not here: give --description; adjacent pairs"
        return PatternLayout(scan_pairs(electrodes), electrodes), (note,)
    if known.sha256 != said["sha256"]:
        raise TactomoError(
            f"the daemon's sensor {said['model']} is not the description {known.name} that is here",
            "give the daemon's own with --description",
        )
    return known, ()


def _scans_of_messages(messages: list[dict[str, Any]]) -> dict[str, Scans]:
    scans = {}
    for channel in Channel:
        there = [m for m in messages if m[channel] is not None]
        if there:
            volts = np.array([array_from_wire(m[channel]) for m in there])
            times = [(m["device_us"], m["acquired_monotonic_ns"]) for m in there]
            scans[str(channel)] = Scans(volts, _times(times))
    return scans


def _times(of_scans: list[tuple[int, int]]) -> FloatArray:
    """When scans were taken, s from the first: by the device's clock (µs), or ours (ns) without."""
    times = np.array(of_scans, dtype=np.float64)
    device_s, ours_s = ((times - times[0]) * (1e-6, 1e-9)).T
    return np.asarray(device_s if device_s.any() else ours_s)


def _heard_of_messages(
    messages: list[dict[str, Any]], before: Mapping[str, Any], after: Mapping[str, Any]
) -> Heard:
    def rise(count: str) -> int:
        was, now = (sum(port[count] for port in each["ports"]) for each in (before, after))
        return int(now - was)

    dropped = after["dropped_scans"] - before["dropped_scans"]
    counters = [m["scan_counter"] for m in messages]
    lost = max(0, _gaps(counters) - dropped)
    return Heard(rise("packets"), rise("corrupt"), rise("faulty"), lost)


def _gaps(counters: list[int]) -> int:
    """Scans missing between the first and the last; a counter that goes back starts anew."""
    steps = np.mod(np.diff(np.array(counters, dtype=np.int64)), SCAN_COUNTERS)
    return int((steps[(steps > 0) & (steps < SCAN_COUNTERS // 2)] - 1).sum())


def of_recording(recording: Recording, description: str | None, frames: slice | None) -> Evidence:
    """Read a recording's ports; `description` is its own if None.

    Raises TactomoError where there are no scans in it.
    """
    known = load_description(description) if description else recording.origin.read_description()
    ports = [_scans_of_port(recording, n) for n in range(len(recording.origin.ports))]
    scans = {}
    for channel in known.channels:
        taken = [each for port in ports for each in port if each.scan.channel is channel]
        taken = taken if frames is None else taken[frames]
        if taken:
            scans[str(channel)] = Scans(
                np.array([each.volts for each in taken]),
                _times([(each.scan.device_us, each.arrived_ns) for each in taken]),
                sum(bool(each.scan.flags & ScanFlag.SATURATED) for each in taken),
            )
    if not scans:
        raise TactomoError(
            f"there are no scans of {known.name} in {recording.path}"
            + (" among these --frames" if frames else ""),
            "`tactomo info` shows what is in it; it may need another --description",
        )
    evidence = Evidence(str(recording.path), known, scans)
    evidence.heard = _heard_on_ports(recording, ports)
    if not recording.summary.is_complete:
        evidence.notes = ("the recording was cut off: the rest was read",)
    return evidence


class _Taken(NamedTuple):
    scan: Scan
    volts: FloatArray
    arrived_ns: int


def _scans_of_port(recording: Recording, port: int) -> list[_Taken]:
    hello: Hello | None = None
    scans: list[_Taken] = []
    for clock_ns, packet in recording.packets(port):
        if isinstance(packet, Hello):
            hello = packet
        elif isinstance(packet, Scan) and hello is not None:
            volts = bounded(packet.volts(hello.volts_per_count))
            scans.append(_Taken(packet, volts, clock_ns))
    return scans


def _heard_on_ports(recording: Recording, ports: list[list[_Taken]]) -> Heard:
    lost = [
        _gaps([taken.scan.counter for taken in port if taken.scan.channel is channel])
        for port in ports
        for channel in Channel
    ]
    summary = recording.summary
    return Heard(summary.packets, summary.corrupt, summary.faulty, max(lost, default=0))


def of_arrays(
    path: Path,  # the file
    # of the sensor that was measured; its pattern alone is worked out if None
    description: str | None,
    # name of the array of scans at rest, where the layout is neither of import's
    array: str | None,
    pattern: str | None,  # the order of its voltages; the description's, or what fits, if None
    frames: slice | None,  # which scans; all if None
) -> Evidence:
    """Read a file of arrays as `tactomo reconstruct` does; see `tactomo doctor --help`.

    Raises TactomoError or DataError where it cannot be read or examined, or its
    scans fit no description or pattern.
    """
    arrays = load_arrays(path)
    is_batch = array is None and bool(arrays.keys() & set(Channel))
    if array is None and not (is_batch or is_single_ended(arrays)):
        array = _at_rest(path, arrays)
    named = None if pattern is None else NamedPattern.of_name(pattern)
    layout: Layout
    names: tuple[str, ...]
    if description is not None or is_batch:
        sensor = load_description(description or "paper_square")
        layout = sensor = sensor if named is None else named.applied(sensor)
        names, how = sensor.channels, f"read as scans of {sensor.name}"
    else:
        named = named or _fitting_pattern(path, arrays, array)
        sensor, layout = named.applied(load_description(ANY_RING)), named.layout
        names, how = (array or "volts",), f"read as {named}; no description of the sheet"
    del arrays  # else all scans are in memory twice
    read = read_scans(path, sensor, sensor.channels[-1], array=array, pattern=named)
    which = frames or slice(None)
    times_s = None if read.time_s is None else read.time_s[which]
    scans = {}
    for channel, volts in read.volts.items():
        if not len(volts[which]):
            raise TactomoError(
                f"{path} has {len(volts)} scans, none of these", "give other --frames"
            )
        scans[channel if channel in names else names[0]] = Scans(volts[which], times_s)
    return Evidence(str(path), layout, scans, notes=(how, *read.notes))


def _at_rest(path: Path, arrays: Mapping[str, NDArray[Any]]) -> str:
    name = next((known for known in (*AT_REST, NUMBERS) if known in arrays), None)
    if name is not None:
        return name
    if CHANGES in arrays:
        raise TactomoError(
            f"{path} holds changes of voltages ({CHANGES}) and no scans at rest: noise and "
            "reciprocity belong to voltages",
            "name an array of scans of the unpressed sheet with --array",
        )
    held = ", ".join(arrays) or "nothing"
    raise TactomoError(f"{path} holds {held}", "name the array of scans at rest with --array")


def _fitting_pattern(
    path: Path, arrays: Mapping[str, NDArray[Any]], array: str | None
) -> NamedPattern:
    """Work out the pattern of scans whose sheet nobody has described."""
    if array is None:  # of single-ended readings, by where the current went
        injection, electrodes = arrays["injection"].astype(int), arrays["volts"].shape[-1]
        offsets = (injection[:, 1] - injection[:, 0]) % electrodes
        offset = int(np.median(np.minimum(offsets, electrodes - offsets)))
        return NamedPattern(electrodes, max(1, offset), 1)
    if array not in arrays:
        raise TactomoError(f"{path} holds {', '.join(arrays)}", f"there is no array {array!r}")
    raw = np.atleast_2d(arrays[array])
    if raw.ndim != 2 or raw.dtype.kind not in "fiuc" or raw.size == 0:
        raise TactomoError(
            f"{path}: {array} is {raw.dtype} {raw.shape}", "it must be numbers, (T, voltages)"
        )
    count = raw.shape[1]
    electrodes = round((3 + np.sqrt(9 + 4 * count)) / 2)
    adjacent = [NamedPattern(electrodes, 1, 1)] * (electrodes * (electrodes - 3) == count)
    found = [*fitting_patterns(np.abs(raw) if raw.dtype.kind == "c" else raw), *adjacent]
    if not found:
        raise TactomoError(
            f"{path}: {array} has {count} voltages a scan, which fit no pattern",
            "give --description or --pattern, such as 16:opposite:adjacent",
        )
    return found[0]


LATE_SHARE = 0.5  # what a busy computer does to fewer is advice: most frames are in time


def stream_findings(evidence: Evidence) -> list[Finding]:
    """Return what was found about line and frames; empty for a file of arrays."""
    found: list[Finding] = []
    if evidence.heard is not None:
        found += [_packets_found(evidence.heard), _lost_found(evidence, evidence.heard.lost)]
    if evidence.frames:
        found.append(_pressed_found(evidence))
    return [*found, *evidence.issues]


def _packets_found(heard: Heard) -> Finding:
    total = heard.packets + heard.corrupt + heard.faulty
    share = heard.corrupt / max(total, 1)
    level, words, step = Level.OK, f"{heard.packets}, none damaged", ""
    if heard.faulty > heard.corrupt:
        words = f"{heard.faulty} of {total} are intact and break the protocol"
        level, step = Level.FAULT, FIRMWARE_STEP
    elif heard.corrupt:
        words = f"{heard.corrupt} of {total} came damaged ({share:.2%})"
        level, step = Level.FAULT if share > CORRUPT_NOTED else Level.ADVICE, CABLE_STEP
    counts = {"packets": heard.packets, "corrupt": heard.corrupt, "faulty": heard.faulty}
    return Finding("packets", level, words, step, {k: float(n) for k, n in counts.items()})


def _lost_found(evidence: Evidence, lost: int) -> Finding:
    count = max(len(scans.volts) for scans in evidence.scans.values())
    figures: dict[str, Any] = {"number": float(lost)}
    if not lost:
        return Finding("lost_scans", Level.OK, f"none of {count} dual scans", "", figures)
    # Scans that came and were left out tell that the computer was busy: then others may have been
    # lost for the same reason, and nothing is known against cable and board.
    is_busy = evidence.left_out > DROPPED_NOTED * count
    share = lost / (count + lost)
    is_fault = share > (LATE_SHARE if is_busy else DROPPED_NOTED) and lost >= FEWEST_INCOMPLETE
    words = f"{lost} of {count + lost} dual scans ({share:.1%}) did not arrive"
    step = "is the line too slow for the rate, or the computer too busy?"
    if is_busy:
        step = "the computer is busy: repeat when the computer is idle"
    return Finding("lost_scans", Level.FAULT if is_fault else Level.ADVICE, words, step, figures)


def _pressed_found(evidence: Evidence) -> Finding:
    figures: dict[str, Any] = {"frames": float(evidence.frames), "pressed": float(evidence.pressed)}
    if not evidence.pressed:
        return Finding("frames", Level.OK, f"{evidence.frames}, nothing pressed", "", figures)
    words = f"something presses in {evidence.pressed} of {evidence.frames} frames"
    step = "leave the skin alone while it is examined; if nothing touches it, run `tactomo tare`"
    return Finding("frames", Level.ADVICE, words, step, figures)
