"""`tactomo watch`: the skin in a terminal, over ssh if need be."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.color import Color
from rich.console import Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.style import Style
from rich.table import Table
from rich.text import Text
from tactomo_client import Event, Frame, Status, subscribe
from tactomo_client.appearance import companion_words, force_words, map_pixels, pressure_words
from tactomo_client.schema import TOUCHES_SEEN

from tactomo.cli import options
from tactomo.cli.console import Console
from tactomo.cli.sensors import find_sensor
from tactomo.plain import plain

REFRESH_HZ = 12.0

app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo watch", "tactomo watch -s left_forearm", "tactomo watch | tee log"
    )
)
def watch(
    sensor: options.Sensor = None,
    address: options.Address = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.0, max=3.2e7, help="Stop after this time. [Ctrl-C]")
    ] = None,
    keys: options.KeysFolder = None,
) -> None:
    """Show the pressure map, the contacts and the daemon's health live in the terminal.

    In a pipe, the command prints one line per frame instead. Ctrl-C ends the command. If no such
    sensor runs at the start, the exit status is 1.
    """
    found = find_sensor(sensor, address, keys)
    view = View(found.sensor, found.stream, keys)
    console = Console()
    end_s = float("inf") if seconds is None else time.monotonic() + seconds
    try:
        if console.is_terminal:
            _show_live(view, console, end_s)
        else:
            _print_lines(view, end_s)
    except KeyboardInterrupt:
        pass
    finally:
        view.close()


class View:
    """The newest frame, status and event of one sensor."""

    def __init__(self, sensor: str, stream: str, keys: Path | None = None) -> None:
        self.sensor = sensor
        self.stream = stream
        self.frame: Frame | None = None
        self.status: Status | None = None
        self.event: Event | None = None
        self._news = subscribe(sensor, address=stream, kind=("map", "status", "event"), keys=keys)

    def update(self, wait_s: float) -> bool:
        """Take in what has come, waiting for it at most `wait_s`; return whether a frame came.

        Raises:
            KeysError: the server does not let us in.
        """
        before = self.frame
        while (item := self._news.wait(wait_s)) is not None:
            wait_s = 0.0
            self._take(item)
        return self.frame is not before

    def close(self) -> None:
        """Close the subscription."""
        self._news.close()

    @property
    def is_gone(self) -> bool:
        """Whether no status has come for so long that the daemon cannot be there."""
        return self.status is None or self.status.is_stale

    @property
    def is_stale(self) -> bool:
        """Whether the newest frame is old, and not of a replay that stands still."""
        stands = self.status is not None and self.status.state in ("paused", "ended")
        return self.frame is not None and self.frame.is_stale and not stands

    def _take(self, item: Frame | Status | Event) -> None:
        if isinstance(item, Frame):
            self.frame = item
        elif isinstance(item, Status):
            self.status = item
        else:
            self.event = item


def _show_live(view: View, console: Any, end_s: float) -> None:
    with Live(console=console, screen=True, auto_refresh=False) as live:
        while time.monotonic() < end_s:
            next_s = time.monotonic() + 1.0 / REFRESH_HZ
            while (left_s := next_s - time.monotonic()) > 0:
                view.update(left_s)
            live.update(_screen(view, console.size.width, console.size.height), refresh=True)


def _print_lines(view: View, end_s: float) -> None:
    silent_s = time.monotonic()
    while time.monotonic() < end_s:
        if view.update(min(0.5, max(0.0, end_s - time.monotonic()))):
            silent_s = time.monotonic()
            assert view.frame is not None
            print(plain(frame_line(view.frame)), flush=True)
        elif time.monotonic() - silent_s > 1.0:
            silent_s = time.monotonic()
            print(f"no frame of {view.sensor} at {view.stream}", file=sys.stderr, flush=True)


def frame_line(frame: Frame) -> str:
    """Return one frame as a line of text."""
    pressed = "; ".join(
        f"#{c.id} ({c.x_mm:+.1f}, {c.y_mm:+.1f}) mm {pressure_words(c)}{force_words(c, ', ')}"
        for c in frame.contacts
    )
    flags = f"  [{', '.join(sorted(frame.flags))}]" if frame.flags else ""
    pressed = pressed or _without_contacts(frame)
    return f"{frame.scan_counter:8d}  {frame.tier or '-':<9} {pressed}{flags}"


def _without_contacts(frame: Frame) -> str:
    return "nothing pressed" if frame.flags <= TOUCHES_SEEN else "not known"


def _screen(view: View, columns: int, rows: int) -> RenderableType:
    frame, title = view.frame, Text(f"tactomo watch {view.sensor}")
    if frame is None:
        return Panel(_state_line(view), title=title)
    description = view.status.fields.get("description") or {} if view.status else {}
    image = map_text(frame, description, max(10, min(columns - 44, 2 * (rows - 6))))
    body = Table.grid(padding=(0, 2))
    body.add_row(image, Group(_contact_table(frame, view.is_stale), Text(), _health(view, frame)))
    border = "red" if view.is_gone or view.is_stale else "none"
    panel = Panel(body, title=title, subtitle="Ctrl-C ends", border_style=border)
    return Group(_state_line(view), panel)


def _state_line(view: View) -> Text:
    if view.status is None or view.is_gone:
        return Text(
            f"no daemon answers at {view.stream} for a sensor {view.sensor!r}: is it running?",
            "bold red",
        )
    state = view.status.state
    if view.frame is not None and view.is_stale:
        age = f"STALE: the newest frame is {view.frame.age_s:.1f} s old"
        return Text(f"{age} (the daemon says: {state}) {_event_words(view.event)}", "bold red")
    return Text(f"{state} {_event_words(view.event)}", "green" if state == "running" else "yellow")


def _event_words(event: Event | None) -> str:
    return f"| last event: {event.name} {event.detail}" if event else ""


def map_text(frame: Frame, description: Mapping[str, Any], columns: int) -> Text:
    """Return the map as text of at most `columns` half-block characters in width.

    Each character is two nodes, one above the other. Colour is pressure, or the relative change
    where the sensor has no pressure calibration; pressed outlines without a value are blue-grey.
    """
    pixels = map_pixels(frame, description)
    if pixels is None:
        return Text("no image: " + ", ".join(sorted(frame.flags)))
    step = -(-pixels.shape[1] // columns)
    pixels = pixels[::-step, ::step]  # row 0 of a map is its lowest
    if len(pixels) % 2:
        pixels = np.concatenate([pixels, np.zeros_like(pixels[:1])])
    text = Text()
    for upper, lower in zip(pixels[0::2], pixels[1::2], strict=True):
        for top, bottom in zip(upper.tolist(), lower.tolist(), strict=True):
            style = Style(color=Color.from_rgb(*top), bgcolor=Color.from_rgb(*bottom))
            text.append("▀", style)
        text.append("\n")
    return text


def _contact_table(frame: Frame, is_stale: bool) -> RenderableType:
    if not frame.contacts:
        return Text("not known" if is_stale else _without_contacts(frame), "dim")
    table = Table(box=None, pad_edge=False)
    for name in ("#", "x mm", "y mm", "mm²", "pressure", "force"):
        table.add_column(name, justify="right")
    for c in frame.contacts:
        place = f"{c.x_mm:+.1f}", f"{c.y_mm:+.1f}", f"{c.area_mm2:.0f}"
        table.add_row(str(c.id), *place, pressure_words(c), force_words(c))
    return table


def _health(view: View, frame: Frame) -> RenderableType:
    status = view.status
    latency = status and status.latency_ms
    companions = status.companions if status else {}
    rows = {
        "rate": f"{status.rates.frames_hz:.1f} frames/s" if status else "-",
        "latency": f"{latency.p50:.1f} ms (p99 {latency.p99:.1f})" if latency else "-",
        "age": f"{frame.age_s * 1e3:.0f} ms",
        "method": frame.tier or "-",
        "because": frame.tier_reason or "-",
        "misfit": "-" if frame.misfit is None else f"{frame.misfit:.2f}",
        "flags": ", ".join(sorted(frame.flags)) or "none",
        "source": status.source.kind if status else "-",
        **{name: companion_words(each) for name, each in companions.items()},
    }
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, value in rows.items():
        table.add_row(Text(name, "dim"), value)
    for issue in status.issues if status else ():
        colour = "red" if issue.severity == "error" else "yellow"
        table.add_row(Text(issue.severity, colour), Text(f"{issue.what}: {issue.next_step}"))
    return table
