"""Several skins of one robot: a daemon each, forked from a process that has loaded what they share.

Libraries and models are in memory once. A process each, because one process for all would have one
core (Python's lock) and one fate. To its daemons the parent is what systemd is to one: they notify
it that they are ready and get on, and one that ends or hangs is started again, with the times of
the unit `tactomo@.service`. They stop when the parent does, however it ends.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import structlog
from tactomo_models import load_description
from tactomo_models.methods.trained_networks import SensorNetworks

from tactomo.cli.children import stop_asked
from tactomo.config import DaemonConfig
from tactomo.ending import AS_WELL, ASKED, stop_at_end_of
from tactomo.errors import explain
from tactomo.log import configure_logging
from tactomo.service.daemon import Daemon, load_model
from tactomo.service.supervision import STATUS_PERIOD_S, notify

TURN_S: Final = 0.2
RESTART_S: Final = 2.0
WATCHDOG_S: Final = 10.0
STOP_S: Final = 8.0  # two seconds less than systemd gives the parent

log = structlog.get_logger()


@dataclass(eq=False)
class _Process:
    name: str
    run: Callable[[], int]
    notify_socket: socket.socket
    pid = 0
    status = "starting"
    is_ready = has_been_ready = is_aborted = is_done = False
    fed_s = ended_s = 0.0

    def hear(self) -> None:
        """Take note of what the daemon has notified."""
        for line in self.notify_socket.recv(4096).decode("utf-8", "replace").splitlines():
            key, _, value = line.partition("=")
            if key == "READY":
                self.is_ready = self.has_been_ready = True
            if key == "STATUS":
                self.status = value
            if key in ("READY", "WATCHDOG"):
                self.fed_s = time.monotonic()


class SkinProcesses:
    """The processes of several skins. Raises ModelError where a description is unusable."""

    def __init__(self, skins: Sequence[DaemonConfig]) -> None:
        self._skins = skins
        descriptions = {skin.description: load_description(skin.description) for skin in skins}
        self._artifacts = {name: load_model(each) for name, each in descriptions.items()}
        networks = [SensorNetworks(each) for each in descriptions.values()]
        self._networks = [each for each in networks if not each.missing]  # loaded by that

    def run(self) -> int:
        """Keep every skin's daemon running; return the exit status.

        0 if told to stop or every daemon has come to its end, 1 if none of them ever got ready.
        """
        stop = stop_asked()
        with contextlib.ExitStack() as undo:
            folder = Path(undo.enter_context(tempfile.TemporaryDirectory(prefix="tactomo-")))
            parent_pipe, self._parent_end = os.pipe()
            self._parent_pipe = parent_pipe
            processes = [self._daemon(skin, folder, undo) for skin in self._skins]
            gc.collect()
            gc.freeze()  # a collection in a child would copy every page that it looks through
            undo.callback(_stop, processes)
            for process in processes:
                self._start(process)
            return self._watch(processes, stop)

    def _watch(self, processes: list[_Process], stop: threading.Event) -> int:
        is_ready, told_s = False, 0.0
        sockets = {process.notify_socket: process for process in processes}
        while not stop.is_set():
            for notify_socket in select.select(list(sockets), [], [], TURN_S)[0]:
                sockets[notify_socket].hear()
            for process in processes:
                self._look_after(process)
            if all(each.is_done for each in processes):
                return 0
            if not any(each.pid or each.has_been_ready for each in processes):
                return 1
            if not is_ready and all(each.is_ready or not each.pid for each in processes):
                is_ready = True
                notify("READY=1")
                log.info("all_ready", skins=[each.name for each in processes])
            if time.monotonic() - told_s > STATUS_PERIOD_S:
                told_s = time.monotonic()
                status = "; ".join(f"{each.name} {each.status}" for each in processes)
                notify("WATCHDOG=1", f"STATUS={status}")
        notify("STOPPING=1", "STATUS=stopping")
        return 0

    def _look_after(self, process: _Process) -> None:
        """Start a process again that has ended, after a while; end one that hangs."""
        now_s = time.monotonic()
        if not process.pid:
            if not process.is_done and now_s - process.ended_s > RESTART_S:
                self._start(process)
            return
        pid, code = os.waitpid(process.pid, os.WNOHANG)
        if pid:
            process.pid, process.ended_s = 0, now_s
            status = os.waitstatus_to_exitcode(code)
            process.is_done = status == 0
            if not process.is_done:
                process.is_ready = False
                process.status = "ended, is started again"
                log.error(
                    "skin_ended",
                    sensor=process.name,
                    exit_status=status,
                    next_step="the lines above say why; "
                    f"the daemon starts again in {RESTART_S:g} s, unless no skin was ever ready",
                )
        elif process.is_ready and now_s - process.fed_s > WATCHDOG_S:
            log.error("skin_hangs", sensor=process.name, watchdog_s=WATCHDOG_S)
            # Its log then has where each thread was; what is stopped obeys SIGKILL alone.
            os.kill(process.pid, signal.SIGKILL if process.is_aborted else signal.SIGABRT)
            process.is_aborted, process.fed_s = True, now_s

    def _start(self, process: _Process) -> None:
        process.is_aborted, process.fed_s = False, time.monotonic()
        process.pid = os.fork()
        if process.pid:
            return
        status = 1
        try:
            for number in (*ASKED, *AS_WELL):
                if signal.getsignal(number) is not signal.SIG_IGN:
                    signal.signal(number, signal.SIG_DFL)
            os.close(self._parent_end)
            stop_at_end_of(self._parent_pipe)
            os.environ.pop("WATCHDOG_PID", None)
            os.environ["NOTIFY_SOCKET"] = process.notify_socket.getsockname()
            os.environ["WATCHDOG_USEC"] = str(round(WATCHDOG_S * 1e6))
            status = process.run()
        except Exception as error:
            words = explain(error)
            if words is None:
                log.exception("failed")
            else:
                log.error("failed", detail=words)
        finally:
            os._exit(status)

    def _daemon(self, skin: DaemonConfig, folder: Path, undo: contextlib.ExitStack) -> _Process:
        notify_socket = undo.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        notify_socket.bind(str(folder / skin.name))

        def run() -> int:
            configure_logging(skin.log_level, skin.log_format, skin.name)
            return Daemon(skin, artifact=self._artifacts[skin.description]).run()

        return _Process(skin.name, run, notify_socket)


def _stop(processes: list[_Process]) -> None:
    running = [process for process in processes if process.pid]
    for process in running:
        os.kill(process.pid, signal.SIGTERM)
    deadline_s = time.monotonic() + STOP_S
    while running:
        running = [each for each in running if not os.waitpid(each.pid, os.WNOHANG)[0]]
        if running and time.monotonic() > deadline_s:
            for process in running:
                os.kill(process.pid, signal.SIGKILL)
                os.waitpid(process.pid, 0)
            return
        time.sleep(0.01)
