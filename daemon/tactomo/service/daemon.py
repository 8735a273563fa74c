"""The daemon: ports, pipeline, publisher, control and recorder, put together and kept running.

Threads, each with what it alone touches, and what it hands on:

============  ==========================  =========================================================
thread        owns                        hands on
============  ==========================  =========================================================
port-0, -1    a serial port               scans to the pipeline, bytes to the recorder
pipeline      sync, the reconstructor     messages to the publisher; marks and, if that is asked
                                          for, those messages to the recorder
control       the control socket          commands to the pipeline and to the recorder
publisher     the stream's socket         nothing
metrics       the scrapers' socket        nothing; only if it is asked for
access        the list of clients         nothing; runs where there are keys (AccessControl)
recorder      the files of recordings     nothing
============  ==========================  =========================================================

They stop in this order, so nobody hands anything to one that has gone. Numerical libraries are
held to one thread while a daemon runs: on arrays of this size their pools cost more latency than
they save, and the processor is shared with everything else on the robot.
"""

from __future__ import annotations

import contextlib
import gc
import signal
import threading
import time
import uuid
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import structlog
import zmq
from tactomo_client.messages import EVENT, SCHEMA, STATUS
from tactomo_client.schema import EVENTS
from tactomo_models import (
    Artifact,
    ArtifactError,
    CalibrationError,
    ModelError,
    Reconstructor,
    SensorDescription,
    load_description,
    load_or_build_artifact,
    shipped_descriptions,
)
from tactomo_models.calibration.calibration_file import (
    CALIBRATIONS,
    PressureCalibration,
    calibration_for,
)
from tactomo_models.calibration.taught_skin import TAUGHT, TaughtSkin
from tactomo_models.methods.registry import available_methods, check_method, left_out
from tactomo_models.sensor.description_file import carried_text
from tactomo_protocol import Channel
from threadpoolctl import threadpool_limits

from tactomo.acquisition.open_serial import require_present
from tactomo.acquisition.port import PortReader
from tactomo.config import DaemonConfig
from tactomo.ending import at_end
from tactomo.endpoint import allow_connections
from tactomo.errors import CommandError, ConfigError
from tactomo.events import RECORDED, EventBook
from tactomo.imaging.imaging import Imaging
from tactomo.imaging.kept_reference import KeptReference, reference_path
from tactomo.imaging.pipeline import Pipeline
from tactomo.protocols import find_protocol, protocol_named
from tactomo.recordings.recorder import Recorder
from tactomo.recordings.recording import Origin, is_replayed
from tactomo.recordings.recording_writer import Entry
from tactomo.recordings.records import calibration_text
from tactomo.recordings.replay import Replay, read_replay, without_calibrations
from tactomo.running import Running, announced
from tactomo.service.status import Status
from tactomo.service.supervision import Supervision, notify
from tactomo.stream.access_control import AccessControl, load_server_keys
from tactomo.stream.control import Control, Outcome, SetBudget, SetTier, Settling, SteerReplay
from tactomo.stream.publisher import Publisher
from tactomo.timing import wall_clock_ns
from tactomo.worker import Worker

if TYPE_CHECKING:
    from tactomo.service.metrics import MetricsServer

WATCH_S: Final = 0.5
"""How late, at most, a thread that died or a replay's end is noticed; a stop is at once."""

log = structlog.get_logger()


class Daemon:
    """One sensor's daemon, to be run in this process.

    Raises ModelError, ConfigError, KeysError, RecordingError or PortError for what is unusable.
    """

    def __init__(
        self,
        config: DaemonConfig,  # what it serves
        *,
        # what makes maps of voltages; by default the description's own, with an artifact that is
        # built if need be. Only that one can tell a load at the start by the reference of before
        reconstructor: Reconstructor | None = None,
        # the description's; by default read, and built if need be
        artifact: Artifact | None = None,
        # what the sensor is made of, where a recording carries that; by default as configured
        description: SensorDescription | None = None,
    ) -> None:
        for url in () if config.wait_for_ports else config.ports:
            require_present(url)
        self.config = config
        self.session = uuid.uuid4().hex  # identity of this run, as in every message
        self._undo = contextlib.ExitStack()
        self._stop_asked = threading.Event()
        self._why_stopped = "asked to"
        self._events = EventBook()
        curve = config.curve
        self._keys = None if curve is None else load_server_keys(curve.secret, curve.clients)
        self._description_file: Path | None = None
        if description is None:
            description = load_description(config.description)
            if config.description not in shipped_descriptions():
                self._description_file = Path(config.description).resolve()
        if len(config.ports) > len(description.channels):
            of, step = "two ports are given", "give one port"
            if is_replayed(config.ports):
                of, step = "the recording is of two", "give another --description"
            raise ConfigError(f"{description.name} has one channel, and {of}", step)
        self._description = description
        self._methods = tuple(dict.fromkeys((*available_methods(), config.method)))
        why = left_out(self._methods, description)
        self._offered = tuple(method for method in self._methods if method not in why)
        replay = read_replay(config.ports, description)
        if replay is not None and config.calibration is not None:
            replay = replace(replay, marks=without_calibrations(replay.marks))
        self._replay = replay
        # the time of the replay; None where the ports are live
        self.playback = None if replay is None else replay.playback
        _check_methods(replay, self._methods, description)
        protocol = find_protocol(config.protocol).name if replay is None else replay.protocol
        channels = tuple(c for c in Channel if c in description.channels)
        calibration, self._unused = _find_calibration(
            config, description, self._description_file, replay
        )
        taught = _find_taught(config, description, replay, self._unused)
        origin = Origin(
            config.name,
            config.description,
            description.sha256,
            config.ports,
            version("tactomo"),
            protocol,
            calibration_text(calibration),
            carried_text(description, config.description),
        )
        self._recorder = Recorder(origin, config.recording, self._on_event)
        self._publisher = Publisher(
            config.name,
            self.session,
            lambda header: self._status.fields(header),
            self._record_message,
            self._on_event,
        )
        is_lossless = config.lossless or (replay is not None and replay.is_lossless)
        self._imaging = Imaging(
            description,
            reconstructor or _make_reconstructor(config, description, artifact),
            calibration,
            taught,
            config.tare_scans,
            is_lossless,
            config.baseline,
            None
            if replay is not None or reconstructor is not None
            else KeptReference(
                reference_path(config.name), description, self._recorder, self._on_event
            ),
            self._recorder,
            self._publisher,
            self._on_event,
        )
        self._pipeline = Pipeline(
            self._imaging,
            channels,
            len(config.ports),
            round(config.sync_wait_ms * 1e6),
            is_lossless,
            replay,
            self._zero_counters,
            self._on_event,
        )
        # A channel is one port's. In an exact replay the marks say whose each scan is.
        is_exact = replay is not None and bool(replay.marks)
        carriers: dict[Channel, PortReader] = {}
        self._ports = [
            PortReader(
                index,
                url,
                config.baud or find_protocol(protocol).baud,
                protocol_named(protocol, description),
                description,
                config.device_ids,
                self._recorder,
                self._pipeline.deliver,
                self._on_event,
                self.playback,
                {} if is_exact else carriers,
            )
            for index, url in enumerate(config.ports)
        ]
        self._control = Control(
            {
                "status": lambda _: self.status(),
                "tare": lambda _: self._pipeline.tare(),
                "record_start": lambda asked: self._recorder.begin(asked.path, asked.maps),
                "record_stop": lambda _: self._recorder.end(),
                "set_tier": self._set_tier,
                "set_budget": self._set_budget,
                "reload_calibration": lambda _: self._reload_calibration(),
                "replay": self._steer_replay,
            },
            self._check,
            self._on_event,
        )
        self._status = Status(
            description,
            self._description_file,
            self._ports,
            self._pipeline,
            self._imaging,
            self._recorder,
            self._events,
            self._offered,
            self.playback,
            self._publisher,
            self._control,
        )
        self._access: AccessControl | None = None
        self._metrics = None if config.metrics is None else self._make_metrics()
        self._workers: list[Worker] = [self._publisher, self._control, self._pipeline, *self._ports]

    @property
    def stream_address(self) -> str:
        """Where the stream is bound, once started."""
        return self._publisher.address

    @property
    def metrics_address(self) -> str:
        """Where Prometheus may scrape, once started; empty if it may not."""
        return "" if self._metrics is None else self._metrics.address

    @property
    def control_address(self) -> str:
        """Where the control socket is bound, once started."""
        return self._control.address

    def start(self) -> None:
        """Open everything and start all threads; on failure, what was opened is closed again.

        Raises PortError where a port is unusable and `wait_for_ports` is off, AddressError where an
        address is in use, and RecordingError where the recording cannot be created.
        """
        with contextlib.ExitStack() as undo:
            self._open(undo)
            self._undo = undo.pop_all()
        log.info(
            "ready",
            sensor=self.config.name,
            stream=self.stream_address,
            control=self.control_address,
            ports=list(self.config.ports),
        )
        if self._replay is None:
            log.info(
                "taring",
                detail=f"the first {self.config.tare_scans} dual scans become the reference",
                next_step="leave the skin alone until `tared`",
            )
        for why in self._unused:
            self._on_event("calibration_refused", why, "until then no calibration is used")

    def stop(self) -> None:
        """Stop all threads and close everything; may be called twice."""
        self._stop_asked.set()
        self._undo.close()

    @property
    def recording_failure(self) -> str:
        """Why the last recording did not go on; empty where it did."""
        return self._recorder.failure

    def wait(self) -> int:
        """Wait until the daemon is to stop, and return the exit status that it deserves."""
        supervision = Supervision(self._turns, self._status.summary)
        while not self._stop_asked.wait(WATCH_S):
            if self.config.exit_at_end and self._pipeline.finished.is_set():
                self._why_stopped = "every replayed port is at its end"
                break
            has_access = self._access is None or self._access.is_alive
            if not (has_access and all(worker.is_alive for worker in self._workers)):
                self._why_stopped = "a thread died"  # its traceback is in the log
                log.error("thread_died", next_step="please report the traceback above")
                return 1
            supervision.turn()
        return 0

    def run(self) -> int:
        """Start, serve until a signal asks to end, and stop; returns the process's exit status.

        For the main thread. Raises what `start` raises.
        """
        at_end(self._on_signal)
        threading.excepthook = _log_thread_failure
        allow_connections()
        self.start()
        # What is there now stays: never looked through again, which would take tenths of a second.
        gc.collect()
        gc.freeze()
        notify("READY=1", f"STATUS={self._status.summary()}")
        addresses = self.control_address, self.config.name, self.stream_address
        try:
            with announced(Running("daemon", *addresses, tuple(self.config.ports))):
                return self.wait()
        finally:
            notify("STOPPING=1", "STATUS=stopping")
            self.stop()
            log.info("stopped", why=self._why_stopped, **self._last_words())

    def status(self) -> dict[str, Any]:
        """Return the fields of a `status` message as of now, envelope included."""
        envelope = self._publisher.envelope(STATUS)
        topic = {"schema": SCHEMA, "sensor": self.config.name, "kind": STATUS}
        return {**topic, **envelope, **self._status.fields(envelope)}

    def _on_signal(self, number: int, _: object) -> None:
        self._why_stopped = signal.Signals(number).name
        self._stop_asked.set()

    def _last_words(self) -> dict[str, Any]:
        """What one would want to know afterwards of a daemon that is no more."""
        status = self._status.fields(self._publisher.header)
        troubles = status["events"]["troubles"]
        said = {key: round(status[key]) for key in ("uptime_s", "frames", "dropped_scans")}
        if not troubles:
            return said
        return {**said, "last_trouble": f"{troubles[0]['name']}: {troubles[0]['detail']}"}

    def _open(self, undo: contextlib.ExitStack) -> None:
        """Open and start each part, what is downstream first; `undo` goes the other way."""
        config = self.config
        undo.enter_context(threadpool_limits(1))
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        undo.callback(context.term)
        undo.callback(self._recorder.stop)
        secret = None
        if self._keys is not None:
            secret = self._keys.secret
            self._access = AccessControl(context, self._keys, self._on_event, self._cut_connections)
            self._access.start()
            undo.callback(self._access.stop)
        self._publisher.open(context, config.stream, secret)
        undo.callback(self._publisher.stop)
        self._control.open(context, config.control, secret)
        undo.callback(self._control.stop)
        undo.callback(self._pipeline.stop)
        for port in self._ports:
            port.open(or_wait=config.wait_for_ports)
            undo.callback(port.stop)
        if self._metrics is not None and config.metrics is not None:
            self._metrics.open(config.metrics)
            undo.callback(self._metrics.stop)
            self._workers.append(self._metrics)
        self._recorder.start()  # when nothing can fail any more: no file for each attempt
        for worker in self._workers:
            worker.start()

    def _make_metrics(self) -> MetricsServer:
        # Imported where it is asked for: it needs an extra.
        from tactomo.service.metrics import MetricsServer

        return MetricsServer(self.status, self._publisher.latency, lambda: self._imaging.stages)

    def _check(self) -> None:
        """Look after what has no thread of its own; called by the control thread."""
        self._recorder.check()
        if self._access is not None:
            self._access.check()

    def _cut_connections(self) -> None:
        """Have every client beyond this computer connect anew: one of them may not any more."""
        self._publisher.cut_connections()
        self._control.cut_connections()

    def _turns(self) -> Mapping[str, int]:
        """Return how often each thread went round its loop, of those that are not at their end.

        Control is not among them: nothing that is asked of it may end the stream.
        """
        ports = [port for port in self._ports if not port.has_ended]
        watched = (self._pipeline, self._publisher, *ports)
        return {worker.name: worker.turns for worker in watched}

    def _set_tier(self, arguments: SetTier) -> Settling:
        method = arguments.tier
        if method not in self._methods:
            raise CommandError(
                f"there is no method {method!r}",
                f"use one of: {', '.join(self._offered)}",
                "bad_argument",
            )
        try:
            check_method(method, self._description)
        except ModelError as error:
            name = "no_network" if isinstance(error, ArtifactError) else "bad_argument"
            raise CommandError(str(error), name=name) from error
        in_force = self._pipeline.ask(lambda: self._imaging.method.request_method(method))
        return Settling({"tier": method}, in_force)

    def _set_budget(self, arguments: SetBudget) -> Settling:
        budget_ms = arguments.budget_ms
        in_force = self._pipeline.ask(lambda: self._imaging.method.request_budget(budget_ms))
        return Settling({"budget_ms": budget_ms}, in_force)

    def _steer_replay(self, arguments: SteerReplay) -> Outcome:
        playback = self.playback
        if playback is None:
            raise CommandError(
                "nothing is replayed here", "start a replay: `tactomo replay FILE`", "no_replay"
            )
        playback.steer(arguments.paused, arguments.speed, arguments.loop)
        if arguments.step:
            self._pipeline.step()
        moved = None if arguments.position_s is None else self._pipeline.move(arguments.position_s)
        self._publisher.tell_status()
        fields = playback.fields()
        if moved is None:
            return fields
        return Settling({**fields, "position_s": arguments.position_s}, moved)

    def _reload_calibration(self) -> Future[Mapping[str, Any]]:
        """Look for the sensor's calibration as at the start; what cannot be used changes nothing.

        Reads small files, on the control thread; what 800 presses teach takes some seconds.
        """
        config, replay = self.config, self._replay
        if replay is not None and replay.marks and config.calibration is None:
            raise CommandError(
                "an exact replay goes by the calibrations that were recorded",
                "give the replay another one: `tactomo replay --calibration FILE`",
                "calibration_refused",
            )
        try:
            found, unused = _find_calibration(
                config, self._description, self._description_file, replay
            )
            taught = _find_taught(config, self._description, replay, unused)
        except CalibrationError as error:
            found, taught, unused = None, None, [str(error)]
        if unused:
            step = "what was in force stays so"
            self._on_event("calibration_refused", unused[0], step)
            raise CommandError(unused[0], step, "calibration_refused")
        return self._pipeline.ask(lambda: self._imaging.use_calibration(found, taught))

    def _zero_counters(self) -> None:
        for port in self._ports:
            port.zero_counters()

    def _record_message(self, kind: str, data: bytes) -> None:
        active = self._recorder.active
        if active is not None and active.with_maps:
            active.add(Entry(kind, data, time.monotonic_ns(), wall_clock_ns()))

    def _on_event(
        self, name: str, detail: str, next_step: str = "", about: str = "", reason: str = ""
    ) -> bool:
        if not self._events.is_due(name, about, reason):
            return False
        kind = EVENTS[name]
        if self._replay is not None and next_step and kind.at_skin:
            next_step = RECORDED
        severity, spared = kind.severity, self._events.note(name, detail, next_step)
        if spared is not None:
            extra: dict[str, Any] = {"next_step": next_step} if next_step else {}
            if spared:
                extra["not_logged"] = spared  # of this name since the last line
            getattr(log, severity)(name, detail=detail, **extra)
        fields = {"name": name, "severity": severity, "detail": detail, "next_step": next_step}
        self._publisher.publish(EVENT, fields)
        return True


def _log_thread_failure(failure: threading.ExceptHookArgs) -> None:
    thread = failure.thread.name if failure.thread else "unknown"
    log.error("thread_failed", thread=thread, exc_info=failure.exc_value)


def load_model(description: SensorDescription) -> Artifact:
    """Return the artifact of a sensor, built if need be; log and notify that this takes a while."""
    log.info("loading", sensor_model=description.name)
    notify(f"STATUS=loading the model of {description.name}, which is built the first time")
    return load_or_build_artifact(
        description, progress=lambda step: log.info("building", detail=step)
    )


def _make_reconstructor(
    config: DaemonConfig, description: SensorDescription, artifact: Artifact | None
) -> Reconstructor:
    budget_s = None if config.budget_ms is None else config.budget_ms * 1e-3
    if artifact is None or artifact.sha256 != description.sha256:
        artifact = load_model(description)
    return Reconstructor(description, artifact, method=config.method, budget_s=budget_s)


def _check_methods(
    replay: Replay | None, methods: Sequence[str], description: SensorDescription
) -> None:
    """Refuse a recording whose frames were made by a method that is not here, before it begins.

    A recording can name no module: only those who start the daemon can.
    """
    made_by = {mark.tier for mark in replay.marks} if replay is not None else set()
    unknown = sorted(made_by - set(methods))
    if unknown:
        raise ConfigError(
            f"the recording's frames were made by the method {unknown[0]!r}, which is not here",
            "install what brings it, such as tactomo-lab, or name your own with --method",
        )
    for method in made_by:
        check_method(method, description)


def _find_calibration(
    config: DaemonConfig, description: SensorDescription, file: Path | None, replay: Replay | None
) -> tuple[PressureCalibration | None, list[str]]:
    """Return the pressure calibration to be used, and why others are not.

    Raises CalibrationError where the configured one cannot be used.
    """
    unused: list[str] = []
    if description.magnitude is None:
        return None, unused
    if config.calibration is not None:
        step = f"{CALIBRATIONS.again(config.name)}, or leave the key out"
        return CALIBRATIONS.load(config.calibration, config.name, description, step), unused
    if replay is not None and replay.knows_calibration:
        return replay.calibration, unused
    found = calibration_for(config.name, description, file, unused.append)
    return found, unused


def _find_taught(
    config: DaemonConfig, description: SensorDescription, replay: Replay | None, unused: list[str]
) -> TaughtSkin | None:
    """Return what the sensor was taught; why not is added to `unused`. A replay goes without."""
    if replay is not None:
        return None
    try:
        return TAUGHT.load(TAUGHT.path(config.name), config.name, description)
    except FileNotFoundError:
        return None
    except CalibrationError as error:
        unused.append(str(error))
        return None
