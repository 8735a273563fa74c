"""The optional Prometheus endpoint: what `status` says, as metrics, read when somebody scrapes.

Nothing is counted here, so a frame costs nothing more. A slow scraper holds up nobody. The address
must be of this computer, since neither keys nor encryption guard it; an agent there passes it on.

The names follow Prometheus' conventions: base units in the name, `_total` for what only rises.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import urlsplit
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from tactomo_client.connection import names_this_computer
from tactomo_models import Flag

from tactomo.errors import AddressError, needs, os_errors_as
from tactomo.timing import Durations
from tactomo.worker import Worker

with needs("`metrics`", "pip install 'tactomo[metrics]'"):
    from prometheus_client import CollectorRegistry, ProcessCollector, make_wsgi_app
    from prometheus_client.core import Metric
    from prometheus_client.exposition import ThreadingWSGIServer
    from prometheus_client.registry import Collector

STATES: Final = (
    *("waiting_for_port", "waiting_for_data", "taring", "running", "late", "stale"),
    *("paused", "ended"),
)
COUNTERS: Final = {
    "dropped_scans": "Dual scans left out because newer ones had come.",
    "incomplete_scans": "Dual scans of which one channel did not come.",
    "late_scans": "Scans that came too late for their dual scan.",
    "frames": "Frames published.",
}
PORT_COUNTERS: Final = {
    "bytes": "Bytes received.",
    "packets": "Packets received.",
    "corrupt": "Packets that were damaged on their way.",
    "faulty": "Intact packets that break the protocol.",
    "unused_scans": "Scans that were not used.",
}
SCRAPER_TIMEOUT_S: Final = 5.0
POLL_S: Final = 0.1

Labels = Mapping[str, str]
Status = Callable[[], Mapping[str, Any]]
Times = Callable[[], Mapping[str, Durations]]


class MetricsServer(Worker):
    """`open` it, `start` its thread, `stop` it."""

    def __init__(self, status: Status, latency: Durations, stages: Times) -> None:
        super().__init__("metrics")
        self.address = ""  # where it can be scraped, once open
        registry = CollectorRegistry()
        registry.register(_StatusCollector(status, latency, stages))
        ProcessCollector(registry=registry)
        self._app = make_wsgi_app(registry)
        self._server: WSGIServer

    def open(self, endpoint: str) -> None:
        """Bind ``HOST:PORT``; raise AddressError where the address cannot be had."""
        parts = urlsplit(f"//{endpoint}")
        host, port = parts.hostname or "", parts.port or 0
        step = "stop what uses this port, or give another one as metrics"
        with os_errors_as(AddressError, f"cannot offer metrics at {endpoint}", step):
            self._server = make_server(host, port, _only_for(host, self._app), _Server, _Handler)
        self.address = f"http://{host}:{self._server.server_port}/metrics"

    def _close(self) -> None:
        self._server.server_close()

    def _run(self) -> None:
        self._server.timeout = POLL_S
        while not self._stopping.is_set():
            self._server.handle_request()


def _only_for(host: str, app: Any) -> Any:
    """Return the application for those alone who name this computer: no page from elsewhere."""

    def answer(environ: dict[str, Any], start: Any) -> Any:
        if names_this_computer(environ.get("HTTP_HOST", ""), host):
            return app(environ, start)
        start("403 Forbidden", [("Content-Type", "text/plain")])
        return [f"ask for {host} or localhost\n".encode()]

    return answer


class _Server(ThreadingWSGIServer):
    """Says nothing of a scraper that went away or took too long."""

    def handle_error(self, request: Any, client_address: Any) -> None:
        pass


class _Handler(WSGIRequestHandler):
    """Says nothing in the log, and waits for nobody for long."""

    timeout = SCRAPER_TIMEOUT_S

    def log_message(self, format: str, *args: Any) -> None:
        pass


@dataclass(eq=False)
class _StatusCollector(Collector):
    """Turns a status into metrics; called by the thread that answers a scrape."""

    _status: Status
    _latency: Durations
    _stages: Times

    def describe(self) -> list[Metric]:
        """Return nothing: a registry that checks names would have to take a status first."""
        return []

    def collect(self) -> Iterator[Metric]:
        status = self._status()
        made = _Made({"sensor": status["sensor"]})
        _about_the_daemon(made, status)
        made.summary("latency_seconds", "From the last byte of a scan to its map.", self._latency)
        for stage, times in self._stages().items():
            made.summary("stage_seconds", "Time that a stage takes.", times, stage=stage)
        for event, count in status["events"]["counts"].items():
            made.counter("events", "Events, see STREAM.md.", count, event=event)
        return iter(made.metrics.values())


class _Made:
    """The metrics made so far, by name; each sample has the sensor's label."""

    def __init__(self, labels: Labels) -> None:
        self.metrics: dict[str, Metric] = {}
        self._labels = labels

    def gauge(self, name: str, about: str, value: float | None, **labels: str) -> None:
        """Add a value that may rise and fall; one that is unknown is left out."""
        if value is not None:
            self._metric(name, about, "gauge").add_sample(
                f"tactomo_{name}", {**self._labels, **labels}, value
            )

    def counter(self, name: str, about: str, value: float, **labels: str) -> None:
        """Add a count that only rises while the daemon runs."""
        metric = self._metric(name, about, "counter")
        metric.add_sample(f"tactomo_{name}_total", {**self._labels, **labels}, value)

    def summary(self, name: str, about: str, times: Durations, **labels: str) -> None:
        """Add durations: quantiles of the last ones, and sum and count of all."""
        metric = self._metric(name, about, "summary")
        known = {**self._labels, **labels}
        percentiles = times.percentiles_ms() or {}
        for quantile, key in (("0.5", "p50"), ("0.99", "p99")):
            if key in percentiles:
                sample = {**known, "quantile": quantile}
                metric.add_sample(f"tactomo_{name}", sample, percentiles[key] * 1e-3)
        metric.add_sample(f"tactomo_{name}_sum", known, times.total_s)
        metric.add_sample(f"tactomo_{name}_count", known, times.count)

    def _metric(self, name: str, about: str, kind: str) -> Metric:
        full = f"tactomo_{name}"
        return self.metrics.setdefault(full, Metric(full, about, kind))


def _about_the_daemon(made: _Made, status: Mapping[str, Any]) -> None:
    rates, reference, recording = status["rates"], status["reference"], status["recording"]
    build = {"version": status["version"], "model": status["description"]["model"]}
    age_ns = status["age_ns"]
    made.gauge("build_info", "The daemon's version and the sensor's description.", 1, **build)
    made.gauge("uptime_seconds", "Since the daemon's start.", status["uptime_s"])
    for state in STATES:
        is_it = status["state"] == state
        made.gauge("state", "1 for the state that the daemon is in.", is_it, state=state)
    made.gauge("subscriptions", "Subscriptions in force.", status["subscribers"])
    made.gauge("age_seconds", "Age of the newest dual scan.", age_ns and age_ns * 1e-9)
    taken_s = reference and reference["taken_realtime_ns"] * 1e-9
    made.gauge("reference_timestamp_seconds", "When the reference was taken.", taken_s)
    for channel, count in status["scans"].items():
        made.counter("scans", "Scans of a channel that came.", count, channel=channel)
        rate_hz = rates[f"{channel}_hz"]
        made.gauge("scan_rate_hertz", "Scans that come.", rate_hz, channel=channel)
    for key, about in COUNTERS.items():
        made.counter(key, about, status[key])
    made.gauge("frame_rate_hertz", "Frames published.", rates["frames_hz"])
    made.gauge("misfit", "Of the newest frame, in units of noise.", status["misfit"])
    for name in (name for flag in Flag for name in flag.names()):
        is_set = name in status["flags"]
        made.gauge("flag", "Whether the newest frame has a flag, see STREAM.md.", is_set, flag=name)
    for port in status["ports"]:
        made.gauge("port_up", "Whether a port is open.", port["connected"], port=port["url"])
        for key, about in PORT_COUNTERS.items():
            made.counter(f"port_{key}", about, port[key], port=port["url"])
    made.gauge("recording", "Whether a recording runs.", recording is not None)
    made.gauge("recording_bytes", "Length of the file so far.", recording and recording["bytes"])
