"""Sensors that differ from another in a few keys."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tactomo_models import SensorDescription
from tactomo_models.sensor.description_file import shipped_text


def variant(description: SensorDescription, **sections: dict[str, Any] | None) -> SensorDescription:
    """Copy a description with keys of its sections changed; None leaves a key or section out."""
    raw = description.model_dump(by_alias=True, exclude_none=True)
    for name, changes in sections.items():
        section = {} if changes is None else {**raw.get(name, {}), **changes}
        raw[name] = {key: value for key, value in section.items() if value is not None}
        if changes is None:
            del raw[name]
    return SensorDescription.model_validate(raw)


def rewritten(path: Path, name: str, *changes: tuple[str, str]) -> Path:
    """Write a shipped description with parts in other words, as a user would edit it."""
    text = shipped_text(name)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path
