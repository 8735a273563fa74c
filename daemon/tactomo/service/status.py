"""What a `status` message says: how each part of the daemon is, gathered when it is asked for."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from tactomo_models import SensorDescription
from tactomo_protocol import Channel

from tactomo.acquisition.port import PortReader
from tactomo.events import EventBook
from tactomo.imaging.frames import description_fields, port_fields, pressure_fields, taught_fields
from tactomo.imaging.imaging import Imaging
from tactomo.imaging.pipeline import Pipeline
from tactomo.memory import resident_bytes
from tactomo.recordings.recorder import Recorder
from tactomo.recordings.recording import is_replayed
from tactomo.recordings.replay import Playback
from tactomo.service.health_issues import health_issues
from tactomo.stream.control import Control
from tactomo.stream.publisher import Publisher
from tactomo.timing import LastMinute

VERSION: Final = version("tactomo")  # read from a file, which may fail later
STALE_S: Final = 1.0
"""How old the newest dual scan may be before the daemon says that there are no data any more; where
they come more slowly, a few of their periods."""


@dataclass
class Status:
    """Reads the other parts, from any thread; nothing is written to them."""

    _sensor: SensorDescription
    _file: Path | None  # of the description; None for a shipped one
    _ports: list[PortReader]
    _pipeline: Pipeline
    _imaging: Imaging
    _recorder: Recorder
    _events: EventBook
    _methods: Sequence[str]
    _playback: Playback | None
    _publisher: Publisher
    _control: Control

    def __post_init__(self) -> None:
        file = self._file and str(self._file)
        self._description = {**description_fields(self._sensor), "file": file}
        self._started_s = time.monotonic()
        self._started_cpu_s = time.process_time()  # what came before took part of another time
        self._last_minute = LastMinute()
        self._ports_last_minute = {port.url: LastMinute() for port in self._ports}

    def fields(self, header: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields of a `status` message with that header."""
        fields = self._fields()
        issues = health_issues({**header, **fields})
        return {**fields, "issues": [asdict(issue) for issue in issues]}

    def _fields(self) -> dict[str, Any]:
        pipeline, imaging = self._pipeline, self._imaging
        active = self._recorder.active
        rest, taught = imaging.rest, imaging.calibration.taught
        stages = {stage: times.percentiles_ms() for stage, times in imaging.stages.items()}
        losses = {
            "frames": imaging.frame_rate.count,
            "dropped_scans": pipeline.dropped,
            "incomplete_scans": pipeline.incomplete,
        }
        return {
            "version": VERSION,
            "state": self.state(),
            "uptime_s": time.monotonic() - self._started_s,
            "control": self._control.address,
            "description": {
                **self._description,
                **pressure_fields(self._sensor, imaging.calibration.in_force),
                "taught": taught and taught_fields(taught),
            },
            "source": {"kind": source(self._ports)},
            "replay": None if self._playback is None else self._playback.fields(),
            "ports": [self._port(port) for port in self._ports],
            "rates": self._rates(),
            "scans": pipeline.received,
            **losses,
            "last_minute": self._last_minute.rise(losses),
            "late_scans": pipeline.sync.late,
            "scan_tally": pipeline.tally(),
            "channel_skew_ms": pipeline.skew.sizes.percentiles_ms(),
            "wall_clock": {
                "jumps": pipeline.wall_clock.jumps,
                "last_jump_s": pipeline.wall_clock.last_jump_s,
            },
            "reference": rest
            and {"scans": rest.reference.scans, "taken_realtime_ns": rest.realtime_ns},
            "baseline": imaging.baseline,
            "companions": imaging.companions,
            "stage_ms": {stage: times for stage, times in stages.items() if times},
            "latency_ms": self._publisher.latency.percentiles_ms(),
            "methods": list(self._methods),
            "tier_requested": imaging.method.requested.method,
            "budget_ms": imaging.method.requested.budget_ms,
            "plan": {"tier": imaging.method.effective.method, "share": imaging.method.share},
            "recording": active
            and {
                "path": str(active.path),
                "bytes": active.bytes_written,
                "queued_bytes": active.queued_bytes,
            },
            "recorder": self._recorder_fields(),
            "subscribers": self._publisher.subscribers,
            "events": self._events.fields(),
            "process": self._process(),
        }

    def state(self) -> str:
        """Return the daemon's state in one word."""
        if self._pipeline.finished.is_set():
            return "ended"
        if self._playback is not None and self._playback.is_paused:
            return "paused"
        last_ns = self._imaging.acquired_monotonic_ns
        if not last_ns:
            is_waiting = any(port.state == "closed" for port in self._ports)
            return "waiting_for_port" if is_waiting else "waiting_for_data"
        stale_s = max(STALE_S, self._imaging.frame_rate.pace.few_s)
        now_ns = time.monotonic_ns()
        if self._playback is not None:
            last_ns = max(last_ns, self._playback.steered_ns)
        if now_ns - max(last_ns, self._pipeline.delivered_ns) > stale_s * 1e9:
            return "stale"
        if self._imaging.taring.is_on:
            return "taring"
        return "late" if now_ns - last_ns > stale_s * 1e9 else "running"

    def summary(self) -> str:
        """Return how the daemon is in one line, for `systemctl status`."""
        state = self.state().replace("_", " ")
        absent = [port.url for port in self._ports if not port.is_open and not port.has_ended]
        if absent:
            return f"{state}, {' and '.join(absent)} not open"
        rate_hz = self._imaging.frame_rate.per_second()
        return f"{state}: {rate_hz:.0f} frames/s, {self._publisher.subscribers} subscriptions"

    def _port(self, port: PortReader) -> dict[str, Any]:
        fields = port_fields(port)
        counts = {name: fields[name] for name in ("packets", "corrupt", "faulty")}
        return {**fields, "received_last_minute": self._ports_last_minute[port.url].rise(counts)}

    def _recorder_fields(self) -> dict[str, Any]:
        recorder = self._recorder
        return {
            "files": recorder.files,
            "deleted": recorder.deleted,
            "failures": recorder.failures,
            "failure": recorder.failure or None,
            "waits_for": recorder.waits_for or None,
        }

    def _process(self) -> dict[str, Any]:
        """Return what this process takes of the computer; its memory is None where nobody says."""
        return {
            "pid": os.getpid(),
            "cpu_s": time.process_time() - self._started_cpu_s,
            "memory_bytes": resident_bytes(),
            "threads": threading.active_count(),
        }

    def _rates(self) -> dict[str, float | None]:
        rates = self._pipeline.scan_rates
        return {
            **{
                f"{channel}_hz": rates[channel].per_second() if channel in rates else None
                for channel in Channel
            },
            "frames_hz": self._imaging.frame_rate.per_second(),
        }


def source(ports: list[PortReader]) -> str:
    """Return what the scans come from."""
    if is_replayed(port.url for port in ports):
        return "replay"
    names = [port.hello.device_id for port in ports if port.hello is not None]
    if not names:
        return "unknown"
    return "twin" if all(name.startswith("twin") for name in names) else "device"
