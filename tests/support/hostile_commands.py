"""Every command that reads files, and what one may take on a file that nobody means well with."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
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
        "ktc": ("evaluate", "ktc", "FILE"),
        "measured": ("evaluate", "measured", "FILE"),
        "model": ("models", "import", "FILE", "OUT.toml"),
        "teach": ("teach", "fit", "FILE", "-d", "tank_disc", "-o", "OUT.npz"),
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
    "drawing": {"info": ("info", "FILE"), "model": ("models", "import", "FILE", "OUT.toml")},
    "kept": {
        "info": ("info", "FILE"),
        "calibration": ("reconstruct", "GOOD.npz", "OUT.npz", "--calibration", "FILE"),
        "taught": ("reconstruct", "GOOD.npz", "OUT.npz", "--taught", "FILE"),
        "show": ("calibrate", "show", "FILE"),
    },
}
KINDS: Final = {
    ".mcap": "recording",
    ".toml": "description",
    ".json": "kept",
    ".svg": "drawing",
    ".dxf": "drawing",
}
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

    `good` is a folder, which `write_good` fills for the first command that reads one of its files;
    `folder` is nobody else's.
    """
    out = folder / "out"
    out.mkdir(exist_ok=True)
    before = held(path.parent)
    line = COMMANDS[KINDS.get(path.suffix, "arrays")][command]
    if any(word.startswith("GOOD") for word in line) and not any(good.iterdir()):
        write_good(good)
    places = {"FILE": str(path), **{f"GOOD{end}": str(good / f"good{end}") for end in ENDS}}
    ended = rationed(
        folder,
        *(places.get(word, str(out / word) if word.startswith("OUT") else word) for word in line),
    )
    assert "Traceback" not in ended.said, ended.said
    assert "Warning" not in ended.said, ended.said
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
