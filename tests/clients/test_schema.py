"""What is written from the schema is committed as it was written; a new field is one definition."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
from tactomo_client.schema import Contact, wire_fields

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def writer() -> ModuleType:
    spec = importlib.util.spec_from_file_location("w", ROOT / "clients/write_schema.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_what_is_committed_is_what_the_schema_writes(writer: ModuleType) -> None:
    for path, text in writer.written().items():
        assert path.read_text("utf-8") == text, f"{path}: run `make schema`"


def test_a_new_field_of_a_contact_is_in_every_table_and_read_in_cpp(writer: ModuleType) -> None:
    source = writer.SOURCE.read_text("utf-8")
    more = source.replace(
        "    taught: bool = False\n",
        "    taught: bool = False\n    hot_n: float | None = None  #: Warm\n",
    )
    written = writer.written(more)
    assert "| `hot_n` | float or nil | N | 1 | Warm. |" in written[writer.STREAM]
    assert "| `contact_hot_n` | float64 (C,) | N | 0.1 | Warm. |" in written[writer.FILES]
    assert "std::optional<double> hot_n;" in written[writer.HEADER]
    assert 'each("hot_n", fields.hot_n, Allow::both);' in written[writer.HEADER]


def test_every_field_of_a_contact_has_a_meaning(writer: ModuleType) -> None:
    rows = writer.read_schema(writer.SOURCE.read_text("utf-8"))["Contact"]
    assert tuple(row.name for row in rows) == wire_fields(Contact)
    assert all(row.meaning for row in rows)
