"""What files from elsewhere do to the commands that read them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hostile_commands import CASES, MAX_CPU_S, MAX_MB, read_by, write_good
from hostile_files import CORPUS


@pytest.mark.faults
@pytest.mark.fault(
    "Hostile files, read by every command that reads files",
    f"no traceback, at most {MAX_MB} MB and {MAX_CPU_S:g} s of processor time, nothing written "
    "over, no pipe or device waited for, no terminal steered",
    "packed zeros, false headers and marks, millions of records, deep nesting, pipes, devices, "
    "links to passwords, names with terminal commands; a process for each command",
)
def test_hostile_files(tmp_path: Path, figure: Callable[[str], None], scale: float) -> None:
    good, most_mb, most_s = tmp_path / "good.npz", 0.0, 0.0
    write_good(good)
    tried = CASES[:: max(1, round(1 / scale))]
    for number, (name, command) in enumerate(tried):
        path = tmp_path / str(number) / name
        path.parent.mkdir(parents=True)
        CORPUS[name](path)
        ended = read_by(command, path, good, tmp_path)
        most_mb, most_s = max(most_mb, ended.peak_mb), max(most_s, ended.cpu_s)
    figure(f"{len(tried)} readings; at most {most_mb:.0f} MB and {most_s:.1f} s of processor time")
