"""The pressure map as a picture whose three bytes of a pixel are numbers, not colours.

===== ============================ =================================================================
byte  meaning                      scale
===== ============================ =================================================================
red   pressure                     0 to 255 for 0 to `max_kpa`, which is 255 kPa: 1 kPa each
green how surely it is pressed     0 to 255 for 0 to 1
blue  whether pressure is unknown  255 where it is, or where the frame may miss touches; else 0
===== ============================ =================================================================

The top row is the sheet's far side, y up as seen from the pressed side. Each node is a block of
pixels: encoders of video want more than 51 of them, and an even number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.cameras.camera import Camera
from lerobot.cameras.configs import CameraConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from numpy.typing import NDArray
from tactomo_client import DEFAULT_STREAM, Frame, Subscription, subscribe

Picture = NDArray[np.uint8]


@CameraConfig.register_subclass("tactomo")
@dataclass(kw_only=True)
class TactomoCameraConfig(CameraConfig):
    """Which sensor, and how its map becomes a picture."""

    sensor: str = "skin"
    stream: str = DEFAULT_STREAM
    keys: str | None = None
    """The folder of keys, for a daemon beyond this computer."""
    max_kpa: float = 255.0
    fps: int | None = 20
    width: int | None = 204
    """Four pixels for each of 51 nodes."""
    height: int | None = 204
    timeout_s: float = 5.0
    """How long to wait for the first frame."""

    def __post_init__(self) -> None:
        """Raise ValueError where a number is not positive."""
        for name in ("max_kpa", "fps", "width", "height", "timeout_s"):
            if not (value := getattr(self, name)) or value <= 0:
                raise ValueError(f"{name} = {value!r}: give a positive number")


class TactomoCamera(Camera):
    """One sensor's map, as it is now; it never shows an old one without saying so."""

    def __init__(self, config: TactomoCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self._skin: Subscription[Frame] | None = None
        self._shown: tuple[str, int] | None = None

    @property
    def is_connected(self) -> bool:
        """Whether frames are received."""
        return self._skin is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """Raise NotImplementedError: a stream does not list its sensors."""
        raise NotImplementedError("`tactomo status` names the sensor of the daemon that runs")

    def connect(self, warmup: bool = True) -> None:
        """Subscribe; with `warmup` wait for the first frame.

        Raises:
            ConnectionError: it does not come.
            DeviceAlreadyConnectedError: it is connected.
        """
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self.config.sensor} is connected")
        config = self.config
        self._skin = subscribe(
            config.sensor, address=config.stream, keys=config.keys, latest_only=True
        )
        if warmup and self._skin.wait(config.timeout_s) is None:
            self.disconnect()
            raise ConnectionError(
                f"no frame of {config.sensor} from {config.stream} in {config.timeout_s:g} s: does "
                "the daemon run? `tactomo status` tells"
            )

    def read(self) -> Picture:
        """Wait for the next frame; raise TimeoutError where none comes within `timeout_s`."""
        return self._next(self.config.timeout_s)

    def async_read(self, timeout_ms: float = 200) -> Picture:
        """Return the newest unread frame, or wait for one; raise TimeoutError where none comes."""
        frame = self._connected().latest()
        if frame is None or self._shown == (frame.session, frame.sequence):
            return self._next(timeout_ms * 1e-3)
        return self._picture(frame)

    def read_latest(self, max_age_ms: int = 500) -> Picture:
        """Return the newest frame at once.

        Raises:
            RuntimeError: none has come yet.
            TimeoutError: it is older than that.
        """
        frame = self._connected().latest()
        if frame is None:
            raise RuntimeError(f"no frame of {self.config.sensor} yet")
        if frame.age_s * 1e3 > max_age_ms:
            raise TimeoutError(f"the newest frame is {frame.age_s:.3f} s old")
        return self._picture(frame)

    def disconnect(self) -> None:
        """Stop receiving; raise DeviceNotConnectedError where nothing is received."""
        self._connected().close()
        self._skin = self._shown = None

    def _connected(self) -> Subscription[Frame]:
        if self._skin is None:
            raise DeviceNotConnectedError(f"{self.config.sensor} is not connected")
        return self._skin

    def _next(self, timeout_s: float) -> Picture:
        frame = self._connected().wait(timeout_s)
        if frame is None:
            raise TimeoutError(f"no frame of {self.config.sensor} for {timeout_s:g} s")
        return self._picture(frame)

    def _picture(self, frame: Frame) -> Picture:
        self._shown = frame.session, frame.sequence
        images = (frame.pressure_kpa, frame.structure, frame.map)
        shape = next((image.shape for image in images if image is not None), (1, 1))
        unknown = np.full(shape, np.nan)
        pressure = unknown if frame.pressure_kpa is None else frame.pressure_kpa
        structure = np.zeros(shape) if frame.structure is None else frame.structure
        is_unknown = np.isnan(pressure) | (not frame.is_known)
        channels = (pressure / self.config.max_kpa, structure, is_unknown)
        picture = np.stack([np.nan_to_num(channel) for channel in channels], axis=-1)
        bytes_ = np.round(np.clip(picture, 0.0, 1.0) * 255).astype(np.uint8)[::-1]
        rows = np.arange(self.height or 0) * shape[0] // (self.height or 1)
        columns = np.arange(self.width or 0) * shape[1] // (self.width or 1)
        return bytes_[rows[:, None], columns]
