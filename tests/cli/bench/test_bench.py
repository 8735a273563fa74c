"""`tactomo bench`: what it measures, it tells of each scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

Run = Callable[..., Any]


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_each_scene_is_measured(tactomo: Run) -> None:
    result = tactomo("bench", "--seconds", 1, "--ports", 1, "--json")
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    assert [phase["frames"] > 0 < phase["latency_p50_ms"] for phase in told["live"]] == [True] * 4
    assert told["dropped_scans"] is not None
