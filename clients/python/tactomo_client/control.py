"""Commands to a running daemon (or twin): one request, one reply, a clear error otherwise."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import zmq

from tactomo_client.connection import Connection, Owner, Waiting, wait, whole_ms
from tactomo_client.errors import ClientError, ControlError, checked_seconds, control_error
from tactomo_client.filled import filled
from tactomo_client.keys import Keys, as_keys
from tactomo_client.messages import DEFAULT_CONTROL, decode_reply, encode_request
from tactomo_client.schema import STALE_AFTER_S, Calibration, Status, Taught

TIMEOUT_S: Final = 2.0
TARE_TIMEOUT_S: Final = 30.0  #: for a tare: as long as its dual scans take to come
RECORD_TIMEOUT_S: Final = 10.0  #: for a recording: a disk may take its time
CONNECT_TIMEOUT_S: Final = 5.0
"""How long nothing may listen at the address: a daemon that was started just now takes 2 to 3 s."""
RELOAD_TIMEOUT_S: Final = 10.0  #: for a calibration: until the frame that is being made is done
LOOK_S: Final = 0.1


def request(
    command: str,
    address: str = DEFAULT_CONTROL,
    timeout_s: float = TIMEOUT_S,
    *,
    keys: Keys | str | Path | None = None,
    **arguments: Any,
) -> dict[str, Any]:
    """Send one command and return its result as it came; `Daemon` has the daemon's commands typed.

    Args:
        command: one of the control commands of STREAM.md, for example ``tare``.
        address: the control socket of the daemon, or of the twin.
        timeout_s: how long to wait for the reply, seconds; but no longer than 5 s where nothing
            listens at the address (see `Control`).
        keys: keys, or the folder that holds them, for a daemon beyond this computer.
        **arguments: the command's arguments, for example ``tier="fit"``.

    Raises:
        ControlError: the command was refused, or nothing answered (`NoAnswer`).
        KeysError: the keys cannot be used, or the server does not let them in.
        MessageError: what answered does not speak this protocol.
        TypeError, ValueError: `timeout_s` makes no sense.

    Example::

        request("press", DEFAULT_TWIN_CONTROL, x_mm=10.0, y_mm=0.0)
    """
    with Control(address, keys=keys) as control:
        return control.request(command, timeout_s, **arguments)


class ControlLine:
    """Sends commands over one socket, one at a time, whether a thread or an event loop waits.

    The socket is kept from command to command, and left for another after one that was not
    answered: a REQ socket cannot send again then.

    Args:
        address: where the control socket is.
        keys: keys, or the folder that holds them, for a daemon beyond this computer.
        timeout_s: how long to wait for replies, seconds, where nothing else is said.
        connect_timeout_s: how long, of that, while nothing listens at the address. A program that
            starts a daemon and gives it a command at once may need more, as where the sensor's
            models are to be built first.

    Raises:
        TypeError, ValueError: a time is no number, or is not above 0.
    """

    def __init__(
        self,
        address: str = DEFAULT_CONTROL,
        *,
        keys: Keys | str | Path | None = None,
        timeout_s: float = TIMEOUT_S,
        connect_timeout_s: float = CONNECT_TIMEOUT_S,
    ) -> None:
        self.address = address
        self.timeout_s = checked_seconds("timeout_s", timeout_s, zero=False)
        self._connect_timeout_s = checked_seconds(
            "connect_timeout_s", connect_timeout_s, zero=False
        )
        self._keys = as_keys(keys)
        self._connection: Connection | None = None

    def _open(self) -> Owner:
        raise NotImplementedError

    def _exchange(
        self, command: str, arguments: Mapping[str, Any], given_timeout_s: float | None
    ) -> Waiting[dict[str, Any]]:
        """Send one command; the outcome is its result, errors are those of `request`."""
        timeout_s = self.timeout_s if given_timeout_s is None else given_timeout_s
        checked_seconds("timeout_s", timeout_s, zero=False)
        message = encode_request(command, arguments)
        connection = self._connection or self._connect()
        reply, is_sent = None, False
        begin_s = time.monotonic()
        replied_by_s, connected_by_s = begin_s + timeout_s, begin_s + self._connect_timeout_s
        try:
            while reply is None:
                is_sent = is_sent or connection.send(message)
                end_s = min(replied_by_s, connected_by_s)
                if (yield connection.owner, whole_ms(min(LOOK_S, end_s - time.monotonic()))):
                    reply = connection.receive()
                    continue
                if refusal := connection.refusal():
                    raise refusal
                now_s = time.monotonic()
                if connection.handshakes.is_connected:
                    connected_by_s = now_s + self._connect_timeout_s
                if now_s >= min(replied_by_s, connected_by_s) or not connection.is_open:
                    raise _no_answer(connection, min(timeout_s, now_s - begin_s))
        finally:
            if reply is None:
                self.close()
        return decode_reply(reply)

    def close(self) -> None:
        """Close the connection; the next command opens another. Closing twice is fine."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _connect(self) -> Connection:
        self._connection = Connection(self._open(), self.address, self._keys)
        self._connection.connect()
        return self._connection


@dataclass(frozen=True, slots=True)
class Tare:
    """A new reference is in force."""

    scans: int  #: how many dual scans it is made of
    contacts: int = 0  #: how many contacts were shown meanwhile: they count as nothing pressed now


@dataclass(frozen=True, slots=True)
class RecordingStarted:
    """A recording runs."""

    path: str  #: the file, on the daemon's computer


@dataclass(frozen=True, slots=True)
class RecordedFile:
    """A recording that was stopped."""

    path: str  #: the file, on the daemon's computer; the last one of several
    bytes: int


@dataclass(frozen=True, slots=True)
class MethodInForce:
    """What solves frames from now on."""

    tier: str  #: the method's name; the stream calls it a tier


@dataclass(frozen=True, slots=True)
class BudgetInForce:
    """How much work a frame may take from now on."""

    budget_ms: float | None  #: None for the method's own


@dataclass(frozen=True, slots=True)
class CalibrationInForce:
    """What changes are turned into pressures by from now on."""

    calibration: Calibration | None  #: None for the table of the sensor's description
    taught: Taught | None = None  #: what corrects where contacts are; None for nothing


@dataclass(slots=True)
class RunningRecording:
    """A recording that runs as long as its `with` block."""

    path: str  #: the file, on the daemon's computer; the first one of several
    file: RecordedFile | None = None  #: what was recorded; None as long as it runs


class Control(ControlLine):
    """A control socket, the daemon's or the twin's. Close it, or use it in a `with` block.

    Connects with the first command, and again by itself after the other side was restarted. Belongs
    to the thread that uses it; `tactomo_client.aio` has the same for asyncio. Arguments are those
    of `ControlLine`.

    Example::

        with Control(DEFAULT_TWIN_CONTROL) as twin:
            twin.request("press", x_mm=10.0, y_mm=0.0)
    """

    def request(
        self, command: str, timeout_s: float | None = None, /, **arguments: Any
    ) -> dict[str, Any]:
        """Send any command and return its result as it came; errors are those of `request`."""
        return wait(self._exchange(command, arguments, timeout_s))

    def _open(self) -> Owner:
        return zmq.Context.instance().socket(zmq.REQ)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Daemon(Control):
    """A running daemon, to be given commands: a `Control` that knows them.

    Every command raises the `ControlError` that says why it was not carried out (NoAnswer, and
    those named with it), KeysError where the server does not let this client in, and MessageError
    where what answers does not speak this protocol.

    Example::

        with Daemon() as daemon:
            daemon.tare()
            with daemon.record("grasp.mcap", maps=True):
                grasp()
    """

    def status(self) -> Status:
        """Return how it is: what `tactomo status` shows.

        Example::

            if daemon.status().state != "running":
                ...
        """
        return to_status(self.request("status"))

    def tare(self, timeout_s: float = TARE_TIMEOUT_S) -> Tare:
        """Take a new reference: the next scans of the *unloaded* skin count as nothing pressed.

        Raises:
            TareRefused: somebody presses.
            NoData: no scans come.
        """
        return filled(Tare, self.request("tare", timeout_s))

    def record_start(
        self, path: str | Path | None = None, *, maps: bool | None = None
    ) -> RecordingStarted:
        """Start a recording of what the ports say, which goes on until `record_stop`.

        Args:
            path: the file to write, below the folder of recordings that the daemon is configured
                with, on its computer. None: files that it names and cuts itself.
            maps: whether maps and contacts are recorded, too; None: as the daemon is configured.

        Raises:
            AlreadyRecording: one runs.
            CannotWrite: the file exists, or cannot be created, or the disk is full.
        """
        arguments: dict[str, Any] = {} if path is None else {"path": str(path)}
        if maps is not None:
            arguments["maps"] = maps
        return filled(RecordingStarted, self.request("record_start", RECORD_TIMEOUT_S, **arguments))

    def record_stop(self) -> RecordedFile:
        """Stop the recording.

        Raises:
            NotRecording: none runs.
            CannotWrite: it could not be written to its end.
        """
        return filled(RecordedFile, self.request("record_stop", RECORD_TIMEOUT_S))

    @contextmanager
    def record(
        self, path: str | Path | None = None, *, maps: bool | None = None
    ) -> Iterator[RunningRecording]:
        """Record during a `with` block; arguments and errors are those of `record_start`.

        Example::

            with daemon.record("grasp.mcap", maps=True) as recording:
                grasp()
            print(recording.file.bytes)
        """
        recording = RunningRecording(self.record_start(path, maps=maps).path)
        try:
            yield recording
        except BaseException:
            with suppress(ClientError):  # what happened in the block is what counts
                self.record_stop()
            raise
        recording.file = self.record_stop()

    def set_method(self, method: str) -> MethodInForce:
        """Choose what solves frames: one of `Status.methods`, such as ``auto`` or ``fit``.

        Raises:
            BadArgument: there is no such method, or the sensor lacks a channel that it needs.
            NoNetwork: the sensor has no network for it.
        """
        return filled(MethodInForce, self.request("set_tier", tier=method))

    set_tier = set_method  # as the stream calls it

    def set_budget(self, budget_ms: float | None) -> BudgetInForce:
        """Choose the work of a frame, in ms of a 2.5 GHz core; None leaves it to the method.

        Raises:
            BadArgument: not more than 0.
        """
        return filled(BudgetInForce, self.request("set_budget", budget_ms=budget_ms))

    def reload_calibration(self) -> CalibrationInForce:
        """Have the sensor's pressure calibration read again: a new one is in force at once.

        It is looked for on the daemon's computer, where it is looked for at the start.

        Raises:
            CalibrationRefused: it is damaged, or of another sensor or device; what was in force
                stays so.
        """
        return filled(CalibrationInForce, self.request("reload_calibration", RELOAD_TIMEOUT_S))


def to_status(result: Mapping[str, Any]) -> Status:
    """Return the status in the reply to the command of that name, which has just come."""
    return Status.from_fields(result, time.monotonic_ns(), STALE_AFTER_S)


def _no_answer(connection: Connection, waited_s: float) -> ControlError:
    silence = f"nothing answered at {connection.address} within {waited_s:.2g} s"
    if connection.handshakes.is_connected:
        return control_error(
            f"{silence}, though something listens there",
            "if it is the daemon's control socket, its log says what it is busy with",
            "no_answer",
        )
    return control_error(
        f"{silence}: nothing listens there",
        "start the daemon with `tactomo daemon` (with a simulated skin: `tactomo demo`), or give "
        "the address of the running daemon",
        "no_answer",
    )
