"""`tactomo bench`: what is refused before the work."""

from __future__ import annotations

import pytest
from fixture_types import Run


def test_a_method_goes_with_the_chart(tactomo: Run) -> None:
    tactomo("bench", "--method", "tikhonov", status=2)


def test_without_the_laboratory_the_chart_says_how_to_get_it(
    tactomo: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: ())
    result = tactomo("bench", "--chart", "chart.png", status=1)
    assert "pip install tactomo-lab" in result.stderr
