"""Daemons of this process on skins that say what a test tells them to: see `daemon_bench`."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from daemon_bench import LOCAL, PATIENT_SYNC_MS, Bench, Heard, Line, Listener, Memory, Skin
from tactomo.config import load_config
from tactomo.log import configure_logging
from tactomo.recordings.recording import open_recording
from tactomo.service.daemon import Daemon
from tactomo_client import Keys


@pytest.fixture(autouse=True)
def _readable_logs() -> None:
    """Log as the daemon does: structlog's own default shows every variable of a traceback."""
    configure_logging("info", "text")


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    """One line on its own, plugged in."""
    made = Line(tmp_path / "skin")
    yield made
    made.unplug()


@pytest.fixture
def make_skin() -> Iterator[Callable[[Path, int], Any]]:
    """Make a skin: ``make_skin(folder, ports)``."""
    skins: list[Skin] = []

    def make(folder: Path, ports: int) -> Skin:
        skins.append(Skin(folder, ports))
        return skins[-1]

    yield make
    for skin in skins:
        skin.close()


@pytest.fixture
def bench(tmp_path: Path, make_skin: Callable[[Path, int], Any]) -> Iterator[Callable[..., Any]]:
    """Start a daemon: ``bench(ports=1, **config)``; everything is stopped later.

    It has the reconstructor above, each frame of which takes `seconds`, or the `real` one. A scan
    waits for its partner as long as it takes, unless there is a `sync_wait_ms`. What listens to it
    and asks it has `keys`. The cables are in, unless `is_plugged` says otherwise.
    """
    daemons: list[Daemon] = []
    listeners: list[Listener] = []

    def start(
        ports: int = 1,
        seconds: float = 0.0,
        real: bool = False,
        keys: Keys | None = None,
        is_plugged: bool = True,
        **config: Any,
    ) -> Bench:
        folder = tmp_path / f"ports-{len(daemons)}"
        folder.mkdir()
        skin = make_skin(folder, ports)
        if not is_plugged:
            skin.close()
        settings = {
            **LOCAL,
            "ports": [str(line.path) for line in skin.lines],
            "baseline": {"track": real},  # that takes a real one
            **config,
            "recording": {"folder": tmp_path, **config.get("recording", {})},
        }
        loaded = load_config(None, **settings)
        if "sync_wait_ms" not in config:
            loaded = loaded.model_copy(update={"sync_wait_ms": PATIENT_SYNC_MS})
        memory: Any = None if real else Memory(seconds)
        daemon = Daemon(loaded, reconstructor=memory)
        daemon.start()
        daemons.append(daemon)
        listener = Listener(daemon.stream_address, "left", keys=keys)
        listeners.append(listener)
        listener.wait("status", lambda _: True)  # every subscription is in force now
        return Bench(daemon, skin, listener, keys)

    yield start
    for daemon in daemons:
        daemon.stop()
    for listener in listeners:
        listener.socket.close()


@pytest.fixture
def replay(tmp_path: Path) -> Callable[..., Any]:
    """Replay a recording to its end: ``replay(path, speed=0, **config)`` returns what was said."""
    count = itertools.count()

    def run(path: Path, speed: float = 0, real: bool = False, **config: Any) -> Heard:
        out = tmp_path / f"replayed-{next(count)}.mcap"
        settings = {
            **LOCAL,
            "ports": open_recording(path).replay_urls(speed),
            "exit_at_end": True,
            "recording": {"file": out, "maps": True},
            "baseline": {"track": real},
            **config,
        }
        memory: Any = None if real else Memory()
        daemon = Daemon(load_config(None, **settings), reconstructor=memory)
        daemon.start()
        try:
            assert daemon.wait() == 0
        finally:
            daemon.stop()
        return Heard(out)

    return run


@pytest.fixture
def connect() -> Iterator[Callable[..., Any]]:
    """Connect a bare socket: ``connect(zmq.SUB, address, prefix)``; it is closed later."""
    sockets: list[zmq.Socket[bytes]] = []

    def open_socket(kind: int, address: str, prefix: bytes | None = None, rcvhwm: int = 0) -> Any:
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(kind)
        sockets.append(socket)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVHWM, rcvhwm)
        if prefix is not None:
            socket.setsockopt(zmq.SUBSCRIBE, prefix)
        socket.connect(address)
        return socket

    yield open_socket
    for socket in sockets:
        socket.close()
