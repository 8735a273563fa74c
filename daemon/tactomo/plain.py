"""Text for a terminal and a log: that of others made harmless, and counts in words."""

from __future__ import annotations

import re
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
