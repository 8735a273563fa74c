"""`tactomo ports`: the serial adapters of this computer, and what may keep them from being used."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactomo.acquisition.adapters import (
    LOW_LATENCY_MS,
    Adapter,
    Holder,
    lasting_name,
    list_adapters,
    look_alikes,
    modem_manager_runs,
)
from tactomo.acquisition.open_serial import how_to_grant, other_holders
from tactomo.cli.options import JsonOutput, examples, typer_app
from tactomo.cli.output import print_json, say

if TYPE_CHECKING:
    from tactomo_protocol import Hello


NONE_THERE = """no USB adapter is there
  Plug the skin in and repeat. If it is still missing, try another cable (some only charge),
  another socket, and `sudo dmesg | tail`, which shows what the computer detected.
  No skin at hand? `tactomo twin --link /tmp/skin` simulates one."""

app = typer_app()


@app.command(
    epilog=examples(
        "tactomo ports",
        "tactomo ports --ask",
        "tactomo ports /dev/ttyACM0 --ask --json | jq .ports[0].device.device_id",
    )
)
def ports(
    paths: Annotated[
        list[str] | None, typer.Argument(metavar="[PORT]...", help="Ports to list. [all adapters]")
    ] = None,
    ask: Annotated[
        bool,
        typer.Option(
            "--ask",
            help="Open each port and ask for the device; built-in ports only if given. Sends a "
            "few bytes, and resets some boards.",
        ),
    ] = False,
    protocol: Annotated[
        str | None,
        typer.Option(metavar="my_module:MyProtocol", help="A protocol of your own to recognise."),
    ] = None,
    baud: Annotated[
        int | None,
        typer.Option(
            min=1200, max=12_000_000, help="Baud rate; USB takes any. [the protocol's usual]"
        ),
    ] = None,
    as_json: JsonOutput = False,
) -> None:
    """List serial adapters with their permanent names, the processes that use them, and problems.

    Give the daemon the permanent name: /dev/ttyACM0 may be another device after the next start. A
    name *by-id* belongs to the device, in any socket; a name *by-path* belongs to the socket.
    """
    found = survey(paths or [])
    asked = [row.path for row in found if paths or (row.adapter and row.adapter.is_usb)]
    answers = question(asked, baud, protocol) if ask else {}
    if as_json:
        print_json({"ports": [as_fields(row, answers) for row in found]})
        return
    for line in lines(found, answers):
        say(line)
    if not paths and not any(row.adapter and row.adapter.is_usb for row in found):
        say(NONE_THERE)


@dataclass(frozen=True)
class Row:
    """One port as it is listed."""

    path: str
    adapter: Adapter | None  # None for a port that is no adapter, such as a pseudo-terminal
    use: str  # the name to configure; empty where none lasts
    held_by: list[Holder]
    remarks: list[str]


def survey(paths: Sequence[str], root: Path = Path("/")) -> list[Row]:
    """Look at the given ports, or at all adapters; `root` has /sys, /dev, /proc and /run."""
    adapters = list_adapters(root)
    by_path = {adapter.path: adapter for adapter in adapters}
    has_modem_manager = modem_manager_runs(root)
    return [
        _row(path, by_path.get(os.path.realpath(path)), adapters, has_modem_manager, root)
        for path in paths or by_path
    ]


def question(
    paths: Sequence[str], baud: int | None, protocol: str | None = None
) -> dict[str, Hello | str]:
    """Ask all ports at the same time who is there; in words why there is no hello."""
    from concurrent.futures import ThreadPoolExecutor

    from tactomo.acquisition.connection import identify
    from tactomo.protocols import NATIVE, find_protocol

    usual = find_protocol(protocol or NATIVE).baud
    with ThreadPoolExecutor(max_workers=max(1, len(paths))) as pool:
        return dict(
            zip(paths, pool.map(lambda path: identify(path, baud or usual), paths), strict=True)
        )


def as_fields(row: Row, answers: dict[str, Hello | str]) -> dict[str, Any]:
    """Return a row for programs."""
    answer = answers.get(row.path) or None
    device = None
    if answer is not None and not isinstance(answer, str):
        from tactomo.imaging.frames import device_fields

        device, answer = device_fields(answer), None
    return {
        "path": row.path,
        "use": row.use or None,
        "adapter": row.adapter and asdict(row.adapter),
        "held_by": [{"pid": holder.pid, "command": holder.command} for holder in row.held_by],
        "remarks": row.remarks,
        "device": device,
        "no_device_because": answer,
    }


def lines(rows: Sequence[Row], answers: dict[str, Hello | str]) -> list[str]:
    """Return the rows as lines for people; what is in one can be copied whole."""
    told = []
    for row in rows:
        told.append(f"{row.path}  {_describe(row.adapter)}")
        facts = [("use", row.use), *(("held by", str(holder)) for holder in row.held_by)]
        if row.path in answers:
            facts.append(("device", _describe_device(answers[row.path])))
        facts += [("note", remark) for remark in row.remarks]
        told += [f"  {name:7}  {value}" for name, value in facts if value]
    return told


def _row(
    path: str, adapter: Adapter | None, others: list[Adapter], has_modem_manager: bool, root: Path
) -> Row:
    use = lasting_name(adapter, others) if adapter else ""
    remarks = []
    if os.path.exists(path) and not os.access(path, os.R_OK | os.W_OK):
        remarks.append(f"you may not open it; {how_to_grant(path)}")
    if adapter is not None:
        remarks += _remarks(adapter, others, use, has_modem_manager)
    return Row(path, adapter, use, other_holders(path, root), remarks)


def _remarks(
    adapter: Adapter, others: list[Adapter], use: str, has_modem_manager: bool
) -> list[str]:
    """Return in words what may go wrong with an adapter."""
    remarks = []
    twins = look_alikes(adapter, others)
    if twins:
        number = f"serial number {adapter.serial_number}" if adapter.serial_number else "no number"
        remarks.append(
            f"looks the same as {', '.join(twin.path for twin in twins)} ({number}): a name by id "
            "may mean either, one by path means the socket; `device_ids` tells the skins apart"
        )
    if adapter.is_usb and not use:
        remarks.append("has no permanent name: does udev run, and see this /dev?")
    if has_modem_manager and adapter.is_usb and not adapter.is_kept_from_modem_manager:
        remarks.append(
            "ModemManager runs and may talk to it when it is plugged in: install tactomo's udev "
            "rules, or stop ModemManager"
        )
    if (adapter.latency_timer_ms or 0) > LOW_LATENCY_MS:
        remarks.append(
            f"holds bytes back for up to {adapter.latency_timer_ms} ms; the daemon asks it for 1 ms"
        )
    return remarks


def _describe(adapter: Adapter | None) -> str:
    if adapter is None:
        return "not an adapter"
    if not adapter.is_usb:
        return f"built in ({adapter.driver})"
    number = f"serial number {adapter.serial_number or 'none'}"
    usb = f"{adapter.vendor_id:04x}:{adapter.product_id or 0:04x}, {adapter.driver}, {number}"
    return " ".join(filter(None, (adapter.maker, adapter.product, f"({usb})")))


def _describe_device(hello: Hello | str) -> str:
    if isinstance(hello, str):
        return hello
    channels = ", ".join(channel for channel in hello.channels)
    rate = f"{hello.scan_rate_hz:g} scans/s" if hello.scan_rate_hz else "triggered"
    return f"{hello.device_id}: {channels}; {rate}; firmware {hello.firmware}"
