"""Demos that several tests share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from whole_system import Demo, running_demo


@pytest.fixture(scope="module")
def demo() -> Iterator[Demo]:
    """A demo with a port for each channel."""
    with running_demo() as running:
        yield running
