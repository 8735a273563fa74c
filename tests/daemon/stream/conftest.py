"""Two sensors that send what they are told to."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from tactomo_client.fake import FakeSensor


@pytest.fixture
def left() -> Iterator[FakeSensor]:
    with FakeSensor("left") as sensor:
        yield sensor


@pytest.fixture
def right() -> Iterator[FakeSensor]:
    with FakeSensor("right") as sensor:
        yield sensor
