"""Recordings: what the ports said, with times, in one MCAP file; its layout, and reading it.

docs/files.md has the topics and their fields. Messages are in the order in which they were written,
and that order is what counts. A recording that is cut into several files says all in each: any of
them can be replayed alone. At a cut, the ports' bytes go into both files until the pipeline has
come over to the new one, so every dual scan lies whole in the file that has its mark.

The file of a daemon that was killed ends somewhere in its last chunk. Everything here reads with
MCAP's streaming reader, so such a file opens like any other, up to its last complete chunk. What
lies beyond damage in the middle is for `recovery`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final, NamedTuple
from urllib.parse import quote

from mcap.records import Chunk as McapChunk
from mcap.records import Footer, McapRecord, Message, Metadata
from tactomo_client import recording_file
from tactomo_client.errors import RecordingError as ClientRecordingError
from tactomo_client.recording_file import messages_beyond
from tactomo_models.errors import DescriptionError
from tactomo_protocol import Channel, Hello, Packet, Scan

from tactomo.errors import ConfigError, RecordingError
from tactomo.protocols import NATIVE, PortProtocol, protocol_named
from tactomo.recordings.record_fields import read_reference_number
from tactomo.scans import FrameRecord

if TYPE_CHECKING:  # `tactomo info` starts in half the time without
    from tactomo_models import Reference, SensorDescription

RECOVERED: Final = "tactomo-recovered"
REPLAY_SCHEME: Final = "replay"
GIVE_DESCRIPTION: Final = "give the description's file by --description"
PREAMBLE_REACH_NS: Final = 2_000_000_000
"""How long a preamble is of use to a replay that begins after it: those of foreign protocols come
every second, and one of ours is not needed by a port that knows its device."""


class Chunk(NamedTuple):
    """Bytes that one read of a port returned, and when, on the recording's steady clock."""

    clock_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Origin:
    """What a recording is of."""

    sensor: str = ""
    # the shipped description's name, or its path on the computer that recorded
    description: str = ""
    description_sha256: str = ""
    ports: tuple[str, ...] = ("",)
    version: str = ""
    protocol: str = NATIVE  # what the ports speak
    calibration: str = ""
    """The pressure calibration that the daemon began it with, as the text of its file; empty for
    none."""
    description_text: str = ""
    """The description itself, as `carried_text` has it; empty for a shipped one."""

    def read_description(self) -> SensorDescription:
        """Return the sensor description that the recording carries, or that is shipped.

        Raises RecordingError where it does neither: what it names by a path is not opened.
        """
        from tactomo_models.sensor.description_file import (
            load_description,
            parse_description,
            shipped_descriptions,
        )

        try:
            if self.description_text:
                return parse_description(self.description_text, "the recorded description")
            if self.description in shipped_descriptions():
                return load_description(self.description)
        except DescriptionError as error:
            raise RecordingError(str(error), GIVE_DESCRIPTION) from error
        raise RecordingError(
            f"the recording's sensor description, {self.description or 'of no name'}, is neither "
            "in it nor shipped",
            GIVE_DESCRIPTION,
        )

    def new_protocol(self) -> PortProtocol:
        """Return what turns a port's bytes into packets.

        Raises RecordingError where it is not known here, or needs a description that is not here.
        """
        try:
            known = None if self.protocol == NATIVE else self.read_description()
            return protocol_named(self.protocol, known)
        except ConfigError as error:
            raise RecordingError(
                f"the recording is of protocol {self.protocol} and cannot be understood: {error}",
                "install what brings that protocol",
            ) from error


@dataclass(slots=True)
class Summary:
    """What is in a recording, counted by reading all of it."""

    origin: Origin
    file_bytes: int
    is_complete: bool = False
    """False where the file ends in the middle: its writer was killed, or the disk was full."""
    has_more: bool = False
    """Whether intact data lie beyond the damage that ends it here: `tactomo recover` gets them."""
    recovered_gaps: int | None = None
    """How many gaps `tactomo recover` had to leave in it; None for a recording as it was made."""
    start_ns: int = 0  # when the first byte was read, nanoseconds since 1970, on the steady clock
    end_ns: int = 0
    port_bytes: dict[int, int] = field(default_factory=dict)
    scans: dict[Channel, int] = field(default_factory=dict)
    hellos: dict[Hello, None] = field(default_factory=dict)
    """The distinct ones as keys, in the order in which they were heard."""
    packets: int = 0  # that came intact over the ports
    corrupt: int = 0  # frames on the ports that were damaged
    faulty: int = 0  # intact ones that break the protocol
    frames: int = 0  # dual scans that the daemon reconstructed while it recorded
    references: int = 0

    @property
    def duration_s(self) -> float:
        """Seconds from the first bytes read to the last ones."""
        return (self.end_ns - self.start_ns) * 1e-9

    @property
    def ending(self) -> str:
        """How the file ends, in words; empty where it is whole."""
        if self.is_complete:
            return ""
        if self.has_more:
            return "damaged, with intact data beyond; `tactomo recover` gets them"
        return "cut off; `tactomo recover` makes it whole for other tools"


class Recording:
    """A recording opened for reading; every call reads the file anew, from its start."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with _our_errors():
            self.origin = to_origin(recording_file.read_metadata(path))

    @cached_property
    def summary(self) -> Summary:
        """What is in it, counted by reading all of it once."""
        return _summarise(self.path, self.origin)

    @cached_property
    def span(self) -> recording_file.Span:
        """When it began and ended, without reading what is in it."""
        with _our_errors():
            return recording_file.read_span(self.path)

    @cached_property
    def start_ns(self) -> int:
        """When the first bytes were read from any port, on the steady clock; 0 if none were."""
        times = (m.log_time for topic, m in _messages(self.path) if topic.startswith("port/"))
        return next(times, 0)

    @property
    def end_ns(self) -> int:
        """When the last thing in it was written, on the steady clock."""
        return self.span.end_ns

    def chunks(self, port: int, from_ns: int = 0) -> Iterator[Chunk]:
        """Yield what port `port` said from a time on; before all else a preamble, if there is one.

        What came between the preamble and that time comes with it, at that time.
        """
        topics = (f"port/{port}", f"port/{port}/hello")
        before: list[Message] = []  # from the last preamble on
        for topic, message in _messages(self.path, from_ns - PREAMBLE_REACH_NS):
            if topic not in topics:
                continue
            if message.log_time >= from_ns:
                for each in (*before, message):
                    yield Chunk(max(each.log_time, from_ns), each.data)
                before = []
            elif topic == topics[1]:
                before = [message]
            elif before and message.log_time - before[0].log_time < PREAMBLE_REACH_NS:
                before.append(message)
            else:
                before = []

    def packets(self, port: int) -> Iterator[tuple[int, Packet]]:
        """Yield what port `port` said, decoded, each packet with its time as `Chunk` has it."""
        protocol = self.origin.new_protocol()
        for clock_ns, data in self.chunks(port):
            for packet in protocol.feed(data):
                yield clock_ns, packet

    def marks(self) -> list[FrameRecord]:
        """Return the dual scans that were reconstructed, each with what was new just before it."""
        from tactomo.recordings.records import read_calibration, read_frame, read_reference

        marks: list[FrameRecord] = []
        reference: Reference | None = None
        calibration: str | None = None
        number: int | None = None
        for topic, message in _messages(self.path):
            if topic == "reference":
                before, number = number, read_reference_number(message.data)
                if number is None or number != before:  # else it is repeated
                    reference = read_reference(message.data)
            elif topic == "calibration":
                calibration = read_calibration(message.data).text
            elif topic == "frame":
                mark = read_frame(message.data)
                at_ns = message.log_time
                marks.append(
                    replace(mark, reference=reference, calibration=calibration, clock_ns=at_ns)
                )
                reference = calibration = None
        return marks

    def first_reference(self) -> Reference | None:
        """Return the reference in force when the recording began; None where none was taken."""
        from tactomo.recordings.records import read_reference

        data = (m.data for topic, m in _messages(self.path) if topic == "reference")
        first = next(data, None)
        return None if first is None else read_reference(first)

    def replay_urls(
        self,
        speed: float = 1.0,  # 1 as recorded, 10 ten times as fast, 0 as fast as it is taken
    ) -> tuple[str, ...]:
        """Return the serial URLs that say again what each port said."""
        path = quote(str(self.path.resolve()))
        ports = range(len(self.origin.ports))
        return tuple(f"{REPLAY_SCHEME}://{path}?port={n}&speed={speed:g}" for n in ports)


def is_replayed(urls: Iterable[str]) -> bool:
    """Whether any of a daemon's ports replays a recording."""
    return any(url.startswith(f"{REPLAY_SCHEME}:") for url in urls)


def open_recording(path: str | Path) -> Recording:
    """Open a recording, whole or cut off; raise RecordingError where it is none of tactomo's."""
    return Recording(Path(path))


def _summarise(path: Path, origin: Origin) -> Summary:
    """Read a whole recording; its decoders are the daemon's own."""
    summary = Summary(origin, path.stat().st_size)
    decoders: defaultdict[int, PortProtocol] = defaultdict(origin.new_protocol)
    references: set[int | None] = set()
    stops: list[int] = []
    for topic, record in _records(path, stops.append):
        if isinstance(record, Footer):
            summary.is_complete = True
        elif isinstance(record, Metadata) and record.name == RECOVERED:
            gaps = record.metadata.get("gaps", "")
            summary.recovered_gaps = int(gaps) if gaps.isdecimal() and len(gaps) < 10 else 0
        elif isinstance(record, Message):
            kind, _, rest = topic.partition("/")
            summary.frames += kind == "frame"
            if kind == "reference":
                references.add(read_reference_number(record.data))
            if kind == "port" and topic in recording_file.CHANNELS:
                number, _, extra = rest.partition("/")
                if not extra:
                    _count_bytes(summary, int(number), record)
                _count_packets(summary, decoders[int(number)], record.data)
    counts = [decoder.counts for decoder in decoders.values()]
    summary.packets = sum(each.packets for each in counts)
    summary.corrupt = sum(each.damaged for each in counts)
    summary.faulty = sum(each.faulty for each in counts)
    summary.references = len(references)
    summary.has_more = bool(stops) and any(True for _ in messages_beyond(path, stops[0]))
    return summary


def _count_bytes(summary: Summary, port: int, message: Message) -> None:
    summary.port_bytes[port] = summary.port_bytes.get(port, 0) + len(message.data)
    summary.start_ns = summary.start_ns or message.log_time
    summary.end_ns = max(summary.end_ns, message.log_time)


def _count_packets(summary: Summary, decoder: PortProtocol, data: bytes) -> None:
    for packet in decoder.feed(data):
        if isinstance(packet, Scan):
            summary.scans[packet.channel] = summary.scans.get(packet.channel, 0) + 1
        elif isinstance(packet, Hello):
            summary.hellos[packet] = None


def to_origin(metadata: Mapping[str, str]) -> Origin:
    """Return what a recording's metadata record says that it is of."""
    told: dict[str, Any] = {f.name: metadata[f.name] for f in fields(Origin) if f.name in metadata}
    return Origin(**told | {"ports": tuple(metadata.get("ports", "").split("\n"))})


def _messages(path: Path, from_ns: int = 0) -> Iterator[tuple[str, Message]]:
    """Yield messages; of those before `from_ns` only some."""
    wants = lambda chunk: chunk.message_end_time >= from_ns  # noqa: E731 - one use, one line
    for topic, record in _records(path, wants=wants):
        if isinstance(record, Message):
            yield topic, record


def _records(
    path: Path,
    on_damage: Callable[[int], None] = lambda _: None,
    wants: Callable[[McapChunk], bool] = lambda _: True,
) -> Iterator[tuple[str, McapRecord]]:
    with _our_errors():
        yield from recording_file.records(path, on_damage, wants)


def open_file(path: Path) -> IO[bytes]:
    """Open a recording's file as it is; raise RecordingError where that cannot be done."""
    with _our_errors():
        return recording_file.open_file(path)


@contextmanager
def _our_errors() -> Iterator[None]:
    """Turn the client's error into ours, which is also an answer to a command."""
    try:
        yield
    except ClientRecordingError as error:
        raise RecordingError(error.cause, error.next_step) from error
