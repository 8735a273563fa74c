"""Sensors that differ from another in a few keys."""

from __future__ import annotations

from typing import Any

from tactomo_models import SensorDescription


def variant(description: SensorDescription, **sections: dict[str, Any] | None) -> SensorDescription:
    """Copy a description with keys of its sections changed; None leaves a key or section out."""
    raw = description.model_dump(by_alias=True, exclude_none=True)
    for name, changes in sections.items():
        section = {} if changes is None else {**raw.get(name, {}), **changes}
        raw[name] = {key: value for key, value in section.items() if value is not None}
        if changes is None:
            del raw[name]
    return SensorDescription.model_validate(raw)
