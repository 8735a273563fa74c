"""A control socket for tests: a real one, which answers what a test tells it to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import zmq
from tactomo_client.errors import ControlError
from tactomo_client.fake import bind_when_free
from tactomo_client.messages import decode_request, encode_error, encode_reply
from waiting import InThread


class FakeControl(InThread):
    """A control socket at an ephemeral port that notes what it is asked, in a thread of its own.

    Args:
        answers: for each command its result, the ControlError to refuse it with, or the bytes to
            send as they are. A command that is not in it is carried out with an empty result.
        address: where to bind.

    Attributes:
        requests: the commands and arguments that came, in order.
    """

    def __init__(
        self,
        answers: Mapping[str, Mapping[str, Any] | ControlError | bytes] | None = None,
        address: str = "tcp://127.0.0.1:*",
    ) -> None:
        self.answers = dict(answers or {})
        self.requests: list[tuple[str, dict[str, Any]]] = []
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 1000)
        self.address = bind_when_free(self._socket, address)
        super().__init__()

    def _run(self) -> None:
        with self._socket as socket:
            while not self._closing.is_set():
                if socket.poll(20):
                    socket.send(self._reply(socket.recv()))

    def _reply(self, data: bytes) -> bytes:
        command, arguments = decode_request(data)
        self.requests.append((command, arguments))
        answer = self.answers.get(command, {})
        if isinstance(answer, ControlError):
            return encode_error(answer.name, answer.cause, answer.next_step)
        return answer if isinstance(answer, bytes) else encode_reply(answer)
