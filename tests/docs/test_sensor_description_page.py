"""docs/sensor_description.md against the model: every key with its type, range and default."""

from __future__ import annotations

from typing import Any

import pytest
from tables import table
from tactomo_models import SensorDescription

SCHEMA = SensorDescription.model_json_schema(by_alias=True)
TABLES = {
    "At the top": "",
    "`[sheet]`": "Sheet",
    "`[electrodes]`": "Electrodes",
    "`[pattern]`": "Pattern",
    "`[instrument]`": "Instrument",
    "`[map]`": "MapGrid",
    "`[magnitude.response]`": "MagnitudeResponse",
    "`[structure]`": "StructureChannel",
    "`[structure.response]`": "StructureResponse",
    "`[companion.NAME]`": "Companion",
    "`[mount]`": "Mount",
    "`[mount.plane]`": "PlaneMount",
    "`[mount.cylinder]`": "CylinderMount",
    "`[mount.surface]`": "SurfaceMount",
}


def single(field: dict[str, Any]) -> dict[str, Any]:
    """Return the first kind of value that a field takes; others are of the same, or none."""
    while options := field.get("anyOf") or field.get("oneOf"):
        field = {**options[0], **{k: v for k, v in field.items() if k not in ("anyOf", "oneOf")}}
    return field


def range_of(field: dict[str, Any]) -> str:
    field = single(field)
    if "enum" in field:
        return ", ".join(f"`{choice}`" for choice in field["enum"])
    if "exclusiveMinimum" in field:
        return f"above {field['exclusiveMinimum']:g}, to {field['maximum']:g}"
    return f"{field['minimum']:g} to {field['maximum']:g}" if "minimum" in field else ""


@pytest.mark.parametrize(("heading", "name"), TABLES.items())
def test_every_key_has_its_row(heading: str, name: str) -> None:
    schema = SCHEMA["$defs"][name] if name else SCHEMA
    fields = {
        key: field
        for key, field in schema["properties"].items()
        if "$ref" not in str(single(field)) and "const" not in field
    }
    told = table("docs/sensor_description.md", f"## {heading}", "Key")
    assert told.keys() - {"schema"} == fields.keys()
    for key, field in fields.items():
        _, _, _, span, default, since, meaning = told[key].values()
        assert span == range_of(field) or not range_of(field), key
        required = key in schema.get("required", ())
        given = field.get("default")
        expected = "required" if required else "" if given in (None, "") else f"`{given}`".lower()
        assert default.lower() == expected, key
        assert since == "1", key
        assert len(meaning) > 10, key


def test_every_section_has_its_table() -> None:
    assert set(SCHEMA["$defs"]) - {"MagnitudeChannel"} == set(TABLES.values()) - {""}
