"""A real `tactomo daemon` of several skins, each on a pseudo-terminal of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from daemon_process import DaemonProcess
from pty_skin import Playing, PtySkin, Volts, still
from tactomo_client import request
from tactomo_models import load_description
from waiting import PATIENCE_S, wait_until


class Robot:
    """Skins that rest, and the command that serves them."""

    def __init__(self, folder: Path, rest: Volts, names: Sequence[str], **config: Any) -> None:
        description = load_description("paper_square")
        self.skins = {name: PtySkin(folder / f"lines-{name}", description, 1) for name in names}
        self.playing: dict[str, Playing] = {}
        for name in names:
            self.play(name, still(rest), 20.0)
        self.stream = {name: f"ipc://{folder}/{name}.stream" for name in names}
        self.process = DaemonProcess(
            folder,
            [],
            ready=False,
            skins={
                name: {"ports": skin.paths, "stream": self.stream[name]}
                for name, skin in self.skins.items()
            },
            **config,
        )

    def play(self, name: str, volts: Iterator[Volts], rate_hz: float) -> None:
        """Have a skin say scans from now on."""
        self.playing[name] = Playing(self.skins[name], volts, rate_hz)

    def stop_and_count(self, name: str) -> int:
        """Have a skin say nothing more, and return how many scans its daemon has received."""
        self.playing[name].stop()
        received = [-2, -1]

        def is_at_rest(status: dict[str, Any]) -> bool:
            received.append(status["scan_tally"]["received"])
            return len(set(received[-3:])) == 1 and not status["scan_tally"]["waiting"]

        self.wait(name, is_at_rest)
        return received[-1]

    def wait_ready(self) -> None:
        wait_until(lambda: self.process.told("all_ready"), "all skins")

    def ready(self, name: str) -> list[dict[str, Any]]:
        """What the daemon of a skin said each time that it was ready."""
        return [event for event in self.process.told("ready") if event.get("sensor") == name]

    def status(self, name: str) -> dict[str, Any]:
        """The status of a skin, from its own control socket."""
        return request("status", self.ready(name)[-1]["control"], PATIENCE_S)

    def wait(self, name: str, condition: Callable[[dict[str, Any]], Any]) -> None:
        """Wait for a status of a skin."""
        wait_until(lambda: condition(self.status(name)), f"a status of {name}", step_s=0.2)

    def close(self) -> None:
        self.process.kill()
        for playing in self.playing.values():
            playing.stop()
        for skin in self.skins.values():
            skin.close()
