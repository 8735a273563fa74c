"""Somebody who does what a page says: its commands, one after another, from an empty folder.

Programs that keep running are left to run, as in a terminal of their own, on addresses that nobody
else has; what is asked later is asked of them.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from waiting import PATIENCE_S, wait_until
from whole_system import ANYWHERE

KEEP_RUNNING = ("demo", "twin", "daemon", "foxglove", "viewer")


class Newcomer:
    """Runs commands in a folder; a context, at whose end all that still runs is stopped.

    Args:
        folder: where; empty.
        instead: what is put into a command in place of other words, to take less time.
    """

    def __init__(self, folder: Path, instead: Mapping[str, str] | None = None) -> None:
        self.folder = folder
        self.addresses: dict[str, Any] = {}
        self._instead = dict(instead or {})
        there = folder / ".run"  # where its programs find each other, and nobody else's
        there.mkdir(exist_ok=True)
        self._environment = os.environ | {"PYTHONUNBUFFERED": "1", "XDG_RUNTIME_DIR": str(there)}
        self._running: dict[str, subprocess.Popen[str]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def follow(self, commands: list[str]) -> list[str]:
        """Run commands, and return what each has printed."""
        return [self.run(command) for command in commands]

    def run(self, command: str) -> str:
        """Run one command; one that keeps running until it is ready.

        Raises:
            AssertionError: it failed.
        """
        for words, others in self._instead.items():
            command = command.replace(words, others)
        for number, port in enumerate(self.addresses.get("ports", ())):
            command = command.replace(f"/dev/ttyACM{number}", port)
        program, name, *rest = shlex.split(command)
        assert program == "tactomo"
        script = Path(sys.executable).with_name("tactomo")  # does not search the working folder
        line = [str(script), name, *rest, *self._at(name)]
        if name in KEEP_RUNNING:
            return self._start(name, line)
        return self._finish(line)

    def python(self, program: str) -> str:
        """Run a program in Python there, and return what it has printed."""
        return self._finish([sys.executable, "-c", program])

    def stop(self) -> None:
        """Ctrl-C in every terminal, with which all is well."""
        for name, running in reversed(self._running.items()):
            with running:  # closes its output
                running.send_signal(signal.SIGINT)
                assert running.wait(PATIENCE_S) == 0, name
        self._running.clear()

    def _finish(self, line: list[str]) -> str:
        done = subprocess.run(
            line,
            cwd=self.folder,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=900,
            check=False,
        )
        assert done.returncode == 0, f"{shlex.join(line)}: {done.stdout}{done.stderr}"
        return done.stdout + done.stderr

    def _at(self, name: str) -> list[str]:
        """Options by which a program serves at free addresses; others find it there."""
        served = ["--stream", ANYWHERE, "--control", ANYWHERE]
        twin = ["--twin-control", ANYWHERE, "--announce"]
        here = {
            "demo": [*served, *twin, "--no-browser", "--viewer-port", "0"],
            "twin": twin,
            "foxglove": ["--foxglove-port", "0", "--announce"],
            "viewer": ["--viewer-port", "0"],
            **dict.fromkeys(("daemon", "replay"), served),
        }
        return here.get(name, [])

    def _start(self, name: str, line: list[str]) -> str:
        process = subprocess.Popen(
            line,
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=self._environment,
        )
        self._running[name] = process
        assert process.stdout is not None
        heard = ""
        for said in process.stdout:
            heard += said
            told = json.loads(said) if said.startswith("{") else {}
            if said.startswith("viewer: "):
                told = {"url": said.removeprefix("viewer: ").strip()}
            if name == "daemon" and told.get("event") != "ready":
                continue
            if told:
                if name == "twin":
                    told["twin"] = told.pop("control")
                self.addresses |= told
                return heard
        raise AssertionError(f"{name} ended: {heard}")

    def wait_for(self, command: str, words: str) -> str:
        """Repeat a command until it prints something; return all that it printed then."""
        told: list[str] = []
        wait_until(
            lambda: words in told[-1],
            f"{words!r} of: {command}",
            meanwhile=lambda: told.append(self.run(command)),
        )
        return told[-1]
