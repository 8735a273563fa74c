"""What can go wrong between a client and the daemon, each with a name, a cause and a next step.

ClientError
├── MessageError    a message does not follow STREAM.md: another program publishes there,
│                   or its version is another one
├── ControlError    a command was not carried out; `name` says why, and some have a class
├── StreamTimeout   no frame came within `timeout_s`: the cable is out, the name is misspelt
├── KeysError       keys cannot be used (the file is missing, others may read it), or the server
│                   does not let them in: the client is not on its list, it is another server
└── RecordingError  a recording cannot be read: there is no such file, it is another program's, or
                    there are no maps and contacts in it

And the checks of what callers give: `checked_seconds`, `open_regular`.
"""

from __future__ import annotations

import errno
import math
import re
import stat
from numbers import Real
from pathlib import Path
from typing import IO


class ClientError(Exception):
    """Anything this package raises on purpose."""

    name = "client_error"  #: a short stable identifier such as ``no_answer``, for programs

    def __init__(self, cause: str, next_step: str = "", name: str = "") -> None:
        super().__init__(f"{cause}; {next_step}" if next_step else cause)
        self.name = name or type(self).name
        self.cause = cause  #: what went wrong, for people
        self.next_step = next_step  #: what to do about it, for people; may be empty


class MessageError(ClientError, ValueError):
    """Bytes that are not a message of this schema, or values that cannot become one."""

    name = "malformed_message"

    def __init__(self, cause: str, next_step: str = "compare it with STREAM.md") -> None:
        super().__init__(cause, next_step)


class ControlError(ClientError):
    """A command that was refused or not answered; `name` says which of the two and why.

    Example::

        try:
            scans = daemon.tare().scans
        except TareRefused as error:
            print(error.cause, error.next_step)
    """


class NoAnswer(ControlError):  # noqa: N818 - this and what follows: named for what happened
    """``no_answer``: nothing answers at the address within the time."""


class BadArgument(ControlError):  # noqa: N818
    """``bad_argument``: missing, unknown, of the wrong type or out of range."""


class TareRefused(ControlError):  # noqa: N818
    """``tare_refused``: the scans were too uneven for a reference; somebody presses."""


class NoData(ControlError):  # noqa: N818
    """``no_data``: there were no scans to make a reference of."""


class AlreadyRecording(ControlError):  # noqa: N818
    """``already_recording``: a recording runs already; stop it first."""


class NotRecording(ControlError):  # noqa: N818
    """``not_recording``: no recording runs."""


class CannotWrite(ControlError):  # noqa: N818
    """``cannot_write``: the recording's file exists, or it or its folder cannot be written."""


class NoNetwork(ControlError):  # noqa: N818
    """``no_network``: the sensor has no network for that method."""


class NoReplay(ControlError):  # noqa: N818
    """``no_replay``: the daemon's ports are live."""


class CalibrationRefused(ControlError):  # noqa: N818
    """``calibration_refused``: damaged, or of another sensor or device; the old one stays."""


_OF_NAME = {
    "_".join(re.findall("[A-Z][a-z]+", each.__name__)).lower(): each
    for each in ControlError.__subclasses__()
}


def control_error(cause: str, next_step: str, name: str) -> ControlError:
    """Return the error of that name, of its own class where it has one."""
    return _OF_NAME.get(name, ControlError)(cause, next_step, name)


class StreamTimeout(ClientError, TimeoutError):  # noqa: N818 - named for what happened
    """No frame within the time the caller allowed."""

    name = "stream_timeout"


class KeysError(ClientError):
    """Keys that cannot be used, or that a server does not let in; `name` says which."""

    name = "bad_keys"


class RecordingError(ClientError):
    """A recording that cannot be read; `name` is ``no_frames`` where it holds no frames."""

    name = "bad_recording"


def checked_seconds(
    name: str, value: object, *, endless: bool = True, zero: bool = True, past: bool = False
) -> float:
    """Return a time in seconds as a float.

    Args:
        name: of the argument, for the error.
        value: what was given for it.
        endless: whether infinity makes sense.
        zero: whether 0 does.
        past: whether less does: what is left of a time that is over.

    Raises:
        TypeError: it is no number.
        ValueError: it is NaN, or makes no sense.
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(f"{name} = {value!r} is no number: give seconds, such as 0.5")
    try:
        seconds = float(value)
    except OverflowError:
        seconds = -math.inf if value < 0 else math.inf
    is_in_range = past or seconds > 0 or (zero and seconds == 0)
    if is_in_range and not math.isnan(seconds) and (endless or math.isfinite(seconds)):
        return seconds
    allowed = "any but NaN" if past else "0 or more" if zero else "more than 0"
    raise ValueError(f"{name} = {value!r}: give {'' if endless else 'finite '}seconds, {allowed}")


def open_regular(path: Path) -> IO[bytes]:
    """Open a regular file for reading: a pipe may never end, and a device may do anything.

    Raises OSError where it cannot be opened, or is no regular file.
    """
    is_regular = stat.S_ISREG(path.stat().st_mode)
    if not is_regular or path.resolve().parts[1] in ("proc", "sys"):  # the kernel's may never end
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    return path.open("rb")
