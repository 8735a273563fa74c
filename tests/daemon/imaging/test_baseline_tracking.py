"""The daemon's baseline: it follows a skin that warms, says so, and replays give the same maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixture_types import Start
from tactomo.recordings.recording import open_recording
from tactomo_client.messages import array_from_wire
from tactomo_models import Press, SkinSimulator, load_description
from tactomo_models.drift import baseline, channel_baseline


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every frame counts at once: what takes minutes otherwise takes frames."""
    monkeypatch.setattr(channel_baseline, "BLOCK_S", 0.0)
    monkeypatch.setattr(baseline, "MOVE_S", 0.0)
    monkeypatch.setattr(baseline, "TIME_CONSTANT_S", 1.0)
    monkeypatch.setattr(channel_baseline, "GAIN_PER_S", 1.0)


@pytest.mark.slow
@pytest.mark.usefixtures("hasty")
def test_the_baseline_follows_and_a_replay_gives_the_same_maps(
    bench: Start, replay: Start, tmp_path: Path
) -> None:
    path = tmp_path / "warming.mcap"
    skin = SkinSimulator(load_description("paper_square"), spacing_m=0.008)  # coarse, but quick
    b = bench(real=True, baseline={"time_constant_s": 5.0})

    def step(gain: float, *presses: Press) -> Any:
        volts = skin.voltages(presses)
        return b.step(volts={name: gain * each for name, each in volts.items()})

    b.skin.introduce()
    for _ in range(b.daemon.config.tare_scans):
        step(1.0)
    b.listener.event("tared")
    for _ in range(5):
        step(1.0)
    b.ask("record_start", path=path.name)
    first = b.skin.counter + 1
    gains = np.linspace(1.0, 0.96, 30)
    frames = [step(gain) for gain in gains]
    pressed = step(gains[-1], Press(0.0, 0.03, 180.0))
    released = step(gains[-1])
    status = b.ask("status")["baseline"]
    b.ask("record_stop")
    live = [frame for frame in b.listener.of("map") if frame["scan_counter"] >= first]

    assert {frame["tier"] for frame in [*frames, released]} == {"quiet"}
    assert len(pressed["contacts"]) == 1
    assert status["state"] == "following"
    assert status["moves"] > 3
    assert status["drift"]["structure"]["gain"] == pytest.approx(-0.04, abs=0.01)
    assert open_recording(path).summary.references > 3
    again = replay(path, real=True).of("map")
    assert [f["scan_counter"] for f in again] == [f["scan_counter"] for f in live]
    for one, other in zip(live, again, strict=True):
        assert (one["tier"], one["misfit"]) == (other["tier"], other["misfit"])
        np.testing.assert_array_equal(array_from_wire(one["map"]), array_from_wire(other["map"]))


@pytest.mark.slow
def test_a_change_that_no_skin_makes_is_refused_and_a_tare_helps(
    bench: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(baseline, "DISTRUSTED_S", 0.0)
    skin = SkinSimulator(load_description("paper_square"), spacing_m=0.008)
    volts = skin.voltages([])
    cold = {name: 1.25 * each for name, each in volts.items()}
    b = bench(real=True, method="tikhonov")
    b.skin.introduce()
    for _ in range(b.daemon.config.tare_scans):
        b.step(volts=volts)
    b.listener.event("tared")
    b.step(volts=volts)
    for _ in range(4):
        b.step(volts=cold)
    refused = b.listener.event("baseline_refused")
    assert refused["severity"] == "warning"
    assert "heats or cools" in refused["next_step"]
    assert "tactomo tare" in refused["next_step"]
    for _ in range(4):
        b.step(volts=cold)
    assert [e["name"] for e in b.listener.of("event")].count("baseline_refused") == 1
    assert b.ask("status")["baseline"]["state"] == "refused"
