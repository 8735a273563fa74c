"""Sets of training scenes: made on several cores, whole or not at all."""

from __future__ import annotations

import resource
import signal
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from fixture_types import Run
from tactomo_lab.training import training_scenes as module
from tactomo_lab.training.training_scenes import read_scenes, simulate
from tactomo_models import DataError, ModelError, SensorDescription, load_description
from variants import variant

TOGETHER = 4
SCENES = 10


@pytest.fixture(scope="module")
def whole(small: SensorDescription, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "scenes"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "TOGETHER", TOGETHER)
        assert list(simulate(small, folder, SCENES, jobs=1)) == [4, 4, 2]
    return folder


@pytest.mark.slow
def test_a_set_is_the_same_on_any_number_of_cores(
    small: SensorDescription, whole: Path, tmp_path: Path
) -> None:
    assert sum(simulate(small, tmp_path / "two", SCENES, jobs=2)) == SCENES
    first, second = read_scenes(whole, small), read_scenes(tmp_path / "two", small)
    assert first.keys() == second.keys()
    for key, array in first.items():
        np.testing.assert_array_equal(array, second[key])
    assert first["magnitude_change"].shape == (SCENES, small.measurements)
    assert first["map"].shape == first["pressed"].shape == (SCENES, 21, 21)


def test_flipped_bits_are_found(small: SensorDescription, whole: Path, tmp_path: Path) -> None:
    content = bytearray((whole / "scenes.npz").read_bytes())
    for place in range(len(content) // 2, len(content) // 2 + 64):
        content[place] ^= 1
    (tmp_path / "scenes.npz").write_bytes(content)
    with pytest.raises(ModelError, match=r"damaged.*simulate anew"):
        read_scenes(tmp_path, small)


def test_scenes_are_never_written_over(small: SensorDescription, whole: Path) -> None:
    with pytest.raises(ModelError, match="is there already: choose another folder, or delete it"):
        list(simulate(small, whole, SCENES, jobs=1))


def test_scenes_of_another_sensor_or_none_are_refused(
    small: SensorDescription, whole: Path, tmp_path: Path
) -> None:
    other = variant(small, sheet={"conductivity_s_m": 2.0})
    with pytest.raises(ModelError, match=r"sensor \w+; the network needs .*name another folder"):
        read_scenes(whole, other)
    with pytest.raises(ModelError, match="holds no simulated scenes; make some"):
        read_scenes(tmp_path, small)


def test_a_sensor_without_a_magnitude_channel_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="has no magnitude channel"):
        list(simulate(load_description("tank_disc"), tmp_path / "new", SCENES))
    assert not (tmp_path / "new").exists()


def test_a_folder_that_cannot_be_written_is_told(small: SensorDescription, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ModelError, match=r"cannot write .*: Not a directory; choose another"):
        list(simulate(small, tmp_path / "file" / "scenes", SCENES, jobs=1))


@contextmanager
def full_disk() -> Iterator[None]:
    """No file may be longer than this, of whoever writes in here."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_a_full_disk_is_told_and_leaves_nothing(small: SensorDescription, tmp_path: Path) -> None:
    with (
        pytest.raises(ModelError, match=r"cannot write .*npz: File too large; free some space"),
        full_disk(),
    ):
        list(simulate(small, tmp_path, 1, jobs=1))
    assert list(tmp_path.iterdir()) == []


def test_a_killed_process_is_told(
    small: SensorDescription, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: object) -> None:
        raise BrokenProcessPool

    monkeypatch.setattr(module, "simulate_some", killed)
    with pytest.raises(ModelError, match=r"was killed.*with fewer jobs"):
        list(simulate(small, tmp_path, 1, jobs=1))


def test_the_command(tactomo: Run, small_file: Path, small: SensorDescription) -> None:
    command = ("models", "simulate", "scenes", "--description", small_file, "--jobs", 1)
    assert tactomo(*command, "--scenes", 2, status=0).stdout == "scenes: 2 scenes\n"
    assert len(read_scenes(Path("scenes"), small)["map"]) == 2
    one = tactomo("models", "simulate", "others", "--description", "tank_disc", status=1)
    assert one.stderr.startswith("tactomo: sensor 'tank_disc' has no magnitude channel")
    assert tactomo("models", "simulate", "others", "--scenes", 0).returncode == 2
