"""A real `tactomo daemon` in a process of its own, and what the kernel says of that process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tactomo_client import ControlError, request
from waiting import PATIENCE_S, wait_until

SENSOR = "skin"
ANYWHERE = "tcp://127.0.0.1:0"
SUPPORT = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


class DaemonProcess:
    """Starts `tactomo daemon` on `ports` and waits until it is ready.

    Args:
        folder: where its configuration and its log are kept.
        ports: what it reads.
        program: Python source that runs a daemon of another make, given the configuration's path
            as its argument, and able to import from this folder; None for the command that users
            start.
        environment: what its environment has beyond this one's.
        ready: wait until it is ready.
        under: the command that it is run under, such as ("nice", "-n", "-5").
        **config: keys of its configuration.

    """

    def __init__(
        self,
        folder: Path,
        ports: Sequence[str],
        *,
        program: str | None = None,
        environment: Mapping[str, str] | None = None,
        ready: bool = True,
        under: Sequence[str] = (),
        **config: Any,
    ) -> None:
        number = len(list(folder.glob("daemon-*.toml")))
        settings = {"name": SENSOR, "ports": list(ports), "stream": ANYWHERE, "control": ANYWHERE}
        config["recording"] = {"folder": str(folder), **config.get("recording", {})}
        path = folder / f"daemon-{number}.toml"
        path.write_text("".join(f"{k} = {_toml(v)}\n" for k, v in {**settings, **config}.items()))
        self.log_path = folder / f"daemon-{number}.log"
        run = ["-m", "tactomo.cli", "daemon"] if program is None else ["-c", program]
        with self.log_path.open("wb") as log:
            self.popen = subprocess.Popen(
                [*under, sys.executable, *run, str(path)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONPATH": SUPPORT, **(environment or {})},
            )
        self.stream = self.control = ""
        if ready:
            try:
                self.wait_ready()
            except BaseException:
                self.kill()  # nobody else has it yet
                raise

    def wait_ready(self) -> None:
        """Wait until it serves, and take note of its addresses."""
        wait_until(lambda: self.told("ready") or not self.is_running, "a daemon that is ready")
        assert self.is_running, f"the daemon ended: {self._tail()}"
        ready = self.told("ready")[0]
        self.stream, self.control = ready["stream"], ready["control"]

    def log(self) -> list[dict[str, Any]]:
        """Return what it has logged."""
        lines = self.log_path.read_text("utf-8", "replace").splitlines()
        return [json.loads(line) for line in lines if line.startswith("{") and line.endswith("}")]

    def told(self, name: str) -> list[dict[str, Any]]:
        """Return the events of that name in its log."""
        return [event for event in self.log() if event.get("event") == name]

    def status(self) -> dict[str, Any]:
        """Ask for its status; again where it is too busy to answer at once."""
        return self.ask("status")

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Send a command and return its result."""
        return request(command, self.control, PATIENCE_S, **arguments)

    def answers(self, timeout_s: float = 2.0) -> bool:
        """Whether the control socket answers."""
        try:
            request("status", self.control, timeout_s)
        except ControlError:
            return False
        return True

    @property
    def is_running(self) -> bool:
        """Whether the process has not ended."""
        return self.popen.poll() is None

    @property
    def rss_mb(self) -> float:
        """Memory that it occupies at present, MB."""
        return int(self._proc("statm").split()[1]) * PAGE_BYTES / 1e6

    @property
    def threads(self) -> int:
        """How many threads it has."""
        return len(os.listdir(f"/proc/{self.popen.pid}/task"))

    @property
    def descriptors(self) -> int:
        """How many file descriptors it has open; not those that it borrows for microseconds."""
        return min(len(os.listdir(f"/proc/{self.popen.pid}/fd")) for _ in range(20))

    @property
    def cpu_s(self) -> float:
        """Processor time that it has used, user and system, seconds."""
        fields = self._proc("stat").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS_PER_S

    def knows_the_clocks(self) -> bool:
        """Whether it has fitted each device's clock: scans are dated by it from then on."""
        return all(port["clock"]["state"] == "settled" for port in self.status()["ports"])

    def signal(self, number: int) -> None:
        """Send a signal."""
        self.popen.send_signal(number)

    def stop(self) -> float:
        """Stop it as a service manager does, and return the seconds that it took."""
        begin_s = time.monotonic()
        self.signal(signal.SIGTERM)
        status = self.popen.wait(PATIENCE_S)
        took_s = time.monotonic() - begin_s
        assert status == 0, f"exit status {status}: {self._tail()}"
        return took_s

    def kill(self) -> None:
        """Kill it, whatever it does."""
        self.popen.kill()
        self.popen.wait()

    def _proc(self, name: str) -> str:
        return Path(f"/proc/{self.popen.pid}/{name}").read_text()

    def _tail(self) -> str:
        return self.log_path.read_text("utf-8", "replace")[-2000:]


def _toml(value: Any) -> str:
    if not isinstance(value, dict):
        return json.dumps(value)
    return "{" + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + "}"
