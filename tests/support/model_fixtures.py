"""Fixtures for models that many tests share, built once for each worker: a plugin of pytest."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from noisy_skin import Skin
from small_sensor import SMALL
from tactomo_models import (
    Artifact,
    Reconstructor,
    Reference,
    SensorDescription,
    SkinSimulator,
    load_description,
    load_or_build_artifact,
)
from tactomo_models.physics.bare_sheet import solve_bare_sheet
from tactomo_models.physics.compiled_sheet import CompiledSheet
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.mesh import SheetMesh, mesh_sheet
from tactomo_models.scene.areas import AreaFinder, Areas

Tared = Callable[..., Reconstructor]
ONCE: dict[str, Callable[..., Any]] = {
    "tactomo_models.simulation.simulator.mesh_sheet": mesh_sheet,
    "tactomo_models.simulation.simulator.solve_bare_sheet": solve_bare_sheet,
    "tactomo_models.methods.method.load_or_build_artifact": load_or_build_artifact,
}
"""What takes a good part of a second, by where it is called from, and gives equal for equal."""


def remembering(function: Callable[..., Any], most: int = 5) -> Callable[..., Any]:
    """The same function, which gives what it gave the last time that it was given the same."""
    made: dict[object, tuple[object, Any]] = {}

    def told(value: object) -> object:
        if isinstance(value, SensorDescription):
            return value.model_dump_json()
        if isinstance(value, np.ndarray):
            return value.tobytes()
        return id(value) if isinstance(value, SheetMesh) else value

    @wraps(function)
    def once(*given: Any, **options: Any) -> Any:
        key = (os.environ.get("XDG_CACHE_HOME"), *map(told, (*given, *options.items())))
        if key not in made:
            made[key] = given, function(*given, **options)  # a mesh is itself while it lives
            if len(made) > most:
                del made[next(iter(made))]
        return made[key][1]

    return once


@pytest.fixture(scope="session", autouse=True)
def _solved_once() -> Iterator[None]:
    """A worker's simulators of equal sheets share the sheet, and its reconstructors the model."""
    with pytest.MonkeyPatch.context() as patch:
        for place, function in ONCE.items():
            patch.setattr(place, remembering(function))
        yield


@pytest.fixture(scope="session")
def paper() -> SensorDescription:
    return load_description("paper_square")


@pytest.fixture(scope="session")
def artifact(paper: SensorDescription) -> Artifact:
    return load_or_build_artifact(paper)


@pytest.fixture(scope="session")
def small_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A description file of a sheet that solves in a blink."""
    file = tmp_path_factory.mktemp("sensor") / "small.toml"
    file.write_text(SMALL)
    return file


@pytest.fixture(scope="session")
def small(small_file: Path) -> SensorDescription:
    return load_description(small_file)


@pytest.fixture(scope="session")
def forward(small: SensorDescription) -> ForwardModel:
    """The small sheet on a coarse mesh."""
    return ForwardModel(small, solve_bare_sheet(small, mesh_sheet(small, refinements=1)))


@pytest.fixture(scope="session")
def two_areas(forward: ForwardModel) -> Areas:
    """What is pressed in two places of the small sheet."""
    x, y = forward.bare.points[:, forward.bare.pressable]
    nearest = np.minimum(np.hypot(x + 0.012, y + 0.006), np.hypot(x - 0.014, y - 0.006))
    pressed = np.clip(2 - nearest / 0.004, 0, 1)
    finder = AreaFinder(forward)
    areas = finder.find(finder.on_map(pressed), pressed)
    assert len(areas) == 2
    return areas


@pytest.fixture(scope="session")
def simulator(paper: SensorDescription) -> SkinSimulator:
    return SkinSimulator(paper, unevenness=0.03, impedance_spread=0.1, seed=11)


@pytest.fixture
def skin(simulator: SkinSimulator) -> Skin:
    return Skin(simulator)


@pytest.fixture
def tared(paper: SensorDescription, artifact: Artifact, skin: Skin) -> Tared:
    """Make a reconstructor of the paper's sensor: ``tared(on=skin, method="network")``."""

    def make(reference: Reference | None = None, *, on: Skin = skin, **how: Any) -> Reconstructor:
        made = Reconstructor(paper, artifact, **how)
        made.set_reference(on.reference() if reference is None else reference)
        return made

    return make


@pytest.fixture
def reconstructor(tared: Tared) -> Reconstructor:
    """Tared on the unpressed skin."""
    return tared()


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder in place of the one where models are kept that tests share."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    return folder


@pytest.fixture
def solves(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Counts forward solves."""
    counted: list[int] = []
    solve = CompiledSheet._solve

    def counting(self: CompiledSheet, *arguments: object, **options: object) -> object:
        counted.append(1)
        return solve(self, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(CompiledSheet, "_solve", counting)
    return counted
