"""Commands to a control socket (the daemon's, the twin's) without holding up the event loop."""

from __future__ import annotations

import asyncio
from typing import Any

import zmq
import zmq.asyncio
from tactomo_client import Keys
from tactomo_client.control import bad_address, no_answer
from tactomo_client.keys import secure
from tactomo_client.messages import MAX_MESSAGE_BYTES, decode_reply, encode_request


class ControlLink:
    """One control socket. Commands are sent one at a time, in the order of the calls."""

    def __init__(self, address: str, keys: Keys | None = None) -> None:
        self.address = address
        self._keys = keys
        self._turn = asyncio.Lock()
        self._socket: zmq.asyncio.Socket | None = None

    async def request(
        self, command: str, arguments: dict[str, Any], timeout_s: float
    ) -> dict[str, Any]:
        """Send one command and return its result.

        Raises:
            ControlError: the command was refused, or nothing answered within `timeout_s`.
            MessageError: the arguments cannot be sent, or the answer is no reply.

        """
        message = encode_request(command, arguments)
        async with self._turn:
            self._socket = self._socket or self._connect()
            reply = None
            try:
                await self._socket.send(message)
                if await self._socket.poll(round(timeout_s * 1000)):
                    reply = await self._socket.recv()
            finally:
                if reply is None:  # a REQ socket that waited in vain cannot be used again
                    self.close()
        if reply is None:
            raise no_answer(self.address, timeout_s)
        return decode_reply(reply)

    def close(self) -> None:
        """Close the socket; the next command opens another."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _connect(self) -> zmq.asyncio.Socket:
        socket = zmq.asyncio.Context.instance().socket(zmq.REQ)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        secure(socket, self.address, self._keys)
        try:
            socket.connect(self.address)
        except zmq.ZMQError as error:
            socket.close()
            raise bad_address(self.address, error) from error
        return socket
