"""Every command that reads files, on files that nobody means well with.

No traceback, no more than `MAX_MB` of memory and `MAX_CPU_S` of processor time, nothing written
over, no wait for a pipe, and nothing that steers the terminal.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from hostile_commands import CASES, rationed, read_by
from hostile_files import CORPUS
from tactomo_models import SkinSimulator, load_description

QUICK: Final = {
    "info": ("boastful.npz", "marks.mcap"),
    "model": ("beyond.svg",),
    "replay": ("piped.mcap",),
    "reconstruct": ("pipe.npz",),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder for files with which nothing is the matter."""
    return tmp_path_factory.mktemp("good")


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Returns the path of a hostile file, which is made when it is first asked for."""

    @cache
    def make(name: str) -> Path:
        path = tmp_path_factory.mktemp("hostile") / name
        path.parent.mkdir(exist_ok=True)
        CORPUS[name](path)
        return path

    return make


@pytest.mark.parametrize(
    ("name", "command"),
    [
        pytest.param(
            name,
            command,
            id=f"{command}-{name!a}",
            marks=() if name in QUICK.get(command, ()) else (pytest.mark.slow,),
        )
        for name, command in CASES
    ],
)
def test_a_hostile_file_costs_little_and_ends_nothing(
    name: str, command: str, good: Path, corpus: Callable[[str], Path], tmp_path: Path
) -> None:
    read_by(command, corpus(name), good, tmp_path)


@pytest.mark.slow
def test_frames_cost_memory_one_at_a_time(tmp_path: Path) -> None:
    """Of ten times the frames, the scans themselves alone: 3.3 kB each, and no maps of 31 kB."""
    skin = SkinSimulator(load_description("paper_square")).voltages([])
    noise = np.random.default_rng(0)
    peaks_mb = []
    for frames in (400, 4000):
        volts = {
            str(name): rest * (1 + 1e-4 * noise.normal(size=(frames, len(rest))))
            for name, rest in skin.items()
        }
        rest = {f"{name}_reference": each[:20] for name, each in volts.items()}
        np.savez(tmp_path / f"{frames}.npz", allow_pickle=False, **volts, **rest)
        ended = rationed(
            tmp_path, "reconstruct", f"{frames}.npz", "maps.npz", "--method", "tikhonov", "--force"
        )
        assert ended.status == 0, ended.said
        peaks_mb.append(ended.peak_mb)
    with np.load(tmp_path / "maps.npz") as made:
        assert made["map"].shape == (4000, 51, 51)
    assert peaks_mb[1] - peaks_mb[0] < 40, peaks_mb


@pytest.mark.slow
def test_an_import_holds_the_scans_once(tmp_path: Path) -> None:
    """Of fifty times the frames, the scans alone: 1.7 kB each, and no copies of all of them."""
    [rest] = SkinSimulator(load_description("tank_disc")).voltages([]).values()
    noise = np.random.default_rng(0)
    peaks_mb = []
    for frames in (400, 20_000):
        volts = rest * (1 + 1e-4 * noise.normal(size=(frames, len(rest))))
        np.savez(tmp_path / f"{frames}.npz", structure=volts)
        line = (f"{frames}.npz", f"{frames}.mcap", "-d", "tank_disc", "--rate", "20")
        ended = rationed(tmp_path, "import", *line)
        assert ended.status == 0, ended.said
        peaks_mb.append(ended.peak_mb)
    assert peaks_mb[1] - peaks_mb[0] < 1.5 * 33, peaks_mb
