"""Scripted scenes: who presses where, when and how hard, read from a TOML file.

A scene is a list of presses on a common time line. Each one starts at ``at_s``, stays for
``duration_s``, may move along a path and may change its pressure on the way::

    name = "A sliding finger"
    loop = true

    [[press]]
    at_s = 0.5
    duration_s = 4.0
    x_mm = -45
    y_mm = 0
    pressure_kpa = 180
    path = [{ after_s = 4.0, x_mm = 45, y_mm = 20 }]

``Scene.presses_at`` is a pure function of time, so the same file gives the same presses at the
same device times on every run.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from tactomo_models import Press
from tactomo_models.simulation.skin_drift import SkinDrift
from tactomo_models.toml_file import read_toml

from tactomo.errors import ConfigError, os_errors_as
from tactomo.stream.commands import explained

Millimetres = Annotated[float, Field(ge=-1000.0, le=1000.0, allow_inf_nan=False)]
RadiusMm = Annotated[float, Field(gt=0.0, le=1000.0, allow_inf_nan=False)]
PressureKpa = Annotated[float, Field(ge=0.0, le=10_000.0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0.0, le=86_400.0, allow_inf_nan=False)]

SHIPPED: Final = {
    path.stem: path for path in sorted(Path(__file__).with_name("scenes").glob("*.toml"))
}
"""Files of the scenes that come with tactomo, by name."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Indenter(_Strict):
    """What presses: an outline of a size and an angle, at a place, with a pressure."""

    x_mm: Millimetres
    y_mm: Millimetres
    radius_mm: RadiusMm = 15.0
    radius_y_mm: RadiusMm | None = None
    angle_deg: float = Field(default=0.0, ge=-360.0, le=360.0, allow_inf_nan=False)
    pressure_kpa: PressureKpa = 180.0
    shape: Literal["ellipse", "rectangle", "ring"] = "ellipse"

    def press(self) -> Press:
        """Return the same press in the simulator's units (metres, radians)."""
        return Press(
            x_m=self.x_mm * 1e-3,
            y_m=self.y_mm * 1e-3,
            pressure_kpa=self.pressure_kpa,
            radius_m=self.radius_mm * 1e-3,
            radius_y_m=None if self.radius_y_mm is None else self.radius_y_mm * 1e-3,
            angle_rad=math.radians(self.angle_deg),
            shape=self.shape,
        )


class Waypoint(_Strict):
    """Where a moving press is ``after_s`` seconds after its start, and how hard it presses then."""

    after_s: Seconds
    x_mm: Millimetres
    y_mm: Millimetres
    pressure_kpa: PressureKpa | None = None


class ScriptedPress(Indenter):
    """One press of a scene: from ``at_s`` for ``duration_s`` seconds.

    The press starts at (``x_mm``, ``y_mm``) and moves in straight lines through ``path``; past the
    last waypoint it stays there. A waypoint without a pressure keeps the one before it. ``ramp_s``
    lets the pressure rise from zero and fall to zero again, linearly, within the duration.
    """

    id: str | None = None
    at_s: Seconds
    duration_s: Annotated[float, Field(gt=0.0, le=86_400.0, allow_inf_nan=False)]
    ramp_s: Seconds = 0.0
    path: tuple[Waypoint, ...] = ()

    @model_validator(mode="after")
    def _times_fit(self) -> Self:
        times = [waypoint.after_s for waypoint in self.path]
        if any(later <= earlier for earlier, later in zip([0.0, *times], times, strict=False)):
            raise ValueError("path: after_s must be above 0 and rise from waypoint to waypoint")
        if 2.0 * self.ramp_s > self.duration_s:
            raise ValueError(f"ramp_s: at most half of duration_s ({self.duration_s / 2:g})")
        return self

    @property
    def ends_s(self) -> float:
        """Scene time at which the press is lifted, in seconds."""
        return self.at_s + self.duration_s

    def indenter_at(self, scene_s: float) -> Indenter | None:
        """Return the press as it is at ``scene_s``, or None before its start and after its end."""
        if not self.at_s <= scene_s < self.ends_s:
            return None
        age_s = scene_s - self.at_s
        times, x_mm, y_mm, pressure_kpa = self._track()
        now = {
            "x_mm": float(np.interp(age_s, times, x_mm)),
            "y_mm": float(np.interp(age_s, times, y_mm)),
            "pressure_kpa": float(np.interp(age_s, times, pressure_kpa)) * self._ramp(age_s),
        }
        return Indenter(**self.model_dump(include=set(Indenter.model_fields)) | now)

    def _track(self) -> tuple[list[float], list[float], list[float], list[float]]:
        times, x_mm, y_mm, pressure_kpa = [0.0], [self.x_mm], [self.y_mm], [self.pressure_kpa]
        for waypoint in self.path:
            times.append(waypoint.after_s)
            x_mm.append(waypoint.x_mm)
            y_mm.append(waypoint.y_mm)
            stays = waypoint.pressure_kpa is None
            pressure_kpa.append(pressure_kpa[-1] if stays else float(waypoint.pressure_kpa or 0.0))
        return times, x_mm, y_mm, pressure_kpa

    def _ramp(self, age_s: float) -> float:
        if self.ramp_s == 0.0:
            return 1.0
        return min(1.0, age_s / self.ramp_s, (self.duration_s - age_s) / self.ramp_s)


class SkinDriftSettings(_Strict):
    """How the skin itself drifts; what is not given stays as it is. `SkinDrift` explains them."""

    swing_k: Annotated[float, Field(ge=0.0, le=100.0, allow_inf_nan=False)] | None = None
    period_s: Annotated[float, Field(ge=1.0, le=1e6, allow_inf_nan=False)] | None = None
    step_k: Annotated[float, Field(ge=-50.0, le=50.0, allow_inf_nan=False)] | None = None
    per_kelvin: Annotated[float, Field(ge=-0.1, le=0.1, allow_inf_nan=False)] | None = None
    uneven: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] | None = None
    press_creep: Annotated[float, Field(ge=0.0, le=0.1, allow_inf_nan=False)] | None = None
    impedance: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] | None = None

    def skin_drift(self, before: SkinDrift | None = None) -> SkinDrift:
        """Return `before` (none, if None) with what is given here in its place."""
        keys = {"press_creep": "creep"}
        given = self.model_dump(include=set(SkinDriftSettings.model_fields), exclude_none=True)
        return replace(
            before or SkinDrift(), **{keys.get(key, key): value for key, value in given.items()}
        )


class Scene(_Strict):
    """A time line of presses; with ``loop`` it starts over after ``duration_s``."""

    name: str = ""
    loop: bool = False
    drift: SkinDriftSettings | None = None
    """How the skin drifts from the scene's start on; as the twin was set up if None."""
    duration_s: Annotated[float, Field(gt=0.0, le=86_400.0, allow_inf_nan=False)] | None = None
    press: tuple[ScriptedPress, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _lasts_long_enough(self) -> Self:
        last_s = max(press.ends_s for press in self.press)
        if self.duration_s is not None and self.duration_s < last_s:
            raise ValueError(f"duration_s: at least {last_s:g}, when the last press ends")
        return self

    @property
    def length_s(self) -> float:
        """Length of the time line in seconds: ``duration_s``, or until the last press ends."""
        return self.duration_s or max(press.ends_s for press in self.press)

    def presses_at(self, elapsed_s: float) -> dict[str, Indenter]:
        """Return what presses the skin ``elapsed_s`` seconds after the scene began, by id.

        A press without an id is called ``scene-0``, ``scene-1``, ... by its place in the file.
        """
        scene_s = elapsed_s % self.length_s if self.loop else elapsed_s
        now = {}
        for index, scripted in enumerate(self.press):
            indenter = scripted.indenter_at(scene_s)
            if indenter is not None and indenter.pressure_kpa > 0.0:
                now[scripted.id or f"scene-{index}"] = indenter
        return now


def load_scene(source: str | Path) -> Scene:
    """Read a scene by its shipped name or from a TOML file.

    Raises ConfigError where the file cannot be read, is not TOML, or a key is unknown, missing or
    out of range; the message names the key, its value and what is allowed.
    """
    path = SHIPPED.get(str(source), Path(source))
    step = f"give the path of a TOML file, or one of: {', '.join(SHIPPED)}"
    try:
        with os_errors_as(ConfigError, f"cannot read the scene {path}", step):
            return Scene.model_validate(read_toml(path))
    except ValidationError as error:
        raise ConfigError(f"{path}: {explained(error)}", "correct the file") from error
    except ValueError as error:
        raise ConfigError(f"{path} is not valid TOML: {error}", "correct the file") from error
