"""Opening a serial port for this process alone, with an error for each way in which that can fail.

Two locks keep others out, since neither does so by itself. ``flock`` stops a second daemon, and
whoever else asks for it. ``TIOCEXCL`` stops everybody who comes later, root excepted. Who came
earlier, or is root, is looked up among the processes and named: two readers of one port each get
a part of the bytes, so a port that is shared is of no use.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
import termios
import time
from pathlib import Path
from typing import Final

import serial

from tactomo.acquisition import adapters
from tactomo.errors import PortAbsentError, PortBusyError, PortError

READ_TIMEOUT_S: Final = 0.1
"""How long a read waits for its first byte, so how soon a reader notices that it should stop."""
WRITE_TIMEOUT_S: Final = 0.05
"""How long a device that does not take its commands may keep a reader from reading."""
DEVICE_GONE: Final = (OSError, TypeError, ValueError, termios.error)
"""What pyserial raises when a device goes away in the middle of a call: SerialException, which is
an OSError, the operating system's own one, termios.error while it is set up, and TypeError or
ValueError where its descriptor has become None or is closed."""

_GLANCE_S: Final = 0.05


def open_serial(url: str, baud: int) -> serial.Serial:
    """Open a path or a pyserial URL for this process alone; the PortError says why not."""
    try:
        port: serial.Serial = serial.serial_for_url(
            url,
            baudrate=baud,
            timeout=READ_TIMEOUT_S,
            write_timeout=WRITE_TIMEOUT_S,
            exclusive=True,
        )
    except DEVICE_GONE as error:
        raise _explain(url, baud, error) from error
    if is_path(url):
        _claim(port, url, baud)
    return port


def is_path(url: str) -> bool:
    """Whether a port's name is a path rather than a pyserial URL."""
    return "://" not in url


def require_present(url: str) -> None:
    """Raise PortAbsentError where a path does not exist: known before anything is built."""
    if is_path(url) and not os.path.exists(url):
        raise _absent(url)


def other_holders(url: str, root: Path = adapters.ROOT) -> list[adapters.Holder]:
    """Return the other processes that use the port, as far as this user may see."""
    found = adapters.holders(url, root) if is_path(url) else []
    return [who for who in found if who.pid != os.getpid() and not who.is_far_end]


def lower_latency(port: serial.Serial, root: Path = adapters.ROOT) -> int | None:
    """Have an FTDI adapter send every millisecond rather than every 16, where that is allowed.

    Returns the latency timer in force then, in ms; None for an adapter without one.
    """
    path = port.name or ""
    timer_ms = adapters.latency_timer_ms(path, root)
    if timer_ms is not None and timer_ms > adapters.LOW_LATENCY_MS:
        with contextlib.suppress(ValueError):  # not allowed, or the driver cannot
            port.set_low_latency_mode(True)
        timer_ms = adapters.latency_timer_ms(path, root)
    return timer_ms


def how_to_grant(path: str) -> str:
    """Say how a user gets to open a device."""
    with contextlib.suppress(OSError, KeyError):
        about = os.stat(path)
        if about.st_mode & stat.S_IWGRP and about.st_gid != 0:
            return f"`sudo usermod -aG {Path(path).group()} $USER`, then log in again"
    return "have root let its group read and write it, by a udev rule"


def _claim(port: serial.Serial, path: str, baud: int) -> None:
    """Keep others out of an open port, or close it and raise PortBusyError naming them."""
    try:
        # A pseudo-terminal keeps the mark when its last user has gone, killed ones too.
        if os.major(os.fstat(port.fileno()).st_rdev) not in adapters.PTY_MAJORS:
            fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
        if other_holders(path):
            time.sleep(_GLANCE_S)  # another daemon that was turned away needs a moment to close it
            others = other_holders(path)
            if others:
                raise _busy(path, others)
    except BaseException as error:
        port.close()
        if isinstance(error, DEVICE_GONE):
            raise _explain(path, baud, error) from error
        raise


def _explain(url: str, baud: int, error: Exception) -> PortError:
    number = getattr(error, "errno", None)
    if number in (errno.EAGAIN, errno.EBUSY):
        return _busy(url, adapters.holders(url))
    if number == errno.ENOENT:
        return _absent(url)
    if number in (errno.EACCES, errno.EPERM):
        return PortError(f"{url} may not be opened by this user", how_to_grant(url))
    if not is_path(url) or number is not None or Path(url).is_char_device():
        return PortError(f"cannot open {url} at {baud} baud: {error}", "check port and baud rate")
    return PortError(f"{url} is not a serial device", "give a path such as /dev/ttyACM0")


def _absent(url: str) -> PortAbsentError:
    return PortAbsentError(
        f"{url} does not exist", "connect the device; `tactomo ports` shows those that are there"
    )


def _busy(url: str, by: list[adapters.Holder]) -> PortBusyError:
    who = "; ".join(map(str, by)) or "whose, this user may not see"
    return PortBusyError(
        f"{url} is held by another process ({who})",
        "stop it, or give another port"
        if by
        else f"`sudo fuser -v {url}` shows it; stop it, or give another port",
    )
