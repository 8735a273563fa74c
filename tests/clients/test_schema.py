"""What is written from the schema is committed as it was written; a new field is one definition."""

from __future__ import annotations

import write_schema
from tactomo_client.schema import Contact, wire_fields

SOURCE = write_schema.SOURCE.read_text("utf-8")


def test_what_is_committed_is_what_the_schema_writes() -> None:
    for path, text in write_schema.written(SOURCE).items():
        assert path.read_text("utf-8") == text, f"{path}: run `make schema`"


def test_every_field_of_a_message_has_a_meaning() -> None:
    schema = write_schema.read_schema(SOURCE)
    assert tuple(row.name for row in schema["Contact"]) == wire_fields(Contact)
    kinds = {kind for names in write_schema.TABLES.values() for kind in names}
    told = [field for kind in kinds for field in schema[kind] if not field.meaning]
    enveloped = {"sensor", *(field.name for field in schema["Envelope"])}
    assert {field.name for field in told} <= enveloped, "what the envelope explains is left out"
