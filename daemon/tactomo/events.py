"""Events: what happened, told at the same time to the log and to whoever subscribes."""

from __future__ import annotations

import time
from typing import Final, Literal, Protocol

Severity = Literal["info", "warning", "error"]

EVENT_PERIOD_S: Final = 1.0


class OnEvent(Protocol):
    """Called with what happened; never waits and may be called from any thread."""

    def __call__(self, name: str, severity: Severity, detail: str, next_step: str = "") -> None:
        """Tell it: `name` for programs, `detail` and `next_step` for people."""
        ...


class RateLimit:
    """Lets one event of a kind pass per second, or other period; for use by one thread."""

    def __init__(self, period_s: float = EVENT_PERIOD_S) -> None:
        self._period_s = period_s
        self._passed_s = -period_s

    def allows(self) -> bool:
        """Whether an event may be told now; if so, the next one waits."""
        now_s = time.monotonic()
        if now_s - self._passed_s < self._period_s:
            return False
        self._passed_s = now_s
        return True
