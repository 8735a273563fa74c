"""Rules that give an adapter a name of its own: ``/dev/tactomo/NAME``, whichever socket it is in.

An adapter is known by its maker, product and serial number. Cheap ones have no serial number, or
all the same; those are known by the USB socket that they are plugged into, as udev's names by path
are. What happens to a port so marked stands in ``deploy/udev/71-tactomo.rules``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from typing import Final

from tactomo.acquisition.adapters import Adapter, look_alikes
from tactomo.errors import ServiceError

BY_PATH: Final = "/dev/serial/by-path/"
HEADER: Final = "# Serial ports of the skin {name}. What is done with them: 71-tactomo.rules.\n"
# Others could mean something in a rule: quotes, wildcards, substitutions.
_PLAIN: Final = re.compile(r"[\w.:+-]+")


def rules(name: str, ports: Sequence[str], adapters: list[Adapter]) -> tuple[str, tuple[str, ...]]:
    """Return a skin's rules, and the names under which its ports are to be opened.

    A port that has a lasting name already, or none to be known by, keeps the name that it has.
    """
    lines, names = [], []
    for index, port in enumerate(ports):
        adapter = find(port, adapters)
        if adapter is None or not adapter.is_usb or port.startswith("/dev/serial/"):
            names.append(port)
            continue
        mark = name if len(ports) == 1 else f"{name}-{index}"
        lines += rule(mark, adapter, adapters)
        names.append(f"/dev/tactomo/{mark}")
    text = HEADER.format(name=name) + "".join(f"{line}\n" for line in lines) if lines else ""
    return text, tuple(names)


def find(port: str, adapters: list[Adapter]) -> Adapter | None:
    """Return the adapter that is behind a path; None if none of them is."""
    path = os.path.realpath(port)
    return next((adapter for adapter in adapters if adapter.path in (port, path)), None)


def rule(mark: str, adapter: Adapter, adapters: list[Adapter]) -> list[str]:
    """Return the lines that mark a USB adapter; raise ServiceError where nothing identifies it."""
    is_told_apart = not look_alikes(adapter, adapters)
    if _PLAIN.fullmatch(adapter.serial_number) and is_told_apart:
        return _by_serial_number(mark, adapter)
    return [_by_socket(mark, adapter)]


def _by_serial_number(mark: str, adapter: Adapter) -> list[str]:
    device = {
        "idVendor": f"{adapter.vendor_id:04x}",
        "idProduct": f"{adapter.product_id:04x}",
        "serial": adapter.serial_number,
    }
    port = "".join(f'ATTRS{{{key}}}=="{value}", ' for key, value in device.items())
    whole = port.replace("ATTRS", "ATTR")
    number = adapter.interface
    only = "" if number is None else f'ENV{{ID_USB_INTERFACE_NUM}}=="{number:02x}", '
    return [
        f'SUBSYSTEM=="tty", {port}{only}ENV{{TACTOMO}}="{mark}"',
        f'SUBSYSTEM=="usb", ENV{{DEVTYPE}}=="usb_device", {whole}ENV{{TACTOMO}}="{mark}"',
    ]


def _by_socket(mark: str, adapter: Adapter) -> str:
    paths = [path for path in adapter.names if path.startswith(BY_PATH)]
    if not paths:
        raise ServiceError(
            f"{adapter.path} has no serial number of its own, and udev gave it no name by path",
            "check that udev runs, or give a path that lasts yourself",
        )
    path, _, port = paths[0].removeprefix(BY_PATH).partition("-port")
    only = f'ENV{{.ID_PORT}}=="{port}", ' if port else ""
    return f'SUBSYSTEM=="tty", ENV{{ID_PATH}}=="{path}", {only}ENV{{TACTOMO}}="{mark}"'
