"""Opening a serial port, with an error for each way in which that can fail."""

from __future__ import annotations

import contextlib
import errno
import os
import termios
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import serial

from tactomo.errors import PortBusyError, PortError, TactomoError
from tactomo.protocol_replay import register

READ_TIMEOUT_S: Final = 0.1
"""How long a read waits for its first byte, so how soon a reader notices that it should stop."""
WRITE_TIMEOUT_S: Final = 0.5
# pyserial lets termios.error through where a device vanishes while it is being set up.
OPEN_FAILURES: Final = (OSError, ValueError, termios.error)


def open_serial(url: str, baud: int) -> serial.Serial:
    """Open a device's path or a pyserial URL, locked against a second daemon.

    Raises:
        PortBusyError: another process holds it.
        PortError: it does not exist, is no serial device or may not be opened.
        RecordingError: it is a replay of what is no recording.

    """
    register()
    try:
        return serial.serial_for_url(
            url,
            baudrate=baud,
            timeout=READ_TIMEOUT_S,
            write_timeout=WRITE_TIMEOUT_S,
            exclusive=True,
        )
    except TactomoError:
        raise
    except OPEN_FAILURES as error:
        raise _explain(url, baud, error) from error


def _explain(url: str, baud: int, error: Exception) -> PortError:
    number = getattr(error, "errno", None)
    if number in (errno.EAGAIN, errno.EBUSY):
        pids = list(_holders(url))
        who = "another process" + (f" (pid {', '.join(map(str, pids))})" if pids else "")
        return PortBusyError(f"{url} is held by {who}", "stop it, or give another port")
    if number == errno.ENOENT:
        return PortError(
            f"{url} does not exist",
            "connect the device; `ls /dev/serial/by-id` shows those that are there",
        )
    if number in (errno.EACCES, errno.EPERM):
        return PortError(
            f"{url} may not be opened by this user",
            "add the user to the group that owns it: `ls -l` shows which, often dialout",
        )
    if not url.startswith("/") or number is not None or Path(url).is_char_device():
        return PortError(f"cannot open {url} at {baud} baud: {error}", "check port and baud rate")
    return PortError(f"{url} is not a serial device", "give a path such as /dev/ttyACM0")


def _holders(path: str) -> Iterator[int]:
    """Yield the processes that have the device open, as far as this user may see."""
    device = os.path.realpath(path)
    for process in Path("/proc").glob("[0-9]*"):
        if device in _open_files(process):
            yield int(process.name)


def _open_files(process: Path) -> Iterator[str]:
    with contextlib.suppress(OSError):  # the process is not ours to look at, or gone by now
        for descriptor in os.listdir(process / "fd"):
            with contextlib.suppress(OSError):  # closed by now
                yield os.readlink(process / "fd" / descriptor)
