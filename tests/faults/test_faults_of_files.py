"""What files from elsewhere do to the commands that read them."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hostile_commands import CASES, MAX_CPU_S, MAX_MB, Ended, read_by, write_good
from hostile_files import CORPUS


@pytest.mark.faults
@pytest.mark.timeout(3600)
@pytest.mark.fault(
    "Hostile files, read by every command that reads files",
    f"no traceback, at most {MAX_MB} MB and {MAX_CPU_S:g} s of processor time, nothing written "
    "over, no pipe or device waited for, no terminal steered",
    "packed zeros, false headers and marks, millions of records, deep nesting, pipes, devices, "
    "links to passwords, names with terminal commands; a process for each command",
)
def test_hostile_files(tmp_path: Path, figure: Callable[[str], None], scale: float) -> None:
    tried = CASES[:: max(1, round(1 / scale))]
    good = tmp_path / "good"
    good.mkdir()
    write_good(good)
    places: dict[str, Path] = {}
    for number, name in enumerate(dict.fromkeys(name for name, _ in tried)):
        places[name] = tmp_path / f"of {number}" / name
        places[name].parent.mkdir(parents=True)  # a name may hold a slash
        CORPUS[name](places[name])

    def read(number: int) -> Ended:
        name, command = tried[number]
        folder = tmp_path / str(number)
        folder.mkdir()
        return read_by(command, places[name], good, folder)

    with ThreadPoolExecutor(os.cpu_count()) as readers:
        ended = list(readers.map(read, range(len(tried))))
    most_mb, most_s = max(each.peak_mb for each in ended), max(each.cpu_s for each in ended)
    figure(f"{len(tried)} readings; at most {most_mb:.0f} MB and {most_s:.1f} s of processor time")
