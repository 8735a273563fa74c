"""What needs the extra `train`, run by `make test-train`; without it nothing is collected."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from small_sensor import SMALL
from tactomo_models import SensorDescription, load_description
from threadpoolctl import threadpool_limits

EXTRA = ("distributed", "joblib", "onnx", "torch")
collect_ignore_glob = [] if all(map(find_spec, EXTRA)) else ["test_*.py"]


@pytest.fixture(scope="session")
def small_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("sensor") / "small.toml"
    file.write_text(SMALL)
    return file


@pytest.fixture(scope="session")
def small(small_file: Path) -> SensorDescription:
    return load_description(small_file)


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> Iterator[None]:
    """More threads only get into each other's way, and a sum's order is always the same."""
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.delenv("CACHE_DIRECTORY", raising=False)
        yield
