"""Demos that several tests share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from whole_system import Demo, running_demo


@pytest.fixture(
    scope="module",
    params=[pytest.param(1, marks=pytest.mark.slow), 2],
    ids=["one port", "two ports"],
)
def any_demo(request: pytest.FixtureRequest) -> Iterator[Demo]:
    """A demo with one port for both channels, and one with a port for each.

    At half the usual rate: frames get less time where others take the processor and scans are late.
    """
    with running_demo("--ports", str(request.param), "--rate", "10") as demo:
        yield demo


@pytest.fixture(scope="module")
def demo() -> Iterator[Demo]:
    """A demo with a port for each channel."""
    with running_demo() as running:
        yield running
