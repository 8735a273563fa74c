"""Print those entries of requirements.lock, hashes included, that a robot needs.

The lock has the developers' tools, too. What is needed is what `tactomo` requires with a robot's
extras, and what that requires in turn, as installed in the environment that runs this.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from importlib.metadata import requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
EXTRAS = ("foxglove", "metrics", "zenoh")


def wanted() -> list[str]:
    """Return what a robot's tactomo requires."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = [line for name in EXTRAS for line in project["optional-dependencies"][name]]
    return [*project["dependencies"], *extras]


def needed(lines: list[str], found: set[str]) -> set[str]:
    """Return `found`, which is added to, with all that these requirements bring."""
    for line in lines:
        requirement = Requirement(line)
        name = canonicalize_name(requirement.name)
        is_wanted = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if is_wanted and name not in found:
            found.add(name)
            needed(requires(name) or [], found)
    return found


def entries(lock: str) -> Iterator[tuple[str, str]]:
    """Yield name and text of each entry."""
    for entry in re.split(r"^(?=\w)", lock, flags=re.MULTILINE)[1:]:
        yield canonicalize_name(entry.partition("==")[0].strip()), entry


names = needed(wanted(), set())
lock = (ROOT / "requirements.lock").read_text("utf-8")
print("".join(entry for name, entry in entries(lock) if name in names))
