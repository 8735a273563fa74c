"""Robot presses on a skin of another pattern: orders of voltages, and localisation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tactomo_lab.evaluation.presses import (
    IMAGE,
    TAUGHT,
    Presses,
    localise,
    read_presses,
    scan_order,
)
from tactomo_models import DataError, Press, SensorDescription, SkinSimulator, load_description
from tactomo_models.arrays import IntArray
from tactomo_protocol import Channel
from variants import variant


@pytest.fixture(scope="module")
def skin() -> SensorDescription:
    return load_description("skin_round")


@pytest.fixture(scope="module")
def coarse(skin: SensorDescription) -> SensorDescription:
    """The same on a coarser map, so that it is simulated in a second."""
    return variant(skin, map={"nodes_x": 31, "nodes_y": 31})


def lookup_of(skin: SensorDescription) -> IntArray:
    return np.hstack([skin.pairs.drive, skin.pairs.measure])


@given(seed=st.integers(0, 2**32 - 1))
def test_any_order_and_sign_is_brought_back(skin: SensorDescription, seed: int) -> None:
    rng = np.random.default_rng(seed)
    lookup, volts = lookup_of(skin), rng.standard_normal(192)
    shuffle, turned = rng.permutation(192), rng.random(192) < 0.5
    theirs = lookup[shuffle]
    theirs[turned] = theirs[turned][:, [0, 1, 3, 2]]
    order, sign = scan_order(theirs, skin)
    ours = np.empty(192)
    ours[order] = np.where(turned, -volts[shuffle], volts[shuffle]) * sign
    np.testing.assert_array_equal(ours, volts)


def test_another_pattern_is_refused(skin: SensorDescription, tmp_path: Path) -> None:
    adjacent = load_description("tank_disc")
    with pytest.raises(DataError, match="tank_disc"):
        scan_order(lookup_of(skin), adjacent)
    path = tmp_path / "presses.npz"
    good: dict[str, Any] = {
        "lookup": lookup_of(skin),
        "dv": np.zeros((4, 192)),
        "pos_m": np.eye(4)[:, :3],
    }
    np.savez(path, **good)
    assert read_presses(path, skin).positions_m.shape == (4, 2)
    for change, told in (
        ({"dv": np.zeros((4, 190))}, "190"),
        ({"lookup": np.zeros((192, 3), int)}, "lookup"),
        ({"pos_m": np.zeros(4)}, "pos_m"),
        ({"dv": np.array(["a"])}, "none that is real"),
    ):
        np.savez(path, **{**good, **change})
        with pytest.raises(DataError, match=told):
            read_presses(path, skin)
    with pytest.raises(DataError, match="cannot read"):
        read_presses(tmp_path / "absent.npz", skin)


@pytest.mark.slow
def test_presses_are_located_whatever_the_robots_frame(coarse: SensorDescription) -> None:
    """Simulated on a finer, uneven skin; the frame is turned and mirrored, half is not read."""
    rng = np.random.default_rng(5)
    radius, angle = 0.036 * np.sqrt(rng.random(100)), 2 * np.pi * rng.random(100)
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    simulator = SkinSimulator(coarse, unevenness=0.03, impedance_spread=0.2, seed=2)
    rest = simulator.voltages([])[Channel.STRUCTURE]
    volts = [simulator.voltages([Press(x, y, 1.0, 0.004)])[Channel.STRUCTURE] for x, y in places]
    changes = np.array(volts) - rest
    noise = 0.05 * np.sqrt(np.mean(changes**2)) * rng.standard_normal(changes.shape)
    changes = np.where(rest > 0, changes, 0.0) + noise
    frame = np.array([[0.6, 0.8], [0.8, -0.6]])
    found = dict(localise(Presses(changes, places @ frame), coarse))
    assert np.median(found[IMAGE]) < 4
    assert np.quantile(found[IMAGE], 0.95) < 12
    assert np.median(found[TAUGHT]) < 4
