"""The measurement of docs/fleet.md in small: what it counts adds up, and what it promises holds."""

from __future__ import annotations

import pytest
from fleet_measure import DOWN_S, Case, measure


@pytest.mark.slow
def test_a_fifth_of_the_bytes_at_rest_and_every_loss_is_told() -> None:
    by_clock = measure(Case(skins=20, seconds=3, robots=1, heartbeat_s=0.0))
    at_rest = measure(Case(skins=20, seconds=3, robots=1))
    assert by_clock["skins"] == at_rest["skins"] == 20
    assert at_rest["bytes_s_per_skin"] <= by_clock["bytes_s_per_skin"] / 5
    assert by_clock["untold"] == at_rest["untold"] == 0


@pytest.mark.slow
def test_a_router_killed_and_back_costs_what_the_counts_tell() -> None:
    figures = measure(Case(skins=20, touched=4, seconds=15, robots=1, kills_router=True))
    assert figures["tokens"] == {"SampleKind.PUT": 40, "SampleKind.DELETE": 20}
    assert figures["lost"] > 0
    assert figures["untold"] == 0
    assert figures["latency_ms"]["0.5"] < 500 * DOWN_S  # none was kept while the router was away
