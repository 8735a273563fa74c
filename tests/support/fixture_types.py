"""Types of the fixtures that many tests take, named after what these do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from daemon_process import DaemonProcess
from ears import Ears
from pty_skin import Playing

Start = Callable[..., Any]  #: `bench`, `replay`: a daemon of this process
StartProcess = Callable[..., DaemonProcess]  #: `start`, `tared`: one in a process of its own
Run = Callable[..., Any]  #: `tactomo`: a command
Play = Callable[..., Playing]
Listen = Callable[..., Ears]
Figure = Callable[[str], None]
