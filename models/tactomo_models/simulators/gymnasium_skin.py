"""Skins in the observation of a Gymnasium environment that MuJoCo simulates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from tactomo_models.scene.pressure import described_curve
from tactomo_models.simulators.mujoco_skin import MujocoSkin, Touch


class TactileObservation(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Adds what skins feel to each observation, and the truth to `info`.

    An observation becomes a dictionary: ``robot``, what the environment observes, and for each skin
    by its name

    - ``pressure_kpa`` (nodes_y, nodes_x) float32, 0 where it is not known;
    - ``is_known`` (nodes_y, nodes_x) int8: 0 where something touches too lightly or too hard, or
      nothing can be computed;
    - ``structure`` (nodes_y, nodes_x) float32, how surely each node is pressed, 0 to 1.

    `info` has each skin's `Touch` under its name: the frame with contacts and flags, the true
    pressure, and what pressed outside the sheet.

    Args:
        env: an environment with the `model` and `data` of MuJoCo, as `MujocoEnv` has.
        skins: by their names.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], skins: Mapping[str, MujocoSkin]) -> None:
        super().__init__(env)
        self._skins = skins
        felt = {name: _space(skin) for name, skin in skins.items()}
        self.observation_space = spaces.Dict({"robot": env.observation_space, **felt})

    def reset(self, **options: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset the environment, and have the skins forget what they felt."""
        observation, info = self.env.reset(**options)
        for skin in self._skins.values():
            skin.reset()
        return self._observed(observation, info)

    def step(self, action: Any) -> tuple[dict[str, Any], Any, bool, bool, dict[str, Any]]:
        """Step the environment, then feel."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        observed, told = self._observed(observation, info)
        return observed, reward, terminated, truncated, told

    def _observed(self, observation: Any, info: dict[str, Any]) -> tuple[dict[str, Any], Any]:
        touches = {name: skin.feel(self.unwrapped.data) for name, skin in self._skins.items()}  # type: ignore[attr-defined]
        felt = {name: _images(touch) for name, touch in touches.items()}
        return {"robot": observation, **felt}, {**info, **touches}


def _space(skin: MujocoSkin) -> spaces.Dict:
    shape = skin.description.map.nodes_y, skin.description.map.nodes_x
    curve = described_curve(skin.description)
    top_kpa = np.inf if curve is None else float(curve.range_kpa[1])
    return spaces.Dict(
        {
            "pressure_kpa": spaces.Box(0.0, top_kpa, shape, np.float32),
            "is_known": spaces.MultiBinary(shape),
            "structure": spaces.Box(0.0, 1.0, shape, np.float32),
        }
    )


def _images(touch: Touch) -> dict[str, Any]:
    frame, shape = touch.frame, touch.truth_kpa.shape
    pressure = np.full(shape, np.nan) if frame.pressure_kpa is None else frame.pressure_kpa
    structure = np.zeros(shape) if frame.structure is None else frame.structure
    return {
        "pressure_kpa": np.nan_to_num(pressure, nan=0.0).astype(np.float32),
        "is_known": np.isfinite(pressure).astype(np.int8),
        "structure": np.nan_to_num(structure).astype(np.float32),
    }
