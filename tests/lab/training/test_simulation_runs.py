"""Sets of training scenes: made on several cores, broken off, gone on with, enlarged."""

from __future__ import annotations

import json
import os
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tactomo_lab.training import training_scenes as module
from tactomo_lab.training.training_scenes import read_scenes, simulate
from tactomo_models import DataError, ModelError, SensorDescription, load_description
from tactomo_models.archive import write_arrays
from variants import variant

pytestmark = pytest.mark.train
Run = Callable[..., Any]

SHARD = 4
SCENES = 10  # two shards and a half


@pytest.fixture(autouse=True)
def _small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SHARD", SHARD)


@pytest.fixture
def folder(small: SensorDescription, whole: Path, tmp_path: Path) -> Path:
    """A copy of a complete set."""
    copy = tmp_path / "scenes"
    copy.mkdir()
    for file in whole.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    return copy


@pytest.fixture(scope="module")
def whole(small: SensorDescription, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "SHARD", SHARD)
        assert list(simulate(small, folder, SCENES, jobs=1)) == [0, 4, 4, 2]
    return folder


def assert_same(one: Path, other: Path) -> None:
    first, second = read_scenes(one), read_scenes(other)
    assert first.keys() == second.keys()
    for key, array in first.items():
        np.testing.assert_array_equal(array, second[key])


def test_a_set_is_the_same_on_any_number_of_cores(
    small: SensorDescription, whole: Path, tmp_path: Path
) -> None:
    assert sum(simulate(small, tmp_path / "two", SCENES, jobs=2)) == SCENES
    assert_same(tmp_path / "two", whole)
    scenes = read_scenes(whole)
    assert scenes["magnitude_change"].shape == (SCENES, small.measurements)
    assert scenes["map"].shape == scenes["pressed"].shape == (SCENES, 21, 21)


def test_what_is_missing_or_damaged_is_made_anew_and_nothing_else(
    small: SensorDescription, folder: Path, whole: Path
) -> None:
    gone, cut, kept = (folder / f"scenes-{first:07d}.npz" for first in (0, 4, 8))
    gone.unlink()
    cut.write_bytes(cut.read_bytes()[:-100])
    (folder / ".scenes-0000000.npz.123.part").write_bytes(b"half of it")
    before = kept.stat().st_mtime_ns
    assert list(simulate(small, folder, SCENES, jobs=1)) == [2, 4, 4]
    assert kept.stat().st_mtime_ns == before
    assert_same(folder, whole)
    assert list(simulate(small, folder, SCENES, jobs=1)) == [SCENES]


def test_flipped_bits_are_found(small: SensorDescription, folder: Path, whole: Path) -> None:
    file = folder / "scenes-0000004.npz"
    content = bytearray(file.read_bytes())
    for place in range(len(content) // 2, len(content) // 2 + 64):
        content[place] ^= 1
    file.write_bytes(content)
    with pytest.raises(ModelError, match=r"damaged.*makes damaged files anew"):
        read_scenes(folder)
    assert list(simulate(small, folder, SCENES, jobs=1)) == [6, 4]
    assert_same(folder, whole)


def test_a_set_grows_and_shrinks(small: SensorDescription, folder: Path, whole: Path) -> None:
    """Scenes that are there stay: those of the last, half full shard are made again."""
    assert list(simulate(small, folder, 12, jobs=1)) == [8, 4]
    assert len(read_scenes(folder)["map"]) == 12
    assert list(simulate(small, folder, 6, jobs=1)) == [6]
    assert len(read_scenes(folder)["map"]) == 6
    assert list(simulate(small, folder, SCENES, jobs=1)) == [SCENES]
    assert_same(folder, whole)


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("seed", {"seed": 1}),
        ("sha256", {"description": {"sheet": {"conductivity_s_m": 2.0}}}),
        ("responses", {"description": {"structure": {"conductivity_ratio": 50.0}}}),
    ],
)
def test_another_set_in_the_folder_is_refused(
    small: SensorDescription, folder: Path, whole: Path, what: str, change: dict[str, Any]
) -> None:
    description = variant(small, **change.get("description", {}))
    steps = simulate(description, folder, SCENES, seed=change.get("seed", 0), jobs=1)
    with pytest.raises(ModelError, match=rf"another {what}, .*choose another folder, or delete"):
        list(steps)
    assert_same(folder, whole)


def test_a_damaged_manifest_is_told(small: SensorDescription, folder: Path) -> None:
    (folder / "manifest.json").write_text('{"format": 1, "pre')
    with pytest.raises(ModelError, match=r"manifest\.json is damaged .*delete the folder"):
        list(simulate(small, folder, SCENES, jobs=1))


def test_a_set_that_is_not_complete_is_not_read(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="holds no simulated scenes; make some"):
        read_scenes(tmp_path / "nowhere")
    (folder / "scenes-0000008.npz").unlink()
    with pytest.raises(ModelError, match=r"not complete, scenes-0000008\.npz is missing"):
        read_scenes(folder)


def test_a_sensor_without_a_magnitude_channel_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="has no magnitude channel"):
        list(simulate(load_description("tank_disc"), tmp_path / "new", SCENES))
    assert not (tmp_path / "new").exists()


def test_a_folder_that_cannot_be_written_is_told(small: SensorDescription, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ModelError, match=r"cannot write .*: Not a directory; free some space"):
        list(simulate(small, tmp_path / "file" / "scenes", SCENES, jobs=1))


@contextmanager
def full_disk() -> Iterator[None]:
    """No file may be longer than the manifest, of whoever writes in here."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_a_full_disk_is_told_and_leaves_no_half_shard(
    small: SensorDescription, tmp_path: Path
) -> None:
    with (
        pytest.raises(ModelError, match=r"cannot write .*npz: File too large; free some space"),
        full_disk(),
    ):
        list(simulate(small, tmp_path, SCENES, jobs=1))
    assert [file.name for file in tmp_path.iterdir()] == ["manifest.json"]


def test_a_killed_process_is_told(
    small: SensorDescription, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    monkeypatch.setattr(module, "simulate_shard", killed)
    with pytest.raises(ModelError, match=r"was killed.*with fewer jobs"):
        list(simulate(small, tmp_path, SCENES, jobs=2))


class TestCommand:
    def test_it_simulates_and_goes_on(
        self, tactomo: Run, small_file: Path, whole: Path, tmp_path: Path
    ) -> None:
        command = ("models", "simulate", "scenes", "--description", small_file, "--jobs", 1)
        part = tactomo(*command, "--scenes", 4, "--json")
        assert json.loads(part.stdout) == {
            "folder": "scenes",
            "seed": 0,
            "sensor": "small",
            "scenes": 4,
            "new": 4,
        }
        rest = tactomo(*command, "--scenes", SCENES)
        assert (rest.returncode, rest.stdout) == (0, "scenes: 10 scenes, 6 of them new\n")
        assert_same(tmp_path / "scenes", whole)

    def test_ctrl_c_leaves_whole_shards_and_says_how_to_go_on(
        self, tactomo: Run, small_file: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        written: list[Path] = []

        def write_one(path: Path, arrays: dict[str, Any]) -> None:
            if written:
                raise KeyboardInterrupt
            written.append(path)
            write_arrays(path, arrays)

        monkeypatch.setattr(module, "write_arrays", write_one)
        command = ("models", "simulate", "scenes", "--scenes", SCENES, "--description", small_file)
        result = tactomo(*command, "--jobs", 1)
        assert result.returncode == 130
        assert "has 4 of 10 scenes; run the same command again, it goes on" in result.stderr
        assert len(list((tmp_path / "scenes").glob("*.npz"))) == 1

    def test_errors_are_told_without_a_traceback(self, tactomo: Run, small_file: Path) -> None:
        one = tactomo("models", "simulate", "scenes", "--description", "tank_disc")
        assert one.returncode == 1
        assert one.stderr.startswith("tactomo: sensor 'tank_disc' has no magnitude channel")
        assert tactomo("models", "simulate", "scenes", "--scenes", 0).returncode == 2
