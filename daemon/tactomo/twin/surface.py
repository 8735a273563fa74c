"""What presses the skin at an instant: a scripted scene, live presses, or both."""

from __future__ import annotations

from tactomo.twin.scene import Indenter, Scene


class Surface:
    """The pressed side of the skin. For use by one thread.

    The script's clock starts with `play`, not with power-up: a daemon that attaches later takes
    its reference from an unloaded skin and then sees the scene from its beginning.
    """

    def __init__(self, script: Scene | None = None) -> None:
        self.script = script
        self._started_s: float | None = None
        self._live: dict[str, Indenter] = {}

    @property
    def is_playing(self) -> bool:
        """Whether the script's clock runs."""
        return self._started_s is not None

    def play(self, time_s: float) -> None:
        """Start the script, or start it over, at device time `time_s`."""
        self._started_s = time_s

    def press(self, press_id: str, indenter: Indenter) -> None:
        """Press, or move the press that already has this id."""
        self._live[press_id] = indenter

    def release(self, press_id: str) -> bool:
        """Lift one live press; tell whether there was one of this id."""
        return self._live.pop(press_id, None) is not None

    def clear(self) -> None:
        """Lift all live presses."""
        self._live.clear()

    def presses_at(self, time_s: float) -> dict[str, Indenter]:
        """Return what presses the skin at device time `time_s`, by id; live presses go first."""
        scripted: dict[str, Indenter] = {}
        if self.script is not None and self._started_s is not None:
            scripted = self.script.presses_at(max(0.0, time_s - self._started_s))
        return scripted | self._live
