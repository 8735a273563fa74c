"""The shipped layout shows what is published, under its names."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import pytest
from tactomo_foxglove import layout_for, shipped_layout
from tactomo_foxglove.topics import FRAME_SCHEMA

TOPICS = {"sheet", "contacts", "grid", "frame", "events"}
SCHEMAS = {"frame": FRAME_SCHEMA}


def texts(value: Any) -> Iterator[str]:
    """Yield every string in it, keys included."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield key
            yield from texts(each)
    elif isinstance(value, list):
        for each in value:
            yield from texts(each)
    elif isinstance(value, str):
        yield value


def test_it_names_no_topic_and_no_field_that_there_is_not() -> None:
    paths = [text for text in texts(json.loads(shipped_layout())) if text.startswith("/skin/")]
    assert {path.split("/")[2].partition(".")[0] for path in paths} == TOPICS
    for path in paths:
        topic, _, rest = path.removeprefix("/skin/").partition(".")
        assert topic in TOPICS, path
        schema: Any = SCHEMAS.get(topic)
        for step in filter(None, rest.split(".")):
            name, _, field = re.fullmatch(  # type: ignore[union-attr]
                r"(\w+)(\[:\]\{(\w+)==\d+\})?", step
            ).groups()
            assert name in schema["properties"], path
            schema = schema["properties"][name]
            if field:
                schema = schema["items"]
                assert schema["properties"][field]["type"] == "integer", path


@pytest.mark.parametrize("sensor", ["left_forearm", "left.arm-2"])
def test_for_a_sensor_of_another_name(sensor: str) -> None:
    layout = json.loads(layout_for(sensor))
    assert not [text for text in texts(layout) if "skin" in text]
    config = layout["configById"]
    assert config["3D!map"]["followTf"] == sensor
    assert f"/{sensor}/grid" in config["3D!map"]["topics"]
    value = config["Plot!force"]["paths"][0]["value"]
    quote = '"' if "-" in sensor else ""
    assert value == f"{quote}/{sensor}/frame{quote}.force_n"
