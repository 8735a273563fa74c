"""A recording of pressed skin, replayed: the sensor's own reconstruction, to the last bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixture_types import Start
from tactomo.recordings.recording import open_recording
from tactomo_client.messages import array_from_wire
from tactomo_models import Press, SensorDescription, SkinSimulator, load_description
from tactomo_models.calibration.calibration_file import (
    CALIBRATIONS,
    PressureCalibration,
    subject_of,
)
from tactomo_models.calibration.curve import Reading
from tactomo_protocol import Channel

IMAGES = ("map", "pressure_kpa", "structure")


def a_calibration(name: str, sensor: SensorDescription) -> PressureCalibration:
    """Of a sheet that needs half as much pressure again as its description says."""
    levels = [150.0, 195.0, 210.0, 240.0, 270.0, 300.0, 330.0, 360.0]
    readings = [Reading(pressure_kpa=k, magnitude=max(0.0, (k - 210) * 2.5e-3)) for k in levels]
    return PressureCalibration.of_readings(subject_of(name, sensor), readings)


@pytest.mark.slow
def test_the_replay_of_a_pressed_skin_gives_the_same_maps(
    bench: Start, replay: Start, tmp_path: Path
) -> None:
    """Also where another pressure calibration is put in force meanwhile."""
    path = tmp_path / "pressed.mcap"
    sensor = load_description("paper_square")
    skin = SkinSimulator(sensor, spacing_m=0.004)  # on a coarser one discs look like rings
    b = bench(ports=2, real=True, sync_wait_ms=1000)

    def press(*presses: Press, channels: tuple[Channel, ...] = tuple(Channel)) -> Any:
        return b.step(volts=skin.voltages(presses), channels=channels)

    b.skin.introduce()
    for _ in range(b.daemon.config.tare_scans):
        press()
    b.listener.event("tared")
    before = press(Press(0.0, 0.03, 180.0))
    b.ask("record_start", path=path.name)
    first = b.skin.counter + 1
    after = press(Press(0.0, 0.03, 180.0))  # a recording begins cold, but nobody need notice
    assert [c["id"] for c in before["contacts"]] == [c["id"] for c in after["contacts"]] != []
    for step in range(4):
        press(Press(-0.03 + 0.004 * step, 0.02, 180.0))
    CALIBRATIONS.save(a_calibration("left", sensor), CALIBRATIONS.path("left"))
    told = b.ask("reload_calibration")["calibration"]
    pressed = press(Press(-0.014, 0.02, 180.0), Press(0.04, -0.03, 190.0))
    press(Press(-0.014, 0.02, 180.0), channels=(Channel.MAGNITUDE,))  # the last shape is held
    press(Press(0.0, -0.05, 190.0), channels=(Channel.MAGNITUDE,))  # it explains this no more
    press()
    press(Press(0.04, -0.03, 190.0))
    b.ask("record_stop")
    live = [frame for frame in b.listener.of("map") if frame["scan_counter"] >= first]

    assert len(pressed["contacts"]) == 2
    hardest = max(contact["pressure_kpa"] for contact in pressed["contacts"])
    assert 240 < hardest <= told["range_kpa"][1]
    highest = np.nanmax(array_from_wire(pressed["pressure_kpa"]))
    # Each kind that a contact may be has its peak elsewhere: no node has the mean of the peaks.
    assert highest == pytest.approx(hardest, rel=0.02)
    assert {"quiet", "fit", "network"} == {frame["tier"] for frame in live}
    again = replay(path, real=True).of("map")
    assert len(again) == len(live) == open_recording(path).summary.frames
    for one, other in zip(live, again, strict=True):
        for name in ("scan_counter", "tier", "flags", "misfit"):
            assert one[name] == other[name]
        for name in IMAGES:
            assert (one[name] is None) == (other[name] is None)
            if one[name] is not None:
                np.testing.assert_array_equal(
                    array_from_wire(one[name]), array_from_wire(other[name])
                )
