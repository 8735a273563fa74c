"""What can go wrong between a client and the daemon, each with a name, a cause and a next step.

ClientError
├── MessageError    a message does not follow STREAM.md: another program publishes there,
│                   or its version is another one
├── ControlError    a command was refused, or nothing answered it: `tactomo tare` while
│                   somebody presses the skin, the daemon is not running
├── StreamTimeout   no frame came within `timeout_s`: the cable is out, the name is misspelt
├── KeysError       keys cannot be used (the file is missing, others may read it), or the server
│                   does not let them in: the client is not on its list, it is another server
└── RecordingError  a recording cannot be read: there is no such file, it is another program's, or
                    there are no maps and contacts in it
"""

from __future__ import annotations


class ClientError(Exception):
    """Anything this package raises on purpose.

    Attributes:
        name: a short stable identifier such as ``no_answer``, for programs.
        cause: what went wrong, for people.
        next_step: what to do about it, for people; may be empty.

    """

    def __init__(self, cause: str, next_step: str = "", name: str = "client_error") -> None:
        super().__init__(f"{cause}; {next_step}" if next_step else cause)
        self.name = name
        self.cause = cause
        self.next_step = next_step


class MessageError(ClientError, ValueError):
    """Bytes that are not a message of this schema, or values that cannot become one."""

    def __init__(self, cause: str, next_step: str = "") -> None:
        super().__init__(cause, next_step, name="malformed_message")


class ControlError(ClientError):
    """A command that was refused or not answered; `name` says which of the two and why."""


class StreamTimeout(ClientError, TimeoutError):  # noqa: N818 - named for what happened
    """No frame within the time the caller allowed."""

    def __init__(self, cause: str, next_step: str = "") -> None:
        super().__init__(cause, next_step, name="stream_timeout")


class KeysError(ClientError):
    """Keys that cannot be used, or that a server does not let in; `name` says which."""

    def __init__(self, cause: str, next_step: str = "", name: str = "bad_keys") -> None:
        super().__init__(cause, next_step, name)


class RecordingError(ClientError):
    """A recording that cannot be read; `name` is ``no_frames`` where it holds no frames."""

    def __init__(self, cause: str, next_step: str = "", name: str = "bad_recording") -> None:
        super().__init__(cause, next_step, name)
