"""The viewer of a sensor `left` in a process of its own, as a program runs it."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import IO

PROGRAM = """
import json, sys, tactomo_viewer
port, addresses = json.loads(sys.argv[1])
tactomo_viewer.Viewer("left", **addresses).serve(port)
"""


def viewer_process(
    *, port: int = 0, stderr: int | IO[str] | None = None, **addresses: str
) -> subprocess.Popen[str]:
    """Start it; its first line on stdout has its URL. The addresses are those of `Viewer`."""
    arguments = json.dumps([port, addresses])
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, arguments],
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
    )
