"""`twin`, `daemon`, `replay`, `viewer` and `demo` as processes: start, failure, no leftovers."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import pytest
from fixture_types import Run
from processes import children_of, is_running
from tactomo.cli.children import ProcessGroup
from tactomo.errors import TactomoError
from waiting import PATIENCE_S, wait_until

linux = pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks processes up in /proc")


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start `tactomo ARGUMENTS` and kill what is left of it afterwards."""
    started: list[subprocess.Popen[str]] = []

    def run(*arguments: object) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", "tactomo.cli", *map(str, arguments)],
            cwd=tmp_path,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        started.append(process)
        return process

    yield run
    for process in started:
        process.kill()
        process.communicate()


def announced(stream: IO[str] | None) -> dict[str, Any]:
    """Return what a process announces on its output."""
    assert stream is not None
    seen = []
    for line in stream:
        seen.append(line)
        if line.startswith('{"ready"'):
            fields: dict[str, Any] = json.loads(line)
            return fields
    raise AssertionError("".join(seen))


def test_a_twin_whose_control_address_is_taken_says_what_to_do(tactomo: Run, control: Any) -> None:
    result = tactomo("twin", "--link", "dev", "--twin-control", control.address, status=1)
    assert "is in use; stop the program that runs already" in result.stderr


@pytest.mark.slow
def test_a_link_is_one_twins_as_long_as_it_lives(start: Run, tactomo: Run, tmp_path: Path) -> None:
    command = ("twin", "--ports", 1, "--link", "dev", "--twin-control", "tcp://127.0.0.1:0")
    first = start(*command, "--announce")
    announced(first.stdout)
    device = os.readlink(tmp_path / "dev" / "skin")
    second = tactomo(*command, status=1)
    said = f"the link dev/skin is that of another twin that runs (pid {first.pid}); stop that one"
    assert said in second.stderr
    assert "--link another folder" in second.stderr
    assert os.readlink(tmp_path / "dev" / "skin") == device
    first.kill()
    first.wait(PATIENCE_S)
    assert os.path.lexists(tmp_path / "dev" / "skin")
    third = start(*command, "--announce")
    assert announced(third.stdout)["ports"] == ["dev/skin"]
    assert os.path.exists(tmp_path / "dev" / "skin")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["twin", "--description", "nosuch"], "cannot read the sensor description nosuch"),
        (["twin", "--description", "tank_disc", "--ports", "2"], "1 channel"),
        (["twin", "--twin-control", "tcp://0.0.0.0:5562"], "other computers"),
        (["daemon"], "ports is missing"),
        (["daemon", "--port", "none"], "none does not exist; connect the device"),
        (["daemon", "--port", "/dev/null", "--set", "tare_scans=1"], "tare_scans = 1"),
        (["replay", "none.mcap", "--viewer"], "cannot open the recording none.mcap"),
        (["viewer", "--address", "nowhere"], "nowhere"),
    ],
)
def test_what_a_user_can_cause_is_told_without_a_traceback(
    tactomo: Run, arguments: list[str], says: str
) -> None:
    result = tactomo(*arguments, status=1)
    assert result.stderr.startswith("tactomo: ")
    assert says in result.stderr


def test_a_speed_that_is_none_is_a_usage_error(tactomo: Run, tmp_path: Path) -> None:
    for speed in ("fast", "-1", "nan", "0"):
        tactomo("replay", "none.mcap", "--speed", speed, status=2)


@pytest.mark.slow
def test_a_child_that_fails_takes_the_demo_down_and_its_words_are_shown(tactomo: Run) -> None:
    result = tactomo("demo", "--description", "nosuch", "--viewer-port", "0", status=1)
    assert "stopped (exit status 1)" in result.stderr
    assert "cannot read the sensor description nosuch" in result.stderr


@pytest.mark.parametrize(
    "number", [signal.SIGHUP, pytest.param(signal.SIGQUIT, marks=pytest.mark.slow)]
)
def test_a_viewer_ends_in_order_with_its_terminal(start: Run, number: signal.Signals) -> None:
    nobody = "tcp://127.0.0.1:1"
    where = ("--sensor", "left", "--address", nobody, "--control", nobody)
    viewer = start("viewer", *where, "--viewer-port", 0)
    assert viewer.stdout.readline().startswith("viewer: ")
    viewer.send_signal(number)
    assert viewer.wait(PATIENCE_S) == 0
    assert viewer.stdout.read() == ""


@linux
def test_a_demo_leaves_no_process_behind(start: Run) -> None:
    free = "tcp://127.0.0.1:0"
    demo = start(
        *("demo", "--viewer-port", 0, "--stream", free, "--control", free, "--twin-control", free)
    )
    wait_until(lambda: len(children_of(demo.pid)) >= 2)  # begun, and not ready yet
    children = children_of(demo.pid)
    demo.send_signal(signal.SIGTERM)
    demo.wait(PATIENCE_S)
    wait_until(lambda: not any(is_running(child) for child in children))


@pytest.mark.slow
@linux
def test_a_demo_in_the_background_of_a_script_ends_by_sigint(tmp_path: Path) -> None:
    # A shell has SIGINT ignored for what it starts with `&` where there is no job control.
    where = "--viewer-port 0 --stream ipc://$1/s --control ipc://$1/c --twin-control ipc://$1/t"
    script = f'"$0" -m tactomo.cli demo {where} & echo $!; wait'
    with subprocess.Popen(
        ["sh", "-c", script, sys.executable, tmp_path], stdout=subprocess.PIPE, text=True
    ) as shell:
        assert shell.stdout is not None
        demo = int(shell.stdout.readline())
        wait_until(lambda: {path.name for path in tmp_path.iterdir()} == {"s", "c", "t"})
        os.kill(demo, signal.SIGINT)
        wait_until(lambda: not is_running(demo))
        wait_until(lambda: not list(tmp_path.iterdir()))


@pytest.mark.slow
def test_a_demo_prints_commands_that_a_shell_without_them_on_its_path_finds(
    start: Callable[..., subprocess.Popen[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", os.defpath)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    free = "tcp://127.0.0.1:0"
    demo = start(
        *("demo", "--viewer-port", 0, "--stream", free, "--control", free, "--twin-control", free)
    )
    assert demo.stdout is not None
    poke = next(line for line in demo.stdout if " poke press " in line)
    done = subprocess.run(poke, shell=True, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_family_notices_whoever_ends_and_tells_its_last_words() -> None:
    with ProcessGroup() as group:
        viewer = group.start("page", "viewer", "--viewer-port", "0", *NOWHERE)
        url = viewer.wait_ready()["url"]
        assert url.startswith("http://127.0.0.1:")
        group.start("list", "models", "list").wait_done()  # has done its work: no reason to stop
        taken = url.rstrip("/").rpartition(":")[2]
        late = group.start("second", "viewer", "--viewer-port", taken, *NOWHERE)
        assert group.wait_for_an_end() is late
        assert viewer.is_running
        with pytest.raises(TactomoError, match=r"(?s)second stopped.*cannot listen"):
            late.wait_ready()
    assert not viewer.is_running
    assert viewer.status == 0


NOWHERE = ("-s", "skin", "--address", "ipc:///nowhere/at/all", "--control", "ipc:///nowhere/too")
PARENT = """
import sys
from tactomo.cli.children import ProcessGroup
with ProcessGroup() as group:
    viewer = group.start("viewer", "viewer", "--viewer-port", "0", *sys.argv[1:])
    viewer.wait_ready()
    print(viewer.pid, flush=True)
    sys.stdin.read()
"""


@linux
def test_a_child_that_is_ready_ends_with_a_parent_that_is_killed() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PARENT, *NOWHERE], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        assert is_running(child)
        parent.kill()
    wait_until(lambda: not is_running(child))
