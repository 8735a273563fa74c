"""The twin's control socket: press, release and break things while it runs.

One MessagePack request, one reply, in the same envelope as the daemon's control socket, so that
`tactomo_client.request` speaks to both. `COMMANDS` names every command with its arguments; each
argument is checked before anything happens, and a refusal says which one is wrong and what is
allowed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

import zmq
from pydantic import BaseModel, Field
from tactomo_client.errors import MessageError
from tactomo_client.messages import MAX_MESSAGE_BYTES, decode_request, encode_error, encode_reply

from tactomo.endpoint import bind, remove_file
from tactomo.errors import CommandError
from tactomo.stream.commands import Arguments, Nothing, obey
from tactomo.twin.scene import Indenter, Scene, SkinDriftSettings

Handler = Callable[[Any], Mapping[str, Any] | None]
PressId = Annotated[str, Field(min_length=1, max_length=64, coerce_numbers_to_str=True)]


class PressArguments(Indenter):
    """Press, or move the press of the same id."""

    id: PressId = "finger"


class ReleaseArguments(Arguments):
    """Lift one live press."""

    id: PressId = "finger"


class PlayArguments(Arguments):
    """Start the scripted scene over, or play the one that is given."""

    scene: Scene | None = None


class NoiseArguments(Arguments):
    """Change the converter's noise, in volts rms."""

    noise_v: float = Field(ge=0.0, le=1e3, allow_inf_nan=False)


class MuteArguments(Arguments):
    """Send nothing of one channel for a while."""

    channel: Literal["magnitude", "structure"]
    seconds: float = Field(gt=0.0, le=86_400.0, allow_inf_nan=False)


class GarbageArguments(Arguments):
    """Send random bytes on one port."""

    port: int = Field(default=0, ge=0, le=1)
    count: int = Field(default=64, ge=1, le=65_536)


class PortArguments(Arguments):
    """One port by its number; all of them when it is left out."""

    port: int | None = Field(default=None, ge=0, le=1)


COMMANDS: Mapping[str, type[BaseModel]] = {
    "status": Nothing,
    "scene": Nothing,
    "press": PressArguments,
    "release": ReleaseArguments,
    "clear": Nothing,
    "play": PlayArguments,
    "noise": NoiseArguments,
    "drift": SkinDriftSettings,
    "mute": MuteArguments,
    "garbage": GarbageArguments,
    "unplug": PortArguments,
    "replug": PortArguments,
}


class ControlSocket:
    """A bound REP socket that hands checked commands to their handlers. For use by one thread.

    Raises AddressError where the address is in use, or is no address.
    """

    def __init__(self, address: str, handlers: Mapping[str, Handler]) -> None:
        self._handlers = handlers
        # what to poll for requests
        self.socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REP)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        self.address = bind(self.socket, address, "control", option="--twin-control")

    def answer(self) -> None:
        """Answer every request that waits; returns at once when there is none."""
        while self.socket.poll(0):
            request = self.socket.recv_multipart()
            self.socket.send(self._reply(request[0] if len(request) == 1 else b""))

    def close(self) -> None:
        """Unbind."""
        remove_file(self.address)
        self.socket.close()

    def _reply(self, data: bytes) -> bytes:
        try:
            command, arguments = decode_request(data)
            told: Mapping[str, Any] | None = obey(command, arguments, COMMANDS, self._handlers)
            return encode_reply(told or {})
        except (MessageError, CommandError) as error:
            return encode_error(error.name, error.cause, error.next_step)
