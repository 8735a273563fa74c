"""Lines for journald, without what makes logs: commands that fail at once need no more.

journald takes a line's priority from `<N>` in front of it (sd-daemon(3)), so that
`journalctl -p err` shows what is wrong.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Final

PRIORITIES: Final[Mapping[str, int]] = {
    "critical": 2,
    "error": 3,
    "warning": 4,
    "info": 6,
    "debug": 7,
}
"""Syslog's numbers."""


def is_journal() -> bool:
    """Whether standard error goes to journald: systemd names the device and inode of its pipe."""
    try:
        status = os.fstat(2)
    except OSError:
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def with_priority(text: str, level: str) -> str:
    """Return text with journald's mark of this level in front of each line."""
    mark = f"<{PRIORITIES[level]}>"
    return "\n".join(mark + line for line in text.splitlines())
