"""What the laboratory adds where it is installed, and how to get it where it is not."""

from __future__ import annotations

from typing import Any, Final

from tactomo.errors import TactomoError

BENCH: Final = "tactomo.bench"  # entry points: functions that measure for `tactomo bench`


def not_installed(what: str) -> TactomoError:
    """Return the error that says where to get what only the laboratory has."""
    return TactomoError(
        f"{what} is part of the laboratory, which is not installed",
        "pip install tactomo-lab, or `make setup` in a checkout",
    )


def measurement(name: str) -> Any:
    """Return the laboratory's function of this name for `tactomo bench`, or raise TactomoError."""
    from importlib.metadata import entry_points

    for entry in entry_points(group=BENCH, name=name):
        return entry.load()
    raise not_installed(f"bench --{name}")
