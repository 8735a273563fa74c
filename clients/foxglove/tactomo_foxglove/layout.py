"""The layout that shows a sensor: 3D, Plot and Log panels."""

from __future__ import annotations

import json
import re
from importlib import resources
from typing import Any, Final

SHIPPED_FOR: Final = "skin"
_PLAIN: Final = re.compile(r"\w+")


def shipped_layout() -> str:
    """Return the shipped layout, of a sensor named `skin`."""
    return (resources.files("tactomo_foxglove") / "tactomo_layout.json").read_text("utf-8")


def layout_for(sensor: str) -> str:
    """Return the layout for a sensor of this name, to be imported in Foxglove."""
    return json.dumps(_renamed(json.loads(shipped_layout()), sensor), indent=2) + "\n"


def _renamed(value: Any, sensor: str) -> Any:
    """Return the layout with every topic, message path and frame named after this sensor."""
    if isinstance(value, dict):
        return {_name(key, sensor): _renamed(each, sensor) for key, each in value.items()}
    if isinstance(value, list):
        return [_renamed(each, sensor) for each in value]
    return _name(value, sensor) if isinstance(value, str) else value


def _name(text: str, sensor: str) -> str:
    if text == SHIPPED_FOR:
        return sensor
    if not text.startswith(f"/{SHIPPED_FOR}/"):
        return text
    topic, dot, path = text.removeprefix(f"/{SHIPPED_FOR}/").partition(".")
    renamed = f"/{sensor}/{topic}"
    # A message path, which has a dot, quotes a topic of other characters; a bare topic is as it is.
    return renamed + dot + path if _PLAIN.fullmatch(sensor) or not dot else f'"{renamed}".{path}'
