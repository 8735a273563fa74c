"""A sensor on a real socket, for the client's tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from tactomo_client.fake import FakeSensor


@pytest.fixture
def sensor() -> Iterator[FakeSensor]:
    with FakeSensor("left") as sensor:
        yield sensor
