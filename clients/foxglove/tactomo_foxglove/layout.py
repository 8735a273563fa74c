"""The layout that shows a sensor: 3D, Plot and Log panels."""

from __future__ import annotations

import re
from importlib import resources


def shipped_layout() -> str:
    """Return the shipped layout, of a sensor named `skin`."""
    return (resources.files("tactomo_foxglove") / "tactomo_layout.json").read_text("utf-8")


def layout_for(sensor: str) -> str:
    """Return the layout for a sensor of this name, to be imported in Foxglove."""
    text = shipped_layout()
    if not re.fullmatch(r"\w+", sensor):  # a message path quotes a topic of other characters
        text = text.replace('"/skin/frame.', '"\\"/skin/frame\\".')
    return text.replace("/skin/", f"/{sensor}/").replace('"skin"', f'"{sensor}"')
