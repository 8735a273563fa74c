"""The log as journald gets it: priorities, one line an event, no flood, and last words."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import structlog
from tactomo.events import LOG_PERIOD_S, LOGGED_AT_ONCE, EventBook
from tactomo.log import configure_logging

log = structlog.get_logger()


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """What a log for journald writes."""
    file = io.StringIO()
    monkeypatch.setattr(sys, "stderr", file)
    configure_logging("debug", "journal")
    return file


def test_a_line_has_its_priority_and_its_pairs(written: io.StringIO) -> None:
    log.error("port_lost", detail='/dev/ttyACM0: "gone"\nfor good', count=3)
    log.warning("late")
    log.info("ready", ports=["a", "b"])
    log.debug("nothing", is_so=True)
    assert written.getvalue().splitlines() == [
        r'<3>port_lost detail="/dev/ttyACM0: \"gone\" for good" count=3',
        "<4>late",
        "<6>ready ports=\"['a', 'b']\"",
        "<7>nothing is_so",
    ]


@pytest.mark.parametrize("form", ["journal", "text", "json"])
def test_what_others_call_themselves_steers_no_terminal(
    monkeypatch: pytest.MonkeyPatch, form: Any
) -> None:
    file = io.StringIO()
    monkeypatch.setattr(sys, "stderr", file)
    configure_logging("debug", form)
    log.error("device_changed", detail="x[/b]y \x1b]0;title\x07\x1b[2J\x9b2J")
    assert "x[/b]y" in file.getvalue()
    assert not re.search("[\x07\x9b]|\x1b(?!\\[[0-9;]*m)", file.getvalue())  # colours are ours


def test_each_line_of_a_traceback_has_the_priority(written: io.StringIO) -> None:
    try:
        raise ValueError("two\nlines")
    except ValueError:
        log.exception("reconstruction_failed")
    lines = written.getvalue().splitlines()
    assert lines[0] == "<3>reconstruction_failed"
    assert lines[-1] == "<3>lines"
    assert all(line.startswith("<3>") for line in lines)


ADDRESSES = ("--stream", "tcp://127.0.0.1:0", "--control", "tcp://127.0.0.1:0")


def test_a_line_is_one_write_since_processes_share_the_log() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)  # keeps writes apart
    say = "import structlog, tactomo.log as log; log.configure_logging(form='json', sensor='left');"
    with ours, theirs:
        subprocess.run(
            [sys.executable, "-u", "-c", f"{say} structlog.get_logger().info('ready')"],
            stderr=theirs.fileno(),
            check=True,
        )
        written = ours.recv(10_000)
    assert written.endswith(b"\n")
    assert json.loads(written)["sensor"] == "left"


def daemon(*arguments: str, **environment: str) -> subprocess.Popen[str]:
    """Run a daemon whose standard error is a pipe that journald might hold."""
    reader, writer = os.pipe()
    status = os.fstat(writer)
    stream = f"{status.st_dev}:{status.st_ino}"
    command = [sys.executable, "-m", "tactomo.cli", "daemon", *ADDRESSES, *arguments]
    try:
        process = subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=writer,
            text=True,
            env={**os.environ, "JOURNAL_STREAM": stream, **environment},
        )
    finally:
        os.close(writer)
    process.stderr = os.fdopen(reader)
    return process


@pytest.mark.slow
def test_its_last_words_say_why(tmp_path: Path, make_skin: Callable[[Path, int], Any]) -> None:
    skin = make_skin(tmp_path, 1)
    with daemon("--port", str(skin.lines[0].path)) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if "ready" in line:
                break
        process.send_signal(signal.SIGTERM)
        said = process.stderr.read()
    assert process.returncode == 0
    assert re.search(r"^<6>stopped why=SIGTERM uptime_s=\d+ frames=0 dropped_scans=0", said, re.M)


class Clock:
    """A monotonic clock that a test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        monkeypatch.setattr("tactomo.events.time.monotonic", lambda: self.now_s)


def test_a_year_of_a_bad_cable_does_not_fill_the_log(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, book = Clock(monkeypatch), EventBook()
    told: list[int] = []
    for _ in range(7200):  # two hours, an event a second
        clock.now_s += 1.0
        spared = book.note("corrupt_packets", "3 damaged", "check the cable")
        told += [] if spared is None else [spared]
    assert len(told) == pytest.approx(LOGGED_AT_ONCE + 7200 / LOG_PERIOD_S, abs=1)
    assert told[:LOGGED_AT_ONCE] == [0] * LOGGED_AT_ONCE
    assert told[-1] == pytest.approx(LOG_PERIOD_S - 1, abs=1)
    assert book.note("port_lost", "gone", "") == 0, "another event is not held back"
    assert book.fields()["counts"] == {"corrupt_packets": 7200, "port_lost": 1}


def test_the_book_keeps_the_last_of_each_trouble(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, book = Clock(monkeypatch), EventBook()
    book.note("port_lost", "first", "")
    book.note("tared", "20 dual scans", "")
    book.note("corrupt_packets", "1 damaged", "check the cable")
    clock.now_s += 5.0
    book.note("port_lost", "second", "")
    said: Mapping[str, Any] = book.fields()
    assert said["counts"] == {"port_lost": 2, "tared": 1, "corrupt_packets": 1}
    assert [(t["name"], t["detail"], t["age_s"]) for t in said["troubles"]] == [
        ("port_lost", "second", 0.0),
        ("corrupt_packets", "1 damaged", 5.0),
    ]


def test_what_lasts_is_told_once_until_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, book = Clock(monkeypatch), EventBook()
    assert not book.is_due("channel_back", "structure"), "nothing was lost"
    assert book.is_due("channel_lost", "structure")
    clock.now_s += 1e6
    assert not book.is_due("channel_lost", "structure")
    assert book.is_due("channel_lost", "magnitude"), "another channel"
    assert book.is_due("channel_back", "structure")
    assert not book.is_due("channel_back", "structure")
    assert book.is_due("channel_lost", "structure")
    assert book.is_due("port_lost", "a", "held by another process")
    assert not book.is_due("port_lost", "a", "held by another process")
    assert book.is_due("port_lost", "a", "gone")


def test_one_kind_is_told_ever_more_rarely_and_others_are_not_held_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, book = Clock(monkeypatch), EventBook()
    began_s, told_s = clock.now_s, []
    for _ in range(3000):
        if book.is_due("corrupt_packets", "a"):
            told_s.append(clock.now_s - began_s)
        clock.now_s += 0.1
    assert told_s == pytest.approx([0, 1, 3, 7, 15, 31, 63, 123, 183, 243], abs=2.0)
    assert book.is_due("corrupt_packets", "b")
    assert all(book.is_due("tared") for _ in range(5))
    clock.now_s += 200.0  # afterwards as at first
    assert book.is_due("corrupt_packets", "a")
    clock.now_s += 1.1
    assert book.is_due("corrupt_packets", "a")


def test_a_late_joiner_finds_what_happened(bench: Callable[..., Any]) -> None:
    """What the process did before, such as loading libraries, is no share of its time."""
    before_s = time.process_time()
    daemon = bench(ports=1)
    assert daemon.ask("status")["process"]["cpu_s"] <= time.process_time() - before_s
    daemon.tare()
    daemon.skin.lines[0].say(b"\1\2\3\0")
    daemon.listener.event("corrupt_packets")
    status = daemon.ask("status")
    assert status["events"]["counts"]["tared"] == 1
    assert status["events"]["troubles"][0]["name"] == "corrupt_packets"
    assert status["events"]["troubles"][0]["next_step"]
    assert status["frames"] == len(daemon.listener.of("map"))
    assert status["process"]["pid"] == os.getpid()
    assert status["process"]["memory_bytes"] > 10_000_000
