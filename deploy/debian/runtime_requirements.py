"""Print those entries of requirements.lock, hashes included, that a robot needs.

The lock has the developers' tools, too. What is needed is what `tactomo` requires with a robot's
extras, and what that requires in turn, as installed in the environment that runs this.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.metadata import requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

EXTRAS = ("", "metrics")
LOCK = Path(__file__).parents[2] / "requirements.lock"


def needed(name: str, found: set[str]) -> set[str]:
    """Return `found`, which is added to, with all that a distribution requires."""
    for line in requires(name) or ():
        requirement = Requirement(line)
        other = canonicalize_name(requirement.name)
        marker = requirement.marker
        is_wanted = marker is None or any(marker.evaluate({"extra": extra}) for extra in EXTRAS)
        if is_wanted and other not in found:
            found.add(other)
            needed(other, found)
    return found


def entries(lock: str) -> Iterator[tuple[str, str]]:
    """Yield name and text of each entry."""
    for entry in re.split(r"^(?=\w)", lock, flags=re.MULTILINE)[1:]:
        yield canonicalize_name(entry.partition("==")[0].strip()), entry


names = needed("tactomo", set())
print("".join(entry for name, entry in entries(LOCK.read_text("utf-8")) if name in names))
