"""What the operating system knows about serial adapters: names, makers, holders, habits.

It is read from the files of Linux: ``/sys`` for the hardware, ``/dev`` for the names that udev
gives, ``/proc`` for who has a device open, ``/run/udev`` for udev's properties. All of it may
change while it is read, so what has gone by then counts as absent.

`root` is the folder in which those four lie.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path("/")
LINK_FOLDERS: Final = ("tactomo", "serial/by-id", "serial/by-path")
"""Where udev puts lasting names below ``/dev``, the most telling one first."""
PTY_MAJORS: Final = range(136, 144)
LOW_LATENCY_MS: Final = 2  # a latency timer of up to so much costs a scan nothing worth telling of

_COMMAND_LENGTH: Final = 100
_PTY_MASTERS: Final = {"/dev/ptmx", "/dev/pts/ptmx"}
_MODEM_MANAGER: Final = "ModemManager"
# Either keeps ModemManager away: the first of a whole device, the second of one port.
_IGNORED: Final = ("E:ID_MM_DEVICE_IGNORE=1", "E:ID_MM_PORT_IGNORE=1")


@dataclass(frozen=True, slots=True)
class Holder:
    """A process that has a device open."""

    pid: int
    command: str
    is_far_end: bool  # whether it plays the device: it has the other end of a pseudo-terminal, too

    def __str__(self) -> str:
        return f"pid {self.pid}: {self.command}"


@dataclass(frozen=True, slots=True)
class Adapter:
    """One serial port of this computer. What is not known is empty or None."""

    path: str
    names: tuple[str, ...]  # links that udev made to it, in the order of LINK_FOLDERS
    driver: str
    vendor_id: int | None  # of USB, as `product_id`; None for a port that is built in
    product_id: int | None
    maker: str
    product: str
    serial_number: str
    interface: int | None  # number of the USB interface: chips with several ports have one for each
    latency_timer_ms: int | None  # how long an FTDI chip waits for more bytes before it sends some
    is_kept_from_modem_manager: bool

    @property
    def is_usb(self) -> bool:
        """Whether it can be plugged in and out."""
        return self.vendor_id is not None


def list_adapters(root: Path = ROOT) -> list[Adapter]:
    """Return the serial ports that are there, those on USB first, each kind by its number."""
    folders = (root / "sys/class/tty").glob("*")
    adapters = [_adapter(folder, root) for folder in folders if _is_there(folder)]
    return sorted(adapters, key=lambda adapter: (not adapter.is_usb, _natural(adapter.path)))


def lasting_name(adapter: Adapter, others: list[Adapter]) -> str:
    """Return the name to configure: one that survives unplugging and means this adapter alone.

    A name by id lasts only where no other adapter has the same maker, product and serial number;
    one by path always means the same USB socket. Empty where udev gave none.
    """
    shared = bool(look_alikes(adapter, others))
    usable = [name for name in adapter.names if not (shared and "/by-id/" in name)]
    return usable[0] if usable else ""


def look_alikes(adapter: Adapter, others: list[Adapter]) -> list[Adapter]:
    """Return the other adapters that USB cannot tell from this one."""
    return [
        other
        for other in others
        if other.path != adapter.path and adapter.is_usb and _identity(other) == _identity(adapter)
    ]


def device_of(path: str) -> str:
    """Return the device that a name stands for, or the name if it goes while it is looked at."""
    try:
        return os.path.realpath(path)
    except OSError:  # it was a link a moment ago
        return path


def latency_timer_ms(path: str, root: Path = ROOT) -> int | None:
    """Return the latency timer of an FTDI adapter in force, in ms; None for any other port."""
    name = os.path.basename(device_of(path))
    return _number(root / "sys/class/tty" / name / "device/latency_timer")


def holders(path: str, root: Path = ROOT) -> list[Holder]:
    """Return the processes that have a device open, as far as this user may see."""
    device = device_of(path)
    opened = {folder: dict(_open_files(folder)) for folder in (root / "proc").glob("[0-9]*")}
    return [
        _holder(folder, files)
        for folder, files in opened.items()
        if device in files and _is_same(files[device], device)
    ]


def modem_manager_runs(root: Path = ROOT) -> bool:
    """Return whether ModemManager, which tries new serial ports for a modem, is running."""
    return any(_text(comm) == _MODEM_MANAGER for comm in (root / "proc").glob("[0-9]*/comm"))


def _is_there(folder: Path) -> bool:
    """Whether hardware is behind a tty: none is behind consoles and unused built-in ports."""
    return (folder / "device").exists() and _text(folder / "type") != "0"


def _adapter(folder: Path, root: Path) -> Adapter:
    device = _resolved(folder / "device")
    usb = _nearest(device, "idVendor")
    interface = _nearest(device, "bInterfaceNumber")
    path = root / "dev" / folder.name
    return Adapter(
        path=f"/dev/{folder.name}",
        names=tuple(_names(path, root)),
        driver=_resolved(device / "driver").name if (device / "driver").exists() else "",
        vendor_id=_number(usb / "idVendor", 16) if usb else None,
        product_id=_number(usb / "idProduct", 16) if usb else None,
        maker=_text(usb / "manufacturer") if usb else "",
        product=_text(usb / "product") if usb else "",
        serial_number=_text(usb / "serial") if usb else "",
        interface=_number(interface / "bInterfaceNumber", 16) if interface else None,
        latency_timer_ms=_number(device / "latency_timer"),
        is_kept_from_modem_manager=any(
            _is_ignored(part / "dev", root) for part in (folder, usb) if part
        ),
    )


def _nearest(device: Path, file: str) -> Path | None:
    """Return the folder that has such a file, of a device or of what it is plugged into."""
    return next((part for part in (device, *device.parents) if (part / file).exists()), None)


def _names(path: Path, root: Path) -> Iterator[str]:
    device = _resolved(path)
    for folder in LINK_FOLDERS:
        for link in sorted((root / "dev" / folder).glob("*")):
            if _resolved(link) == device:
                yield f"/dev/{folder}/{link.name}"


def _is_ignored(number: Path, root: Path) -> bool:
    """Whether udev's rules keep ModemManager away from the character device of this number."""
    properties = _text(root / "run/udev/data" / f"c{_text(number)}").splitlines()
    return any(line in properties for line in _IGNORED)


def _identity(adapter: Adapter) -> tuple[object, ...]:
    return (adapter.vendor_id, adapter.product_id, adapter.serial_number, adapter.interface)


def _natural(path: str) -> list[tuple[int, str]]:
    """Sort key that puts ttyUSB2 before ttyUSB10."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", path)]


def _is_same(descriptor: Path, device: str) -> bool:
    """Whether an open file of a device's name is that device.

    Containers have pseudo-terminals of their own, under the names and numbers that ours have.
    """
    try:
        opened, ours = os.stat(descriptor), os.stat(device)
    except OSError:  # closed by now, or not there: its name is all there is to go by
        return True
    is_pty = os.major(ours.st_rdev) in PTY_MAJORS
    return opened.st_rdev == ours.st_rdev and (not is_pty or os.path.samestat(opened, ours))


def _holder(process: Path, files: Mapping[str, Path]) -> Holder:
    arguments = _text(process / "cmdline").replace("\0", " ").strip()
    command = arguments or _text(process / "comm") or "?"
    shown = "".join(letter if letter.isprintable() else "?" for letter in command)
    return Holder(int(process.name), shown[:_COMMAND_LENGTH], bool(files.keys() & _PTY_MASTERS))


def _open_files(process: Path) -> Iterator[tuple[str, Path]]:
    """Yield what a process has open, each with its descriptor in /proc."""
    with contextlib.suppress(OSError):  # the process is not ours to look at, or gone by now
        for descriptor in os.listdir(process / "fd"):
            with contextlib.suppress(OSError):  # closed by now
                path = process / "fd" / descriptor
                yield os.readlink(path), path


def _resolved(path: Path) -> Path:
    return Path(device_of(str(path)))


def _number(file: Path, base: int = 10) -> int | None:
    try:
        return int(_text(file), base)
    except ValueError:
        return None


def _text(file: Path) -> str:
    try:
        return file.read_text("utf-8", "replace").strip()
    except OSError:
        return ""
