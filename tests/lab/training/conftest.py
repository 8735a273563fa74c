"""What needs the extra `train`, run by `make test-train`; without it that is not collected."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec

import pytest
from threadpoolctl import threadpool_limits

EXTRA = ("onnx", "torch")
OF_EXTRA = ["test_train.py", "test_your_own_sensor_trained.py"]
collect_ignore = [] if all(map(find_spec, EXTRA)) else OF_EXTRA


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> Iterator[None]:
    """More threads only get into each other's way, and a sum's order is always the same."""
    with threadpool_limits(1):
        yield
