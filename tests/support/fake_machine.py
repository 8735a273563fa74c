"""A folder laid out as Linux lays out /sys, /dev, /proc and /run for serial adapters.

The paths, links and files are those of a real machine with these adapters on one USB hub.
"""

from __future__ import annotations

import os
from pathlib import Path

USB = "sys/devices/pci0000:00/0000:00:14.0/usb1"


class FakeMachine:
    """Plug adapters `into` a folder, and look at it with that folder as the root."""

    def __init__(self, root: Path) -> None:
        self.root = root
        for folder in ("dev/pts", "proc", "run/udev/data", "sys/class/tty"):
            (root / folder).mkdir(parents=True)

    def write(self, path: str, text: str = "") -> Path:
        """Write one file of one line, as the kernel does."""
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text + "\n")
        return file

    def link(self, path: str, target: str) -> None:
        """Make a relative link, as the kernel and udev do."""
        source = self.root / path
        source.parent.mkdir(parents=True, exist_ok=True)
        source.symlink_to(os.path.relpath(self.root / target, source.parent))

    def _usb(self, socket: str, vendor_id: str, product_id: str, **texts: str) -> str:
        device = f"{USB}/{socket}"
        for name, text in {"idVendor": vendor_id, "idProduct": product_id, **texts}.items():
            self.write(f"{device}/{name}", text)
        self.write(f"{device}/dev", f"189:{socket.replace('-', '')}")
        self.write(f"{device}/{socket}:1.0/bInterfaceNumber", "00")
        return f"{device}/{socket}:1.0"

    def _tty(self, name: str, device: str, number: str, socket: str, by_id: str) -> None:
        folder = f"{device}/tty/{name}"
        self.write(f"{folder}/dev", number)
        self.link(f"{folder}/device", device)
        self.link(f"sys/class/tty/{name}", folder)
        self.write(f"dev/{name}")
        self.link(f"dev/serial/by-path/pci-0000:00:14.0-usb-0:{socket[2:]}:1.0", f"dev/{name}")
        link = self.root / "dev/serial/by-id" / by_id
        link.unlink(missing_ok=True)  # of two that are named alike, the last one wins
        self.link(f"dev/serial/by-id/{by_id}", f"dev/{name}")

    def _drive(self, device: str, driver: str) -> None:
        """Have a driver of the kernel's serve a device."""
        (self.root / driver).mkdir(parents=True, exist_ok=True)
        self.link(f"{device}/driver", driver)

    def plug_ftdi(self, name: str, socket: str, serial: str, latency_ms: int = 16) -> None:
        """An FT232R: usb-serial, with a latency timer."""
        texts = {"manufacturer": "FTDI", "product": "FT232R USB UART", "serial": serial}
        interface = self._usb(socket, "0403", "6001", **texts)
        port = f"{interface}/{name}"
        self.write(f"{port}/latency_timer", str(latency_ms))
        self._drive(port, "sys/bus/usb-serial/drivers/ftdi_sio")
        by_id = f"usb-FTDI_FT232R_USB_UART_{serial}-if00-port0"
        self._tty(name, port, f"188:{name[-1]}", socket, by_id)

    def plug_ch340(self, name: str, socket: str) -> None:
        """A CH340: usb-serial, without a serial number."""
        interface = self._usb(socket, "1a86", "7523", product="USB Serial")
        port = f"{interface}/{name}"
        self._drive(port, "sys/bus/usb-serial/drivers/ch341-uart")
        self._tty(name, port, f"188:{name[-1]}", socket, "usb-1a86_USB_Serial-if00-port0")

    def plug_acm(self, name: str, socket: str, serial: str) -> None:
        """A microcontroller's own USB: cdc_acm, no port device between interface and tty."""
        texts = {"manufacturer": "Tactomo", "product": "Skin", "serial": serial}
        interface = self._usb(socket, "2e8a", "000a", **texts)
        self._drive(interface, "sys/bus/usb/drivers/cdc_acm")
        by_id = f"usb-Tactomo_Skin_{serial}-if00"
        self._tty(name, interface, f"166:{name[-1]}", socket, by_id)

    def build_in(self, name: str, kind: int) -> None:
        """A UART on the board; of kind 0 where there is none behind the name."""
        device = "sys/devices/pnp0/00:00/00:00:0/00:00:0.0"
        if not (self.root / device / "driver").exists():
            self._drive(device, "sys/bus/serial-base/drivers/port")
        self.write(f"{device}/tty/{name}/type", str(kind))
        self.link(f"{device}/tty/{name}/device", device)
        self.link(f"sys/class/tty/{name}", f"{device}/tty/{name}")
        self.write(f"dev/{name}")

    def run(self, pid: int, command: str, *opened: str) -> None:
        """A process that has devices open, told apart by their whole path."""
        self.write(f"proc/{pid}/comm", command.split()[0])
        (self.root / f"proc/{pid}/cmdline").write_bytes(command.replace(" ", "\0").encode() + b"\0")
        for number, path in enumerate(opened, 3):
            folder = self.root / f"proc/{pid}/fd"
            folder.mkdir(exist_ok=True)
            (folder / str(number)).symlink_to(path)

    def udev_property(self, number: str, line: str) -> None:
        """A property that a udev rule gave to the character device of this number."""
        self.write(f"run/udev/data/c{number}", f"I:123\nE:ID_BUS=usb\n{line}\nG:systemd")
