"""Somebody who does what a page says: its commands, one after another, from an empty folder.

Programs that keep running are left to run, as in a terminal of their own, on addresses that nobody
else has; what is asked later is asked of them.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from whole_system import ANYWHERE, PATIENCE_S, repository

KEEP_RUNNING = ("demo", "twin", "daemon")


class Page:
    """A page of the documentation: its commands by section, and the files that it tells to save."""

    def __init__(self, name: str) -> None:
        self.text = (repository() / "docs" / name).read_text("utf-8")

    def commands(self, number: int) -> list[str]:
        """Return the commands of a numbered section, in order."""
        section = re.search(rf"^## {number} .*?(?=^## |\Z)", self.text, re.M | re.S)
        assert section, f"there is no section {number}"
        blocks = re.findall(r"^```sh\n(.*?)^```", section[0], re.M | re.S)
        return [line for block in blocks for line in block.splitlines() if line]

    def file(self, name: str) -> str:
        """Return the contents of the file that is to be saved under this name."""
        found = re.search(rf"`{re.escape(name)}`:\n\n```\w+\n(.*?)^```", self.text, re.M | re.S)
        assert found, f"{name} is not told to be saved"
        return found[1]


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
        self._running: dict[str, subprocess.Popen[str]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
        program, name, *rest = shlex.split(command)
        assert program == "tactomo"
        line = [sys.executable, "-m", "tactomo.cli", name, *rest, *self._at(name)]
        if name in KEEP_RUNNING:
            return self._start(name, line)
        done = subprocess.run(
            line, cwd=self.folder, capture_output=True, text=True, timeout=300, check=False
        )
        assert done.returncode == 0, f"{command}: {done.stderr}"
        return done.stdout + done.stderr

    def stop(self) -> None:
        """Ctrl-C in every terminal."""
        for running in reversed(self._running.values()):
            running.send_signal(signal.SIGINT)
            running.wait(PATIENCE_S)
            if running.stdout is not None:
                running.stdout.close()
        self._running.clear()

    def _at(self, name: str) -> list[str]:
        """Options by which a program finds, or is given, free addresses."""
        stream = ["--stream", self.addresses.get("stream", "")]
        control = ["--control", self.addresses.get("control", "")]
        here = {
            "demo": [
                *("--stream", ANYWHERE, "--control", ANYWHERE, "--twin-control", ANYWHERE),
                *("--port", "0", "--no-browser", "--announce"),
            ],
            "twin": ["--control", ANYWHERE, "--announce"],
            "daemon": ["--stream", ANYWHERE, "--control", ANYWHERE],
            "poke": ["--control", self.addresses.get("twin", "")],
            **dict.fromkeys(("watch", "doctor"), stream),
            **dict.fromkeys(("status", "tare", "record", "tier"), control),
        }
        return here.get(name, [])

    def _start(self, name: str, line: list[str]) -> str:
        if "/dev/ttyACM0" in line and self.addresses.get("ports"):
            line[line.index("/dev/ttyACM0")] = self.addresses["ports"][0]
        process = subprocess.Popen(
            line,
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        self._running[name] = process
        assert process.stdout is not None
        heard = ""
        for said in process.stdout:
            heard += said
            told = json.loads(said) if said.startswith("{") else {}
            if name == "daemon" and told.get("event") != "ready":
                continue
            if told:
                told = {"twin": told.pop("control"), **told} if name == "twin" else told
                self.addresses |= told
                return heard
        raise AssertionError(f"{name} ended: {heard}")

    def wait_for(self, command: str, words: str) -> str:
        """Repeat a command until it prints something; return all that it printed then."""
        deadline = time.monotonic() + PATIENCE_S
        while words not in (said := self.run(command)):
            assert time.monotonic() < deadline, f"{command}: no {words!r} in {said}"
            time.sleep(0.2)
        return said
