"""A score of the laboratory that no scene gave: the numbers that a test does not name are plain."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

from tactomo_lab.scenes.measures import Score

PLAIN: Final = Score(
    scene="tuning 1/0",
    phase="",
    contacts=(),
    found=1,
    groups=1,
    countable=True,
    switches=0,
    rie=0.2,
    icc=0.9,
    icc_structure=0.95,
    flags=(),
    has_map=True,
    tier="fit",
    reason="",
    misfit=1.0,
    confidence=float("nan"),
    seconds=0.1,
    shape="ellipse",
    contrast=30.0,
    snr_db=40.0,
)


def made_score(**given: Any) -> Score:
    """Return that score with some of its fields replaced."""
    return replace(PLAIN, **given)
