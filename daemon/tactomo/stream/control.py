"""The control thread: the only one that touches the control socket.

Requests come from anybody on this computer, or who has a key, so each is bounded in size and parts
and checked whole before anything happens. A command whose outcome takes time (`tare`) is answered
when it is known, and holds up no other client meanwhile.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Annotated, Any, Final, NamedTuple

import zmq
from pydantic import AfterValidator, ConfigDict, Field
from tactomo_client import MessageError
from tactomo_client.messages import MAX_REQUEST_BYTES, decode_request, encode_error, encode_reply

from tactomo.config import BudgetMs
from tactomo.endpoint import rebind
from tactomo.errors import CommandError, TactomoError
from tactomo.events import OnEvent
from tactomo.stream.access_control import CONTROL
from tactomo.stream.commands import Arguments, Nothing, obey
from tactomo.stream.peers import Peers
from tactomo.worker import Wakeup, Worker

POLL_MS: Final = 250  # between looks at what is idle
POLL_WHILE_PENDING_MS: Final = 10
MAX_PENDING: Final = 1024
QUEUED_PER_CLIENT: Final = 64
UNREAD_S: Final = 2.0  # how long answers wait for a client whose queue is full of others
LINGER_MS: Final = 100
SETTLE_S: Final = 1.0
"""How long a change may wait for the frame that is being made: clients wait 2 s for the answer."""

MAX_SPEED: Final = 1000.0
"""Of a replay; what is faster than frames are made is as fast as they are made."""

Result = Mapping[str, Any]


class Settling(NamedTuple):
    """A result that is known before it is in force; told when it is, or after SETTLE_S.

    What the future has is told instead, where it has more to say.
    """

    result: Result
    in_force: Future[Any]


Outcome = Result | Future[Result] | Settling
Handler = Callable[[Any], Outcome]


class _Strict(Arguments):
    model_config = ConfigDict(strict=True)


def _recording_name(name: str) -> str:
    # Who may command is any local user, where there are no keys: no profile, no unit, no key.
    if name.startswith("/") or ".." in name.split("/"):
        raise ValueError(
            "give a name below the daemon's folder of recordings, such as grasp.mcap; where that "
            "is, its configuration says: recording.folder"
        )
    if PurePosixPath(name).suffix != ".mcap" or not name.isprintable():
        raise ValueError("give the name of a recording, which ends in .mcap")
    return name


class RecordStart(_Strict):
    """What to record to, and whether with maps; what is not given is as configured."""

    path: Annotated[str, Field(max_length=1024), AfterValidator(_recording_name)] | None = None
    maps: bool | None = None


class SetTier(_Strict):
    """The method that frames are made by from now on: one of the status' `methods`."""

    tier: str


class SetBudget(_Strict):
    """How long a frame may take from now on; nil leaves it to the tier."""

    budget_ms: BudgetMs | None


class SteerReplay(_Strict):
    """How a replay goes on; what is not given stays so."""

    paused: bool | None = None
    position_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] | None = None
    speed: Annotated[float, Field(gt=0.0, le=MAX_SPEED, allow_inf_nan=False)] | None = None
    loop: bool | None = None
    step: bool = False


COMMANDS: Final[Mapping[str, type[Arguments]]] = {
    "status": Nothing,
    "tare": Nothing,
    "record_start": RecordStart,
    "record_stop": Nothing,
    "set_tier": SetTier,
    "set_budget": SetBudget,
    "reload_calibration": Nothing,
    "replay": SteerReplay,
}


class _Pending(NamedTuple):
    """A request whose answer is to come: what the future says, else `result`; by `by_s` at last."""

    envelope: list[bytes]
    future: Future[Any]
    result: Result
    by_s: float


class _Unread(NamedTuple):
    """An answer for a client who has not read those before it."""

    message: list[bytes]
    until_s: float


@dataclass(eq=False)
class Control(Worker):
    """Answers commands. `open` it, `start` its thread, `stop` it."""

    # one for each of COMMANDS; called by the thread with the checked arguments
    _handlers: Mapping[str, Handler]
    _on_idle: Callable[[], None]  # called by the thread several times a second
    _on_event: OnEvent  # told of connections that were cut

    def __post_init__(self) -> None:
        super().__init__("control")
        self.address = ""  # where it is bound, once open
        self._pending: list[_Pending] = []
        self._unread: list[_Unread] = []
        self._socket: zmq.Socket[bytes]
        self._peers: Peers
        self._wakeup: Wakeup
        self._cut = threading.Event()

    def open(
        self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, secret: bytes | None = None
    ) -> None:
        """Bind the control socket; raise AddressError where the address cannot be had."""
        self._socket = context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_REQUEST_BYTES)
        self._socket.setsockopt(zmq.RCVHWM, QUEUED_PER_CLIENT)
        self._socket.setsockopt(zmq.SNDHWM, QUEUED_PER_CLIENT)
        self._socket.setsockopt(zmq.ROUTER_MANDATORY, 1)  # a full queue is told, not thrown away
        self._peers = Peers(self._socket, endpoint, CONTROL, self._on_event, secret)
        self.address = self._peers.address
        self._wakeup = Wakeup()

    def cut_connections(self) -> None:
        """Have every client connect anew, those who still may; for any thread."""
        self._cut.set()
        self._wake()

    def _close(self) -> None:
        self._peers.close()
        self._socket.close(LINGER_MS)
        self._wakeup.close()

    def _wake(self) -> None:
        self._wakeup.set()

    def _run(self) -> None:
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._peers.monitor, zmq.POLLIN)
        poller.register(self._wakeup.reader, zmq.POLLIN)
        while not self._stopping.is_set():
            self.turns += 1
            waits = self._pending or self._unread
            longest_ms = POLL_WHILE_PENDING_MS if waits else POLL_MS
            ready = dict(poller.poll(self._peers.wait_ms(longest_ms)))
            self._wakeup.drain()
            if self._socket in ready:
                self._receive()
            self._answer_pending()
            if self._cut.is_set():
                self._cut.clear()
                rebind(self._socket, self.address)
            self._peers.check()
            self._on_idle()
        for waiting in self._pending:
            if not waiting.future.done():
                waiting.future.set_exception(CommandError("the daemon stops", "start it again"))
        self._answer_pending()

    def _receive(self) -> None:
        parts = self._peers.receive()
        if parts is None:
            return
        # The envelope (identity, then an empty part) is handed back as it came.
        *envelope, data = parts
        try:
            outcome = self._obey(*decode_request(data))
        except (MessageError, TactomoError) as error:
            self._answer(envelope, encode_error(error.name, error.cause, error.next_step))
            return
        if isinstance(outcome, Future):
            self._pending.append(_Pending(envelope, outcome, {}, math.inf))
        elif isinstance(outcome, Settling):
            by_s = time.monotonic() + SETTLE_S
            self._pending.append(_Pending(envelope, outcome.in_force, outcome.result, by_s))
        else:
            self._answer(envelope, encode_reply(outcome))

    def _obey(self, command: str, arguments: dict[str, Any]) -> Outcome:
        if len(self._pending) >= MAX_PENDING:
            raise CommandError("too many commands wait for their answer", "try again later")
        return obey(command, arguments, COMMANDS, self._handlers)

    def _answer_pending(self) -> None:
        now_s = time.monotonic()
        unsent = [one for one in self._unread if not self._send(one.message)]
        self._unread = [one for one in unsent if now_s < one.until_s]
        waiting = []
        for pending in self._pending:
            envelope, future, result, by_s = pending
            if not future.done() and now_s < by_s:
                waiting.append(pending)
                continue
            try:
                told = future.result() if future.done() else None
                self._answer(envelope, encode_reply(result if told is None else told))
            except TactomoError as error:
                self._answer(envelope, encode_error(error.name, error.cause, error.next_step))
        self._pending = waiting

    def _answer(self, envelope: list[bytes], reply: bytes) -> None:
        message = [*envelope, reply]
        # Who asks and never reads holds up nobody, and is remembered for so many answers.
        if not self._send(message) and len(self._unread) < MAX_PENDING:
            self._unread.append(_Unread(message, time.monotonic() + UNREAD_S))

    def _send(self, message: list[bytes]) -> bool:
        """Whether nothing is left to do: it was sent, or nobody is there any more."""
        try:
            self._socket.send_multipart(message, zmq.DONTWAIT)
        except zmq.Again:
            return False
        except zmq.ZMQError as error:
            if error.errno != zmq.EHOSTUNREACH:
                raise
        return True
