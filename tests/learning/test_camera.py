"""The plug-in as LeRobot finds and uses it, at a sensor's stream."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from recorded_grasp import contacts_of, images_of
from tactomo_client.fake import FakeSensor

pytestmark = pytest.mark.peers
pytest.importorskip("lerobot", reason="make test-peers installs LeRobot")

PRESSED = 50


@contextmanager
def camera(sensor: FakeSensor, **options: Any) -> Iterator[Any]:
    """Make it as LeRobot does of a command line's words."""
    import draccus
    from lerobot.cameras.configs import CameraConfig
    from lerobot.cameras.utils import make_cameras_from_configs
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    words = {"type": "tactomo", "sensor": "left", "stream": sensor.address, **options}
    made = make_cameras_from_configs({"skin": draccus.decode(CameraConfig, words)})["skin"]
    made.connect(warmup=False)
    sensor.wait_for_subscriber()
    yield made
    made.disconnect()
    assert not made.is_connected


def publish(sensor: FakeSensor, **changes: Any) -> None:
    images: dict[str, Any] = images_of(PRESSED)
    sensor.publish(contacts_of(PRESSED), **images, **changes)


def test_a_picture_holds_the_numbers_of_the_map(sensor: FakeSensor) -> None:
    with camera(sensor) as skin:
        publish(sensor)
        picture = skin.async_read(timeout_ms=10_000)
        assert picture.shape == (skin.height, skin.width, 3) == (204, 204, 3)
        nodes = picture[::-4, ::4].astype(float)  # a block of four by four for each, y up
        pressure = images_of(PRESSED)["pressure_kpa"]
        assert pressure is not None
        unknown = np.isnan(pressure)
        assert unknown.any()
        np.testing.assert_array_equal(nodes[..., 2] == 255, unknown)
        np.testing.assert_allclose(nodes[..., 0], np.nan_to_num(pressure), atol=0.51)  # kPa
        structure = images_of(PRESSED)["structure"]
        assert structure is not None
        np.testing.assert_array_equal(nodes[..., 1], 255 * structure)


def test_a_frame_that_may_miss_touches_is_unknown_throughout(sensor: FakeSensor) -> None:
    with camera(sensor) as skin:
        publish(sensor, flags=["no_reference"])
        assert (skin.read()[..., 2] == 255).all()


def test_an_old_frame_is_never_shown_as_new(sensor: FakeSensor) -> None:
    with camera(sensor) as skin:
        with pytest.raises(RuntimeError, match="no frame"):
            skin.read_latest()
        with pytest.raises(TimeoutError, match="no frame"):
            skin.async_read(timeout_ms=20)
        publish(sensor)
        skin.async_read(timeout_ms=10_000)
        with pytest.raises(TimeoutError, match="no frame"):
            skin.async_read(timeout_ms=20)  # the same one again is no new one
        publish(sensor, acquired_monotonic_ns=time.monotonic_ns() - 2_000_000_000)
        skin.async_read(timeout_ms=10_000)
        with pytest.raises(TimeoutError, match="s old"):
            skin.read_latest()
        assert (skin.read_latest(max_age_ms=60_000)[..., 2] == 255).all()  # old: not known


def test_no_daemon_is_told(sensor: FakeSensor) -> None:
    with camera(sensor) as skin:
        skin.disconnect()
        skin.config.timeout_s = 0.05
        with pytest.raises(ConnectionError, match="does the daemon run"):
            skin.connect()
        assert not skin.is_connected
        skin.connect(warmup=False)


def test_what_cannot_be_a_size_is_refused() -> None:
    from lerobot_camera_tactomo import TactomoCameraConfig

    with pytest.raises(ValueError, match="max_kpa = 0"):
        TactomoCameraConfig(max_kpa=0.0)
