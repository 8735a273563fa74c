"""What is published of a frame: units, and nil for what is not known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tactomo.imaging.frames import contacts_fields, description_fields, scan_header
from tactomo.scans import ChannelScan, DualScan, Timing
from tactomo_models import Contact, Flag, Reconstruction, load_description
from tactomo_protocol import Channel, ScanFlag
from variants import variant

SENSOR = load_description("paper_square")
CONTACT = Contact(
    7,
    x_m=0.012,
    y_m=-0.034,
    area_m2=5e-4,
    magnitude=0.2,
    magnitude_sigma=0.01,
    pressure_kpa=180.0,
    x_sigma_m=1.5e-3,
    y_sigma_m=2.5e-3,
    area_sigma_m2=3e-5,
    pressure_sigma_kpa=4.0,
    force_n=9.0,
    force_sigma_n=0.5,
    peak_kpa=220.0,
    peak_sigma_kpa=6.0,
    max_kpa=230.0,
    edge=0.5,
)


def frame(**details: Any) -> Reconstruction:
    said: dict[str, Any] = {
        "map": np.zeros((51, 51), np.float32),
        "pressure_kpa": None,
        "structure": None,
        "contacts": (CONTACT,),
        "tier": "fit",
        "reason": "a test",
        "misfit": 1.0,
        "flags": Flag(0),
        "stage_s": {},
    }
    return Reconstruction(**{**said, **details})


def test_a_contact_is_where_it_is_on_the_robot() -> None:
    where: dict[str, Any] = {
        "position_m": (0.1, 0.2, 0.3),
        "normal": (0.0, 0.6, 0.8),
        "frame": "arm",
    }
    mounted = replace(CONTACT, **where)
    [known, unknown] = contacts_fields(0, frame(contacts=(mounted, CONTACT)))["contacts"]
    assert {name: known[name] for name in where} == where
    assert [unknown[name] for name in where] == [None] * 3


def test_a_status_says_where_the_sheet_lies() -> None:
    assert description_fields(SENSOR)["mount"] is None
    cylinder = {"radius_m": 0.05, "position_m": (0.0, 0.0, 0.2)}
    mounted = variant(SENSOR, mount={"frame": "arm", "cylinder": cylinder})
    mount = description_fields(mounted)["mount"]
    assert (mount["frame"], mount["kind"]) == ("arm", "cylinder")
    x, y, z = np.array(mount["surface_m"]).T
    assert np.hypot(x, y) == pytest.approx(0.05, abs=1e-6)
    assert (z.min(), z.max()) == pytest.approx((0.125, 0.275))


def test_a_frame_was_acquired_before_its_last_byte_came() -> None:
    def scan(channel: Channel, arrived_ns: int) -> ChannelScan:
        times = (10**9 + arrived_ns, arrived_ns, arrived_ns)
        return ChannelScan(channel, 1, 50, ScanFlag(0), np.zeros(1), *times, 0)

    dual = DualScan(1, scan(Channel.MAGNITUDE, 4_000_000), scan(Channel.STRUCTURE, 9_000_000))
    header = scan_header(dual, Timing(5_000_000, True, -2_500_000, True))
    assert header["acquired_monotonic_ns"] == 4_000_000
    assert header["acquired_realtime_ns"] == 10**9 + 4_000_000
    assert (header["dated_by"], header["skew_ms"]) == ("device", -2.5)
    assert header["flags"] == ["channels_skewed"]
