"""Every command that reads files, on files that nobody means well with.

No traceback, no more than `MAX_MB` of memory and `MAX_CPU_S` of processor time, nothing written
over, no wait for a pipe, and nothing that steers the terminal.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pytest
from hostile_files import CORPUS
from tactomo_models import SkinSimulator, load_description

MAX_MB: Final = 300
MAX_CPU_S: Final = 20.0
HANG_S: Final = 60.0
COMMANDS: Final[dict[str, dict[str, tuple[str, ...]]]] = {
    "arrays": {
        "info": ("info", "FILE"),
        "info_json": ("info", "FILE", "--json"),
        "doctor": ("doctor", "FILE", "-d", "tank_disc"),
        "import": ("import", "FILE", "OUT.mcap", "-d", "tank_disc", "--rate", "20"),
        "reconstruct": ("reconstruct", "FILE", "OUT.npz", "-d", "tank_disc"),
        "reference": (
            "reconstruct",
            "GOOD.npz",
            "OUT.npz",
            "-d",
            "tank_disc",
            "--reference",
            "FILE",
        ),
        "presses": ("evaluate", "presses", "FILE", "--train", "10"),
        "load_cell": ("calibrate", "fit", "FILE", "--recording", "GOOD.npz"),
        "robot": ("export", "GOOD.mcap", "OUT", "--lerobot", "--robot", "FILE"),
    },
    "recording": {
        "info": ("info", "FILE"),
        "info_json": ("info", "FILE", "--json"),
        "doctor": ("doctor", "FILE"),
        "recover": ("recover", "FILE", "-o", "OUT.mcap"),
        "replay": ("replay", "FILE", "--speed", "max"),
        "export": ("export", "FILE", "OUT.csv"),
        "plot": ("plot", "FILE", "-o", "OUT.png"),
    },
    "description": {
        "info": ("info", "FILE"),
        "draw": ("models", "draw", "FILE", "-o", "OUT.svg"),
        "build": ("models", "build", "-d", "FILE", "-o", "OUT.npz"),
        "reconstruct": ("reconstruct", "GOOD.npz", "OUT.npz", "-d", "FILE"),
        "config": ("daemon", "FILE"),
    },
    "kept": {
        "info": ("info", "FILE"),
        "calibration": ("reconstruct", "GOOD.npz", "OUT.npz", "--calibration", "FILE"),
        "taught": ("reconstruct", "GOOD.npz", "OUT.npz", "--taught", "FILE"),
        "show": ("calibrate", "show", "FILE"),
    },
}
KINDS: Final = {".mcap": "recording", ".toml": "description", ".json": "kept"}
ENDS: Final = (".npz", ".mcap")
RATIONED: Final = """
import json, os, sys
to_stderr = [(os.POSIX_SPAWN_DUP2, 2, 1)]
pid = os.posix_spawn(sys.argv[1], sys.argv[1:], os.environ, file_actions=to_stderr)
_, status, used = os.wait4(pid, 0)
cpu_s = used.ru_utime + used.ru_stime
print(json.dumps([os.waitstatus_to_exitcode(status), used.ru_maxrss / 1024, cpu_s]))
"""  # a process of its own: what a program's parent held in memory counts as the program's


class Ended(NamedTuple):
    status: int
    peak_mb: float
    cpu_s: float
    said: str


def rationed(folder: Path, *arguments: str) -> Ended:
    """Run a command of tactomo's; return how it ended, and what it took."""
    program = str(Path(sys.executable).with_name("tactomo"))
    with subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", RATIONED, program, *arguments],
        env={**os.environ, "COLUMNS": "200"},
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    ) as process:
        try:
            told, said = process.communicate(timeout=HANG_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            raise AssertionError(f"{' '.join(arguments)} hangs") from None
    status, peak_mb, cpu_s = json.loads(told)
    return Ended(status, peak_mb, cpu_s, said.decode("utf-8", "replace"))


def write_good(folder: Path) -> None:
    """Write good.npz and good.mcap, scans with which nothing is the matter."""
    [volts] = SkinSimulator(load_description("tank_disc")).voltages([]).values()
    noise = 1e-4 * np.abs(volts).mean() * np.random.default_rng(0).normal(size=(6, len(volts)))
    arrays = folder / "good.npz"
    np.savez(arrays, structure=volts + noise, structure_reference=volts + noise)
    line = ("import", "good.npz", "good.mcap", "-d", "tank_disc", "--rate", "20")
    ended = rationed(folder, *line)
    assert ended.status == 0, ended.said


def held(folder: Path) -> dict[str, tuple[int, int, int]]:
    """What tells whether a file of a folder was touched."""
    facts = ((path, path.lstat()) for path in folder.rglob("*"))
    return {str(path): (f.st_size, f.st_mtime_ns, f.st_ino) for path, f in facts}


CASES: Final = [
    (name, command)
    for name in CORPUS
    for command in COMMANDS[KINDS.get(Path(name).suffix, "arrays")]
]


def read_by(command: str, path: Path, good: Path, folder: Path) -> Ended:
    """Let a command read a hostile file; AssertionError where it takes or does too much.

    `good` is the folder of `write_good`; `folder` is nobody else's.
    """
    out = folder / "out"
    out.mkdir(exist_ok=True)
    before = held(path.parent)
    line = COMMANDS[KINDS.get(path.suffix, "arrays")][command]
    places = {"FILE": str(path), **{f"GOOD{end}": str(good / f"good{end}") for end in ENDS}}
    ended = rationed(
        folder,
        *(places.get(word, str(out / word) if word.startswith("OUT") else word) for word in line),
    )
    assert "Traceback" not in ended.said, ended.said
    assert ended.status in (0, 1, 2), ended
    assert ended.peak_mb < MAX_MB, ended
    assert ended.cpu_s < MAX_CPU_S, ended
    assert held(path.parent) == before
    assert not re.search(
        "[\x00-\x08\x0b-\x1a\x1c-\x1f\x7f-\x9f\u202a-\u202e]|\x1b(?!\\[)", ended.said
    )
    assert "\x1b[2J" not in ended.said
    if path.name == "password.mcap":
        assert "root:" not in ended.said
    if path.name.startswith(("pipe.", "device.")):
        assert ended.status != 0
    return ended


QUICK: Final = {
    "info": ("boastful.npz", "crowd.eit", "markup.mcap", "marks.mcap", "pipe.csv"),
    "replay": ("piped.mcap",),
    "reconstruct": ("pipe.npz",),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of files with which nothing is the matter."""
    folder = tmp_path_factory.mktemp("good")
    write_good(folder)
    return folder


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
