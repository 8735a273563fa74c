"""The README's examples, every one run as it stands there against a sensor that is pressed."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import tactomo_client
from fake_control import FakeControl
from recorded_grasp import write_grasp
from tactomo_client import Contact, ControlError, aio
from tactomo_client.fake import FakeSensor
from waiting import repeated, wait_until

ROOT = Path(__file__).parents[2]
README = (ROOT / "clients" / "python" / "README.md").read_text("utf-8")
EXAMPLES = {
    heading.strip(): code
    for section in README.split("\n## ")[1:]
    for heading, _, text in [section.partition("\n")]
    for code in re.findall(r"```python\n(.*?)```", text, re.S)
}
CONTACT = Contact(1, 10.0, -5.0, 700.0, 0.2, 0.01, 183.0)
PATIENCE_S = 30.0


class EnoughError(Exception):
    """Ends an example that would go on for ever."""


class Printed(list[tuple[Any, ...]]):
    """What an example prints, until that is enough."""

    def __init__(self, is_enough: Callable[[tuple[Any, ...]], bool]) -> None:
        super().__init__()
        self._is_enough = is_enough

    def __call__(self, *values: Any) -> None:
        self.append(values)
        if self._is_enough(values):
            raise EnoughError


def run_until(heading: str, is_enough: Callable[[tuple[Any, ...]], bool]) -> Printed:
    """Run an example until that is enough; anew where a busy computer made its frame old."""
    printed = Printed(is_enough)

    def ends() -> bool:
        try:
            exec(EXAMPLES[heading], {"print": printed})
        except EnoughError:
            return True
        return False

    wait_until(ends, "what an example prints")
    return printed


def test_the_front_page_prints_a_touch_of_unknown_pressure(monkeypatch: pytest.MonkeyPatch) -> None:
    light = Contact(1, 10.0, -5.0, 700.0, None, None, None)
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.S)
    frames = [SimpleNamespace(contacts=[light])]
    monkeypatch.setattr(tactomo_client, "subscribe", lambda _: frames)
    printed: list[tuple[Any, ...]] = []
    exec(code, {"print": lambda *values: printed.append(values)})
    assert printed


def test_there_is_a_test_of_every_example() -> None:
    tests = {name.removeprefix("test_") for name in globals() if name.startswith("test_")}
    blocks = README.count("```python\n")
    assert len(EXAMPLES) == blocks  # one in each section
    named = {heading.lower().replace(" ", "_") for heading in EXAMPLES}
    assert named <= tests, named - tests


@pytest.fixture
def pressed(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeSensor]:
    """A sensor of the README's name, where `subscribe` looks by default, pressed all the time."""

    def publish() -> None:
        sensor.publish([CONTACT])
        sensor.publish_message("status", {"state": "running"})
        sensor.publish_message("event", {"name": "tared", "detail": "a new reference"})

    def here(subscribe: Callable[..., Any]) -> Callable[..., Any]:
        return lambda name, **options: subscribe(name, **{"address": sensor.address} | options)

    with FakeSensor("left_forearm") as sensor:
        for module in (tactomo_client, aio):
            monkeypatch.setattr(module, "subscribe", here(module.subscribe))
        with repeated(publish, 0.02):
            yield sensor


@pytest.fixture
def control(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeControl]:
    """A control socket where `Daemon` looks by default."""
    with FakeControl({"tare": {"scans": 20}, "status": {"state": "running"}}) as fake:
        for module, name in ((tactomo_client, "Daemon"), (aio, "Control")):
            made = getattr(module, name)
            monkeypatch.setattr(module, name, lambda of=made: of(fake.address))
        yield fake


@pytest.mark.usefixtures("pressed")
def test_every_frame() -> None:
    assert run_until("Every frame", lambda _: True) == [(1, 10.0, -5.0, 183.0)]


@pytest.mark.usefixtures("pressed")
def test_in_a_control_loop() -> None:
    done: list[str] = []
    deadline = time.monotonic() + PATIENCE_S

    def is_running() -> bool:
        return "stop" not in done and time.monotonic() < deadline

    robot = SimpleNamespace(
        is_running=is_running,
        is_stopped=lambda: done[-1:] == ["stop"],
        **{name: partial(done.append, name) for name in ("stop", "slow_down", "move")},
    )
    exec(EXAMPLES["In a control loop"], {"robot": robot})
    assert done == ["stop"]


def test_what_stale_means(pressed: FakeSensor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pressed, "publish", lambda _: FakeSensor.publish(pressed))  # let go
    (said,) = run_until("What stale means", lambda _: True)
    assert re.fullmatch(r"nothing pressed \d+ ms ago", said[0])


def test_commands(control: FakeControl, capsys: pytest.CaptureFixture[str]) -> None:
    exec(EXAMPLES["Commands"], {})
    control.answers["tare"] = ControlError("somebody presses", "lift it", "tare_refused")
    exec(EXAMPLES["Commands"], {})
    control.answers["tare"] = ControlError("no scans", "plug it in", "no_data")
    exec(EXAMPLES["Commands"], {})
    assert capsys.readouterr().out.splitlines() == [
        "reference of 20 dual scans",
        "let go of the skin",
        "no_data no scans plug it in",
    ]


@pytest.mark.usefixtures("pressed")
def test_status_and_events() -> None:
    seen: set[str] = set()

    def is_enough(values: tuple[Any, ...]) -> bool:
        seen.add(values[0])
        return seen >= {"is", "tared"}

    printed = run_until("Status and events", is_enough)
    assert ("is", "running") in printed
    assert ("tared", "a new reference", "") in printed


def test_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_grasp(Path("grasp.mcap"), range(41))
    exec(EXAMPLES["Recordings"], {})
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["left 2.0 s whole", *(f"{number} 0" for number in range(10, 20))]


@pytest.mark.usefixtures("pressed", "control")
def test_asyncio() -> None:
    printed = run_until("asyncio", lambda values: values == ((CONTACT,),))
    assert printed[0] == ("running",)


def test_from_another_computer(pressed: FakeSensor, monkeypatch: pytest.MonkeyPatch) -> None:
    """With real keys it is tried beside the daemon that asks for them."""
    subscribe = tactomo_client.subscribe

    def as_there(name: str, *, address: str, keys: str) -> Any:
        assert (address, keys) == ("tcp://robot:5560", "~/keys/robot")
        return subscribe(name)

    monkeypatch.setattr(tactomo_client, "subscribe", as_there)
    assert run_until("From another computer", lambda _: True) == [((CONTACT,),)]


def test_testing_a_controller_without_a_skin() -> None:
    exec(EXAMPLES["Testing a controller without a skin"], {})


def test_every_public_name_is_documented() -> None:
    for module in (tactomo_client, aio):
        things = {name: getattr(module, name) for name in module.__all__}
        assert all(isinstance(each, str) or each.__doc__ for each in things.values()), things
