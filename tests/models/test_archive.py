"""Files that are whole or not there: what a killed writer leaves is swept away by the next."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tactomo_models.archive import write_whole

KILLED = """
import os, signal, sys
from pathlib import Path
from tactomo_models.archive import write_whole
write_whole(Path(sys.argv[1]), lambda file: os.kill(os.getpid(), signal.SIGKILL))
"""


@pytest.mark.slow
def test_what_a_killed_writer_left_goes_with_the_next_write(tmp_path: Path) -> None:
    path = tmp_path / "left[1].npz"
    subprocess.run([sys.executable, "-c", KILLED, path], check=False)
    (left,) = tmp_path.iterdir()
    assert left.name.endswith(".part")
    running = tmp_path / f".{path.name}.{os.getppid()}.part"  # of a process that still writes
    other = tmp_path / f".other.npz.{left.name.split('.')[-2]}.part"
    for each in (running, other):
        each.touch()
    write_whole(path, lambda file: file.write(b"whole"))
    assert path.read_bytes() == b"whole"
    assert sorted(tmp_path.iterdir()) == sorted([path, running, other])
