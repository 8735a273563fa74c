"""Text for a terminal and a log: that of others made harmless, counts in words, journald's marks.

journald takes a line's priority from `<N>` in front of it (sd-daemon(3)), so that
`journalctl -p err` shows what is wrong.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from typing import Final

# Control characters but tab and line feed, and what turns the direction of writing.
_OBEYED: Final = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]"
)


def plain(text: object) -> str:
    """Return text with nothing in it that a terminal would obey: each such character is a �."""
    return _OBEYED.sub("\N{REPLACEMENT CHARACTER}", str(text))


def counted(count: int, noun: str) -> str:
    """Return "1 contact", "2 contacts" and so on."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


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
