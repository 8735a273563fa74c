"""A board that the twin emulates, in this process, and a daemon in a process of its own on it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from daemon_process import ANYWHERE, SENSOR, DaemonProcess
from tactomo.twin import Twin, TwinConfig
from tactomo_client import Frame, subscribe
from tactomo_models import Press, SensorDescription, SkinSimulator, load_description
from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel
from variants import rewritten

COARSE = ("[structure]", "[map]\nnodes_x = 25\nnodes_y = 25\n\n[structure]")


@contextmanager
def emulated(
    folder: Path,
    board: str,  # its description
    protocol: str,
    skin: MeasuredSkin | None = None,  # in place of a simulated one
    daemon: dict[str, Any] | None = None,  # keys of its configuration
    **config: Any,  # of the twin
) -> Iterator[tuple[Twin, DaemonProcess]]:
    # By a link, which goes with the twin: the number of a pty is somebody else's afterwards.
    settings = {"control": ANYWHERE, "link_folder": folder / "links", **config}
    twin = Twin(TwinConfig(load_description(board), protocol=protocol, **settings), skin)
    twin.start()
    try:
        known = {"protocol": protocol, "description": board, **(daemon or {})}
        served = DaemonProcess(folder, twin.ports, **known)
        try:
            yield twin, served
        finally:
            served.kill()
    finally:
        twin.stop()


def changed(folder: Path, name: str, *changes: tuple[str, str]) -> str:
    """A shipped description with a coarse map and other changes, as a user would edit it."""
    return str(rewritten(folder / f"{name}.toml", name, COARSE, *changes))


def frame_where(daemon: DaemonProcess, condition: Callable[[Frame], bool]) -> Frame:
    """The first frame of which something holds, as a controller gets it."""
    with closing(subscribe(SENSOR, address=daemon.stream, timeout_s=60.0)) as frames:
        return next(frame for frame in frames if condition(frame))


class MeasuredSkin(SkinSimulator):
    """Says scans (T, M), volts, one after another, again and again, whatever presses."""

    def __init__(self, description: SensorDescription, scans: FloatArray) -> None:
        self.description = description
        self._scans = scans
        self.said = 0

    def voltages(self, presses: Sequence[Press]) -> dict[Channel, FloatArray]:
        # The first call is the converter's, which asks how large voltages are.
        scan = self._scans[max(self.said - 1, 0) % len(self._scans)]
        self.said += 1
        return {Channel.STRUCTURE: scan}
