"""Models that several tests share, solved once."""

from __future__ import annotations

from pathlib import Path

import pytest
from noisy_skin import Skin
from small_sensor import SMALL
from tactomo_models import (
    Artifact,
    Reconstructor,
    SensorDescription,
    SkinSimulator,
    build_artifact,
    load_description,
)
from tactomo_models.forward import ForwardModel


@pytest.fixture(scope="session")
def paper() -> SensorDescription:
    return load_description("paper_square")


@pytest.fixture(scope="session")
def artifact(paper: SensorDescription) -> Artifact:
    return build_artifact(paper)


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> SensorDescription:
    file = tmp_path_factory.mktemp("sensor") / "small.toml"
    file.write_text(SMALL)
    return load_description(file)


@pytest.fixture
def small_text() -> str:
    return SMALL


@pytest.fixture(scope="session")
def simulator(paper: SensorDescription) -> SkinSimulator:
    return SkinSimulator(paper, unevenness=0.03, impedance_spread=0.1, seed=11)


@pytest.fixture
def skin(simulator: SkinSimulator) -> Skin:
    return Skin(simulator)


@pytest.fixture
def reconstructor(paper: SensorDescription, artifact: Artifact, skin: Skin) -> Reconstructor:
    """Tared on the unpressed skin."""
    made = Reconstructor(paper, artifact)
    made.set_reference(skin.reference())
    return made


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)


@pytest.fixture
def solves(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Counts forward solves."""
    counted: list[int] = []
    solve = ForwardModel.solve

    def counting(self: ForwardModel, *arguments: object, **options: object) -> object:
        counted.append(1)
        return solve(self, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(ForwardModel, "solve", counting)
    return counted
