"""The stream over Eclipse Zenoh: daemons' messages into Zenoh.

The bridge subscribes to daemons' streams, and publishes what comes (`zenoh_publication`); the other
way is `zenoh_proxy`. Who may connect, and by what encryption, is up to Zenoh's own configuration.
Source: https://zenoh.io/docs/manual/abstractions
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

import zenoh
import zmq
from tactomo_client import Keys

from tactomo.errors import AddressError, ConfigError
from tactomo.stream.relay import LOOK_S, POLL_MS, Relay, StreamInlet, waiting
from tactomo.stream.zenoh_publication import Publication

LOCAL: Final = "tcp/127.0.0.1:7447"
"""Without a configuration of its own: Zenoh's port, on this computer alone."""


def open_session(
    configuration: Path | None, without: Literal["listen", "connect"]
) -> zenoh.Session:
    """Open a Zenoh session as a configuration file has it; without one, at or to `LOCAL`.

    Raises ConfigError where the file is unusable, AddressError where an address of it is.
    """
    zenoh.init_log_from_env_or("error")
    try:
        if configuration is None:
            config = zenoh.Config()
            config.insert_json5("scouting/multicast/enabled", "false")
            config.insert_json5("listen/endpoints", "[]")
            config.insert_json5(f"{without}/endpoints", json.dumps([LOCAL]))
        else:
            config = zenoh.Config.from_file(str(configuration))
    except zenoh.ZError as error:
        raise ConfigError(
            f"{configuration} is no configuration of Zenoh: {_words(error)}",
            "see deploy/examples/zenoh_robot.json5, or Zenoh's own DEFAULT_CONFIG.json5",
        ) from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise AddressError(
            f"Zenoh cannot be opened as {configuration or LOCAL} asks: {_words(error)}",
            "where another program listens there, give --config with a file that connects to it",
        ) from error


class ZenohBridge(Relay):
    """Publishes daemons' streams under a robot's name; `keys` are for sources that want some."""

    def __init__(
        self,
        sources: Sequence[str],
        robot: str,
        configuration: Path | None = None,
        keys: Keys | None = None,
    ) -> None:
        super().__init__(sources)
        self._robot = robot
        self._configuration = configuration
        self._keys = keys
        self._session: zenoh.Session | None = None
        self._inlets: list[StreamInlet] = []

    def open(self) -> None:
        """Open Zenoh, and connect to the sources, whether or not they are there.

        Raises AddressError or ConfigError as `open_session` does, ControlError for a bad source.
        """
        self._session = open_session(self._configuration, "listen")
        self._publication = Publication(self._session, self._robot)
        for source in self.sources:
            self._inlets.append(StreamInlet(self._context, source, self._keys))

    def run(self) -> None:
        """Publish messages until `stop`."""
        poller = zmq.Poller()
        for inlet in self._inlets:
            poller.register(inlet.socket, zmq.POLLIN)
        check_at_s = 0.0
        while not self._stopping.is_set():
            ready = dict(poller.poll(POLL_MS))
            for inlet in self._inlets:
                for data in waiting(inlet.socket) if inlet.socket in ready else ():
                    self._publication.take(inlet.address, data)
            if time.monotonic() >= check_at_s:
                check_at_s = time.monotonic() + LOOK_S
                self._publication.forget_silent()
                for inlet in self._inlets:
                    inlet.knock_again()

    def close(self) -> None:
        """Close everything, whatever `open` came to."""
        for inlet in self._inlets:
            inlet.close()
        super().close()
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]


def _words(error: zenoh.ZError) -> str:
    """Return what Zenoh says, without the place in its source."""
    return str(error).partition(" at /")[0].rstrip(".")
