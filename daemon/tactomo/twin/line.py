"""One simulated serial line: the device's end of a pseudo-terminal.

The host opens `SerialLine.path` as it would open ``/dev/ttyACM0``. The device's end behaves as a
UART without flow control does: it never waits. What does not fit into the line's buffer is lost,
in whole frames, and counted; what is sent while nobody has the port open is lost, too. A cable can
be pulled and put back.

Only the device's end is held here. Holding the host's end as well would keep reads from failing
while nobody listens, but it would also hide from the device that nobody listens (the next program
to open the port would first get seconds-old scans) and make this process look like the port's
user.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import select
import socket
import struct
import tty
from pathlib import Path

from tactomo.errors import TactomoError, os_errors_as

READ_BYTES = 4096
HOLDER_WAIT_S = 1.0


class SerialLine:
    """The device's end of one line. For use by one thread."""

    def __init__(self, name: str, link_folder: Path | None = None) -> None:
        self.name = name  # what the line carries; no two twins that run have the same link
        # frames handed over whole; lost to a full line; lost to nobody who had the port open
        self.sent = self.dropped = self.unheard = 0
        self._link = None if link_folder is None else link_folder / name
        self._claim = None if self._link is None else _claim(self._link)
        self._descriptor: int | None = None
        self._device = ""
        self._rest = b""
        try:
            self.plug()
        except BaseException:
            self.close()
            raise

    @property
    def path(self) -> str:
        """What the host opens: the link where there is one, otherwise the device."""
        return self._device if self._link is None else str(self._link)

    @property
    def is_plugged(self) -> bool:
        """Whether the cable is in."""
        return self._descriptor is not None

    @property
    def is_open(self) -> bool:
        """Whether some program has the host's end open."""
        return self._descriptor is not None and not _events(self._descriptor) & select.POLLHUP

    def fileno(self) -> int:
        """Return the descriptor to wait on; only while the cable is in."""
        if self._descriptor is None:
            raise ValueError(f"{self.name}: the cable is out")
        return self._descriptor

    def plug(self) -> None:
        """Put the cable in: a new device appears and the link, if any, points to it."""
        if self._descriptor is not None:
            return
        device_end, host_end = os.openpty()
        tty.setraw(host_end)  # the mode outlives this descriptor: the next opener finds it raw
        self._device = os.ttyname(host_end)
        os.close(host_end)
        os.set_blocking(device_end, False)
        self._descriptor = device_end
        self._make_link()

    def unplug(self) -> None:
        """Pull the cable: the host's end fails from now on and the link disappears."""
        if self._descriptor is None:
            return
        os.close(self._descriptor)
        self._descriptor, self._rest = None, b""
        self._remove_link()

    def close(self) -> None:
        """Pull the cable for good: the link's name is free for another twin."""
        self.unplug()
        if self._claim is not None:
            self._claim.close()

    def send(self, frame: bytes) -> None:
        """Put one frame on the line, or lose it; never waits."""
        if not self.is_open:
            self._rest = b""
            self.unheard += 1
            return
        # A frame that has begun is finished first: half a frame would cost the next one, too.
        self._rest = self._write(self._rest)
        if self._rest:
            self.dropped += 1
            return
        rest = self._write(frame)
        if len(rest) == len(frame):
            self.dropped += 1
            return
        self._rest = rest
        self.sent += 1

    def push(self, data: bytes) -> bytes:
        """Put on the line what fits, and return the rest; for a device that can wait."""
        self._rest = self._write(self._rest)
        return data if self._rest else self._write(data)

    def receive(self) -> bytes:
        """Return what the host has sent, possibly nothing; never waits."""
        if self._descriptor is None:
            return b""
        try:
            return os.read(self._descriptor, READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as error:
            if error.errno == errno.EIO:  # nobody has the host's end open
                return b""
            raise

    def _write(self, data: bytes) -> bytes:
        if not data or self._descriptor is None:
            return b""
        try:
            return data[os.write(self._descriptor, data) :]
        except BlockingIOError:
            return data

    def _make_link(self) -> None:
        if self._link is None:
            return
        step = "give --link a folder that you may write to"
        with os_errors_as(TactomoError, f"cannot make the link {self._link}", step):
            self._link.parent.mkdir(parents=True, exist_ok=True)
            if self._link.is_symlink():  # left over from a twin that was killed
                self._link.unlink()
            self._link.symlink_to(self._device)

    def _remove_link(self) -> None:
        """Remove the link, unless somebody has meanwhile taken the name."""
        link = self._link
        if link is not None and link.is_symlink() and os.readlink(link) == self._device:
            link.unlink()


def _claim(link: Path) -> socket.socket:
    """Return what keeps other twins off a link's name, until it is closed or this process ends.

    A socket's abstract name is held by one process and outlives none; whoever finds it taken asks
    by whom. The link itself could not tell: what a killed twin left behind points to a terminal
    whose number may be another's by now.

    Raises TactomoError where a twin that runs has the name.
    """
    place = str(link.parent.resolve() / link.name).encode(errors="surrogateescape")
    name = b"\0tactomo-twin-" + hashlib.sha256(place).hexdigest().encode()
    claim = socket.socket(socket.AF_UNIX)
    try:
        claim.bind(name)
        claim.listen()
    except OSError as error:
        claim.close()
        if error.errno != errno.EADDRINUSE:
            raise
        raise TactomoError(
            f"the link {link} is that of another twin that runs{_holder(name)}",
            "stop that one, or give --link another folder",
        ) from error
    return claim


def _holder(name: bytes) -> str:
    """Return which process holds a socket's name, for people; empty where that cannot be told."""
    credentials = struct.Struct("3i")  # pid, user, group
    with socket.socket(socket.AF_UNIX) as caller, contextlib.suppress(OSError):
        caller.settimeout(HOLDER_WAIT_S)
        caller.connect(name)
        told = caller.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, credentials.size)
        pid, _, _ = credentials.unpack(told)
        return f" (pid {pid})" if pid else ""  # 0: in another container
    return ""


def _events(descriptor: int) -> int:
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return sum(event for _, event in poll.poll(0))
