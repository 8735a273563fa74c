"""Demos that several tests share."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from whole_system import Demo, running_demo


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Models are built anew for these tests, as on a fresh machine."""
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))
    yield
    if before is None:
        del os.environ["XDG_CACHE_HOME"]
    else:
        os.environ["XDG_CACHE_HOME"] = before


@pytest.fixture(scope="module", params=[1, 2], ids=["one port", "two ports"])
def any_demo(request: pytest.FixtureRequest) -> Iterator[Demo]:
    """A demo with one port for both channels, and one with a port for each."""
    with running_demo("--ports", str(request.param)) as demo:
        yield demo


@pytest.fixture(scope="module")
def demo() -> Iterator[Demo]:
    """A demo with a port for each channel."""
    with running_demo() as running:
        yield running
