"""The README's examples, run as they stand there against a sensor that is pressed."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import tactomo_client
from tactomo_client import Contact, ControlError
from tactomo_client.fake import FakeControl, FakeSensor

README = (Path(__file__).parents[2] / "clients" / "python" / "README.md").read_text("utf-8")
CONTACT = Contact(1, 10.0, -5.0, 700.0, 0.2, 0.01, 183.0)
PATIENCE_S = 30.0


def example(heading: str) -> str:
    found = re.search(rf"## {heading}\n.*?```python\n(.*?)```", README, re.S)
    assert found
    return found[1]


@pytest.fixture
def _pressed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A sensor of the README's name, where `subscribe` looks by default, pressed all the time."""
    subscribe = tactomo_client.subscribe
    stop = threading.Event()

    def publish() -> None:
        while not stop.wait(0.02):
            sensor.publish([CONTACT])

    with FakeSensor("left_forearm") as sensor:
        address = sensor.address
        monkeypatch.setattr(
            tactomo_client,
            "subscribe",
            lambda name, **options: subscribe(name, address=address, **options),
        )
        thread = threading.Thread(target=publish)
        thread.start()
        yield
        stop.set()
        thread.join()


@pytest.mark.usefixtures("_pressed")
def test_every_frame() -> None:
    printed: list[Any] = []

    def print_once(*values: Any) -> None:
        printed.append(values)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        exec(example("Every frame"), {"print": print_once})
    assert printed == [(1, 10.0, -5.0, 183.0)]


@pytest.mark.usefixtures("_pressed")
def test_in_a_control_loop() -> None:
    done: list[str] = []
    deadline = time.monotonic() + PATIENCE_S

    def is_running() -> bool:
        time.sleep(0.01)
        return "retreat" not in done and time.monotonic() < deadline

    robot = SimpleNamespace(
        is_running=is_running,
        slow_down=lambda: done.append("slow_down"),
        be_careful=lambda: done.append("be_careful"),
        retreat=lambda: done.append("retreat"),
    )
    exec(example("In a control loop"), {"robot": robot})
    assert done[-1] == "retreat"
    assert "be_careful" not in done


def test_commands(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    request = tactomo_client.request
    with FakeControl({"tare": {"scans": 20}}) as daemon:
        monkeypatch.setattr(
            tactomo_client,
            "request",
            lambda command, **options: request(command, daemon.address, **options),
        )
        exec(example("Commands"), {})
        daemon.answers["tare"] = ControlError("somebody presses", "lift it", "tare_refused")
        exec(example("Commands"), {})
    assert capsys.readouterr().out == "{'scans': 20}\ntare_refused somebody presses lift it\n"


def test_testing_a_controller_without_a_skin() -> None:
    exec(example("Testing a controller without a skin"), {})
