"""Models that several tests share, solved once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from noisy_skin import Skin
from tactomo_models import (
    Artifact,
    Reconstructor,
    SensorDescription,
    SkinSimulator,
    build_artifact,
    load_description,
)
from threadpoolctl import threadpool_limits

settings.register_profile("models", deadline=None)  # nothing here depends on the wall clock
settings.load_profile("models")

# A small sheet that solves in a blink, for what does not depend on the paper's sensor.
SMALL = """
schema = 1
name = "small"
[sheet]
shape = "rectangle"
width_m = 0.06
height_m = 0.05
conductivity_s_m = 1.0
thickness_m = 1e-4
[electrodes]
per_side = 2
length_m = 0.006
pitch_m = 0.02
contact_impedance_ohm_m = 10.0
[pattern]
current_a = 1e-4
[map]
nodes_x = 21
nodes_y = 21
[magnitude.response]
pressure_kpa = [0.0, 100.0, 200.0]
relative_change = [0.0, 0.0, 0.25]
[structure]
conductivity_ratio = 100.0
"""


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


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> Iterator[None]:
    """As the daemon runs; more threads only get into each other's way on a busy machine."""
    with threadpool_limits(1):
        yield


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
