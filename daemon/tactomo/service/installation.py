"""Installing a skin's service: which files go where, and which commands make them count.

A plan is made first and carried out afterwards, so that `--dry-run` shows exactly what would be
done. Carrying it out twice changes nothing the second time. Files that come with a distribution's
package are left to it; then only the skin's own are written.

Everything may be put below another root than ``/``, to prepare the image of a robot's disk: then
nothing is started.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from tactomo_client import DEFAULT_CONTROL, DEFAULT_STREAM

from tactomo.acquisition.adapters import Adapter, look_alikes
from tactomo.endpoint import next_address
from tactomo.errors import ServiceError, os_errors_as

Effect = Literal["write", "replace", "remove", "keep", "unchanged"]

UNITS: Final = Path("etc/systemd/system")
RULES: Final = Path("etc/udev/rules.d")
CONFIGURATIONS: Final = Path("etc/tactomo")
PACKAGED: Final = (Path("usr/lib/systemd/system"), Path("lib/systemd/system"))
TEMPLATE: Final = "tactomo@.service"
SHARED: Final = {
    f"systemd/{TEMPLATE}": UNITS / TEMPLATE,
    "systemd/tactomo-zenoh.service": UNITS / "tactomo-zenoh.service",
    "udev/71-tactomo.rules": RULES / "71-tactomo.rules",
    "sysusers.conf": Path("etc/sysusers.d/tactomo.conf"),
    "tmpfiles.conf": Path("etc/tmpfiles.d/tactomo.conf"),
}
"""Where each file of `deploy/` goes."""
PROGRAM: Final = "/usr/bin/tactomo"  # as the units call it; another one is put in its place
HIDDEN: Final = ("/home/", "/root/", "/tmp/", "/var/tmp/", "/run/user/")
"""What the service's sandbox does not see."""
UDEV_RUNS: Final = Path("/run/udev/control")


@dataclass(frozen=True, slots=True)
class File:
    """A file to be there; without a text, not to be there."""

    path: Path  # below the root
    text: str | None  # what is to stand in it; None removes it
    is_owners: bool = False  # whether what stands there already is left as it is

    def effect(self, root: Path) -> Effect:
        """Return what carrying it out would do."""
        before = _read(root / self.path)
        if before == self.text:
            return "unchanged"
        if self.text is None:
            return "remove"
        if before is None:
            return "write"
        return "keep" if self.is_owners else "replace"

    def is_to_do(self, root: Path) -> bool:
        """Whether carrying it out would change anything."""
        return self.effect(root) in ("write", "replace", "remove")

    def carry_out(self, root: Path) -> None:
        """Write or remove it, if that is to be done."""
        effect, path = self.effect(root), root / self.path
        if effect == "remove":
            path.unlink()
        elif effect in ("write", "replace"):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(self.text or "", "utf-8")


@dataclass(frozen=True, slots=True)
class Plan:
    """Files first, then commands, each a program and its arguments."""

    root: Path
    files: tuple[File, ...]
    commands: tuple[tuple[str, ...], ...]

    def carry_out(self) -> None:
        """Do it; raise ServiceError where a file cannot be written, or a command fails."""
        try:
            for file in self.files:
                file.carry_out(self.root)
        except OSError as error:
            raise ServiceError(
                f"cannot write {error.filename}: {error.strerror}", "run it as root (sudo)"
            ) from error
        for command in self.commands:
            run(command)


def plan_install(
    name: str,  # of the skin, and of the service's instance
    ports: Sequence[str],  # as the daemon is to open them
    rules: str,  # for udev, see `udev_rules`; may be empty
    root: Path,  # ``/``, or where an image's disk is mounted
    program: str,  # `tactomo` as the service is to call it
) -> Plan:
    """Return what installs the service of one skin."""
    files = [File(path, text) for path, text in _shared(root, program)]
    if rules:
        files.append(File(_rules_file(name), rules))
    files.append(File(_configuration(name), _config(name, ports, root), is_owners=True))
    return Plan(root, tuple(files), tuple(_commands(root, files, name)))


def plan_uninstall(
    name: str | None,  # of the skin; None for all of them and what they share
    root: Path,  # as in `plan_install`
) -> Plan:
    """Return what removes the service of a skin, or of all; configurations and recordings stay."""
    names = installed(root) if name is None else [name]
    paths = [_rules_file(each) for each in names]
    if name is None:
        paths += SHARED.values()
    files = [File(path, None) for path in paths if (root / path).exists()]
    units = [_unit(each) for each in names]
    if root != Path("/"):
        disable = [("systemctl", f"--root={root}", "disable", unit) for unit in units]
        return Plan(root, tuple(files), tuple(disable))
    disable = [("systemctl", "disable", "--now", unit) for unit in units]
    reload = [("systemctl", "daemon-reload"), *_udev_commands(root, files)]
    return Plan(root, tuple(files), (*disable, *reload))


def installed(root: Path) -> list[str]:
    """Return the names of the skins whose service starts at boot."""
    links = (root / UNITS).glob("*.wants/tactomo@*.service")
    return sorted({link.stem.partition("@")[2] for link in links})


def this_program() -> str:
    """Return the path of the `tactomo` that runs, as a service may call it.

    Raises ServiceError where it lies where a service cannot see it.
    """
    program = Path(sys.executable).with_name("tactomo")
    interpreter = os.path.realpath(sys.executable)
    for path in (str(program), interpreter):
        if path.startswith(HIDDEN):
            raise ServiceError(
                f"{path} is in a folder that the service does not see",
                "install tactomo where it does: `python3 -m venv /opt/tactomo` with the system's "
                "Python, then `/opt/tactomo/bin/pip install ./clients/python .` in a checkout; "
                "or install the Debian package",
            )
    return str(program)


def shipped(file: str) -> str:
    """Return the text of a file of `deploy/`: from the installed package, or from a checkout."""
    package = Path(__file__).parents[1]
    folder = package / "deploy"
    if not folder.is_dir():
        folder = package.parents[1] / "deploy"
    return (folder / file).read_text("utf-8")


def check_running_systemd() -> None:
    """Raise ServiceError where this computer does not run systemd."""
    if not Path("/run/systemd/system").is_dir():
        raise ServiceError(
            "this computer does not run systemd",
            "let your own supervisor run `tactomo daemon CONFIGURATION`, or prepare another disk "
            "with --root FOLDER",
            "no_systemd",
        )


def run(command: Sequence[str]) -> str:
    """Run a program of the system and return what it says; raise ServiceError if it fails."""
    with os_errors_as(ServiceError, f"cannot run {command[0]}", "is it installed?"):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ServiceError(
            f"`{' '.join(command)}` failed: {(done.stderr or done.stdout).strip()}",
            "correct this and run the command again; finished steps stay",
        )
    return done.stdout


def _shared(root: Path, program: str) -> Iterator[tuple[Path, str]]:
    """Yield what all skins share, unless a package of the distribution brought it."""
    if any((root / folder / TEMPLATE).exists() for folder in PACKAGED):
        return
    for file, path in SHARED.items():
        yield path, shipped(file).replace(f"ExecStart={PROGRAM} ", f"ExecStart={program} ")


def _commands(root: Path, files: Sequence[File], name: str) -> Iterator[tuple[str, ...]]:
    unit = _unit(name)
    if root != Path("/"):
        yield ("systemd-sysusers", f"--root={root}", "tactomo.conf")
        yield ("systemctl", f"--root={root}", "enable", unit)
        return
    if any(file.is_to_do(root) for file in files):
        yield ("systemd-sysusers", "tactomo.conf")
        yield ("systemd-tmpfiles", "--create", "tactomo.conf")
        yield ("systemctl", "daemon-reload")
        yield from _udev_commands(root, files)
        yield ("systemctl", "try-restart", unit)
    yield ("systemctl", "enable", "--now", unit)


def _udev_commands(root: Path, files: Sequence[File]) -> Iterator[tuple[str, ...]]:
    """Yield what makes changed rules count, where udev runs: in a container it does not."""
    is_changed = any(RULES in file.path.parents and file.is_to_do(root) for file in files)
    if is_changed and UDEV_RUNS.exists():
        yield ("udevadm", "control", "--reload")
        yield ("udevadm", "trigger", "--subsystem-match=tty", "--subsystem-match=usb")
        yield ("udevadm", "settle", "--timeout=10")


def _config(name: str, ports: Sequence[str], root: Path) -> str:
    stream, control = _free_addresses(root, name)
    return (
        f"# The skin {name}, served by {_unit(name)}. Every key and its meaning:\n"
        "# `tactomo service example`. After a change: "
        f"systemctl restart {_unit(name)}\n"
        f"name = {json.dumps(name)}\n"
        f"ports = {json.dumps(list(ports))}\n"
        "wait_for_ports = true\n"
        f"stream = {json.dumps(stream)}\n"
        f"control = {json.dumps(control)}\n"
    )


def _free_addresses(root: Path, name: str) -> tuple[str, str]:
    """Return the default addresses, or the next ones that no other skin's configuration has."""
    taken = set()
    for path in (root / CONFIGURATIONS).glob("*.toml"):
        if path.stem != name:
            taken |= _addresses(path)
    pair = (DEFAULT_STREAM, DEFAULT_CONTROL)
    while taken & set(pair):
        stream, control = (next_address(address) for address in pair)
        pair = (stream, control)
    return pair


def _addresses(path: Path) -> set[str]:
    """Return those of a configuration; the default ones where it cannot be understood."""
    values: dict[str, str] = {}
    with contextlib.suppress(tomllib.TOMLDecodeError):
        values = tomllib.loads(_read(path) or "")
    return {values.get("stream", DEFAULT_STREAM), values.get("control", DEFAULT_CONTROL)}


def _unit(name: str) -> str:
    return f"tactomo@{name}.service"


def _rules_file(name: str) -> Path:
    return RULES / f"70-tactomo-{name}.rules"


def _configuration(name: str) -> Path:
    return CONFIGURATIONS / f"{name}.toml"


def _read(path: Path) -> str | None:
    try:
        return path.read_text("utf-8")
    except FileNotFoundError:
        return None


BY_PATH: Final = "/dev/serial/by-path/"
RULES_HEADER: Final = (
    "# Serial ports of the skin {name}. What is done with them: 71-tactomo.rules.\n"
)
# Others could mean something in a rule: quotes, wildcards, substitutions.
_PLAIN: Final = re.compile(r"[\w.:+-]+")


def udev_rules(
    name: str, ports: Sequence[str], adapters: list[Adapter]
) -> tuple[str, tuple[str, ...]]:
    """Return udev's rules of a skin, and the names under which its ports are to be opened.

    An adapter is known by its maker, product and serial number. Cheap ones have no serial number,
    or all the same; those are known by the USB socket that they are plugged into, as udev's names
    by path are. What happens to a port so marked stands in ``deploy/udev/71-tactomo.rules``.

    A port that has a lasting name already, or none to be known by, keeps the name that it has.
    """
    lines, names = [], []
    for index, port in enumerate(ports):
        adapter = _adapter_at(port, adapters)
        if adapter is None or not adapter.is_usb or port.startswith("/dev/serial/"):
            names.append(port)
            continue
        mark = name if len(ports) == 1 else f"{name}-{index}"
        lines += _rule(mark, adapter, adapters)
        names.append(f"/dev/tactomo/{mark}")
    text = RULES_HEADER.format(name=name) + "".join(f"{line}\n" for line in lines) if lines else ""
    return text, tuple(names)


def _adapter_at(port: str, adapters: list[Adapter]) -> Adapter | None:
    """Return the adapter that is behind a path; None if none of them is."""
    path = os.path.realpath(port)
    return next((adapter for adapter in adapters if adapter.path in (port, path)), None)


def _rule(mark: str, adapter: Adapter, adapters: list[Adapter]) -> list[str]:
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
