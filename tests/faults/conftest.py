"""Faults against the real daemon process, and the page that says how it stood them.

A test is a row of the page: its marker `fault` (or `measure`) says what is done, what is promised
and how it was tried; what it finds it tells the fixture `figure`. `make faults` runs all of them
with `--reliability docs/reliability.md`, which is then written whole from what ran, or, when `-k`
chose a part of them, in its rows.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_process import DaemonProcess
from ears import Ears
from pty_skin import Playing, PtySkin, Scenes, Volts, still
from reliability import FIGURE, Row, replace_rows, row_of, write_page
from tactomo_models import SensorDescription, load_description, load_or_build_artifact
from waiting import wait_until

ROWS = pytest.StashKey[list[Row]]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[ROWS] = []


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    row = row_of(item, report)
    if row is not None:
        item.config.stash[ROWS].append(row)
        if item.config.getoption("reliability"):
            print(f"\n  {row.fault}: {row.figure}", file=sys.__stderr__, flush=True)
    return report


def pytest_sessionfinish(session: pytest.Session) -> None:
    path = session.config.getoption("reliability")
    if path and session.config.stash[ROWS]:
        write = replace_rows if session.config.getoption("keyword") else write_page
        write(Path(path), session.config.stash[ROWS])


@pytest.fixture
def figure(request: pytest.FixtureRequest) -> Callable[[str], None]:
    """Tell what was found: ``figure("worst 0.31 s")``; told before it is asserted."""

    def tell(text: str) -> None:
        request.node.stash[FIGURE] = text

    return tell


@pytest.fixture
def scale(request: pytest.FixtureRequest) -> float:
    """How much of the long measures to do; 1 for all of it."""
    return float(request.config.getoption("scale"))


@pytest.fixture(scope="session")
def description() -> SensorDescription:
    return load_description("paper_square")


@pytest.fixture(scope="session")
def scenes(description: SensorDescription) -> Scenes:
    return Scenes(description)


@pytest.fixture(scope="session", autouse=True)
def _artifact_is_built(description: SensorDescription) -> None:
    load_or_build_artifact(description)


@pytest.fixture
def skin(tmp_path: Path, description: SensorDescription) -> Iterator[PtySkin]:
    """A skin on two ports."""
    made = PtySkin(tmp_path / "lines", description)
    yield made
    made.close()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., DaemonProcess]]:
    """Start a daemon: ``start(ports, **config)``; it is killed at the end if it still runs."""
    processes: list[DaemonProcess] = []

    def begin(ports: list[str], **options: Any) -> DaemonProcess:
        processes.append(DaemonProcess(tmp_path, ports, **options))
        return processes[-1]

    yield begin
    for process in processes:
        process.kill()


@pytest.fixture
def listen() -> Iterator[Callable[..., Ears]]:
    """Listen to a daemon: ``listen(daemon, *kinds)``."""
    opened: list[Ears] = []

    def begin(daemon: DaemonProcess, *kinds: str) -> Ears:
        opened.append(Ears(daemon.stream, kinds=kinds or ("contacts",)))
        return opened[-1]

    yield begin
    for ears in opened:
        ears.close()


@pytest.fixture
def play(skin: PtySkin) -> Iterator[Callable[..., Playing]]:
    """Play scans: ``play(volts, rate_hz)``; stopped at the end."""
    playing: list[Playing] = []

    def begin(volts: Iterator[Volts], rate_hz: float | None = 20.0, **options: Any) -> Playing:
        playing.append(Playing(skin, volts, rate_hz, **options))
        return playing[-1]

    yield begin
    for one in playing:
        one.stop()


@pytest.fixture
def tared(
    skin: PtySkin, scenes: Scenes, start: Callable[..., DaemonProcess], play: Callable[..., Playing]
) -> Callable[..., DaemonProcess]:
    """Start a daemon on the skin and see it through its first reference."""

    def begin(**options: Any) -> DaemonProcess:
        daemon = start(skin.paths, **options)
        rest = play(still(scenes.rest), 100.0)
        wait_until(lambda: daemon.told("tared"), "a reference")
        rest.stop()
        return daemon

    return begin


@pytest.fixture
def busy() -> Iterator[Callable[[int], None]]:
    """Keep the processor busy: ``busy(loops)``."""
    loops: list[subprocess.Popen[bytes]] = []

    def begin(count: int) -> None:
        loops.extend(
            subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)
        )

    yield begin
    for loop in loops:
        loop.kill()
        loop.wait()
