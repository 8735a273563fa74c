"""The C++ client, built as its users build it, beside the Python one on the same messages."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import random
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest
from builds import SANITIZED, runs
from cpp_client import Watch, compile_probe, decode, need_headers, run
from daemon_process import SENSOR, DaemonProcess
from fake_control import FakeControl
from fuzz_targets import CONTACT, HEADER
from tactomo.cli.children import ProcessGroup
from tactomo.stream import keys as key_files
from tactomo_client import ClientError, Contact, ControlError, Frame, request, subscribe
from tactomo_client.fake import FakeSensor
from tactomo_client.messages import CONTACTS, MAP, decode_message, frame_from_message
from waiting import wait_until

PATIENCE_S = 60.0

pytestmark = pytest.mark.timeout(600)  # compilers are slow where others work, too
IMAGES = ("map", "pressure_kpa", "structure")
ANYWHERE = "tcp://127.0.0.1:0"


@pytest.fixture(scope="session")
def probe() -> Path:
    """The probe as it is."""
    need_headers()
    return compile_probe("c++", "-O1")


@pytest.fixture(scope="session")
def checked() -> Path:
    """The probe with sanitizers, where there are some."""
    need_headers()
    clang = "clang++" if shutil.which("clang++") else "c++"
    flags = SANITIZED if runs(clang, SANITIZED) else "-O1"
    return compile_probe(clang, f"{flags} -DMSGPACK_NO_BOOST")


@pytest.fixture(scope="module")
def twin() -> Iterator[Mapping[str, Any]]:
    """What a running twin announces: its `ports`, and its `control` address."""
    with ProcessGroup() as group:
        yield group.start("twin", "twin", "--announce", "--twin-control", ANYWHERE).wait_ready()


@pytest.fixture(scope="module")
def start(
    tmp_path_factory: pytest.TempPathFactory, twin: Mapping[str, Any]
) -> Iterator[Callable[..., DaemonProcess]]:
    """Start a daemon on the twin's skin in place of the one that runs, and wait for its reference.

    The same one again, if it still runs and is to be configured in the same way.
    """
    folder = tmp_path_factory.mktemp("daemons")
    running: list[tuple[dict[str, Any], DaemonProcess]] = []

    def begin(**config: Any) -> DaemonProcess:
        request("clear", twin["control"], PATIENCE_S)
        if running and running[-1][0] == config and running[-1][1].is_running:
            return running[-1][1]
        for _, old in running:
            old.kill()
        daemon = DaemonProcess(folder, twin["ports"], method="fit", **config)
        running.append((config, daemon))
        wait_until(lambda: daemon.told("tared"), "its reference")
        return daemon

    yield begin
    for _, daemon in running:
        daemon.kill()


def python_view(frame: Frame) -> dict[str, Any]:
    """The frame as the probe prints it, but for its age and, of contacts alone, the extent."""
    view: dict[str, Any] = {
        field.name: getattr(frame, field.name)
        for field in dataclasses.fields(frame)
        if not field.name.startswith("_") and field.name not in ("x_mm", "y_mm")
    }
    view["flags"] = sorted(frame.flags)
    view["contacts"] = [
        {
            **dataclasses.asdict(contact),
            "exceeds_150": contact.exceeds(150).value,
            "frame": contact.frame or None,
            **{name: listed(getattr(contact, name)) for name in ("position_m", "normal")},
        }
        for contact in frame.contacts
    ]
    for name in IMAGES:
        image = getattr(frame, name)
        if image is not None:
            view[name] = {"shape": list(image.shape), "hex": image.astype("<f4").tobytes().hex()}
    for name in ("x_mm", "y_mm"):
        view[name] = list(getattr(frame, name) or (0.0, 0.0))
    return view


def cpp_view(said: dict[str, Any]) -> dict[str, Any]:
    """The frame that the probe printed, in the words of `python_view`."""
    view = {**said, "flags": sorted(set(said["flags"]))}
    for name in ("age_now_ns", "exceeds_150", "is_known"):  # they go by the time of asking
        del view[name]
    for name in ("tier", "tier_reason", "dated_by"):
        view[name] = said[name] or None
    view["contacts"] = [{**each, "frame": each["frame"] or None} for each in said["contacts"]]
    return view


def listed(point: tuple[float, ...] | None) -> list[float] | None:
    """A point as JSON has it."""
    return None if point is None else list(point)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [CONTACTS, MAP])
def test_both_clients_see_the_same_contact_at_the_same_sequence_number(
    probe: Path, start: Callable[..., DaemonProcess], twin: Mapping[str, Any], kind: Any
) -> None:
    daemon = start()
    with (
        Watch(probe, SENSOR, daemon.stream, kind) as cpp,
        subscribe(SENSOR, address=daemon.stream, kind=kind, timeout_s=PATIENCE_S) as python,
    ):
        cpp.frames(1)
        next(python)
        request("press", twin["control"], PATIENCE_S, x_mm=20.0, y_mm=-10.0, pressure_kpa=180.0)
        pressed = next(frame for frame in python if frame.contacts)
        ours = {frame.sequence: frame for frame in (pressed, *(next(python) for _ in range(10)))}
        found = cpp.wait(lambda said: said["frame"] and said["frame"]["contacts"], "the contact")
        theirs = {frame["sequence"]: frame for frame in (found["frame"], *cpp.frames(10))}
    shared = ours.keys() & theirs.keys()
    assert len(shared) == 11
    for sequence in shared:
        assert cpp_view(theirs[sequence]) == python_view(ours[sequence])
        assert 0 < theirs[sequence]["age_now_ns"] < PATIENCE_S * 1e9
    contact = theirs[pressed.sequence]["contacts"][0]
    assert abs(contact["x_mm"] - 20) < 5
    assert abs(contact["y_mm"] + 10) < 5
    if kind == MAP:
        assert theirs[pressed.sequence]["map"]["shape"] == [51, 51]


@pytest.mark.slow
def test_stale_while_the_daemon_is_gone_and_fresh_after_its_restart(
    probe: Path, start: Callable[..., DaemonProcess]
) -> None:
    first = start()
    with Watch(probe, SENSOR, first.stream, "contacts") as skin:
        before = skin.wait(lambda said: said["frame"] and not said["stale"], "a fresh frame")
        assert before["restarts"] == 0
        first.kill()
        skin.wait(lambda said: said["frame"] is None and said["stale"], "silence")
        second = start(stream=first.stream, control=first.control)
        after = skin.wait(lambda said: said["frame"] and not said["stale"], "a fresh frame")
    assert second.stream == first.stream
    assert after["restarts"] == 1
    assert after["frame"]["session"] != before["frame"]["session"]


@pytest.mark.slow
def test_commands(probe: Path, start: Callable[..., DaemonProcess]) -> None:
    daemon = start()

    def ask(command: str, argument: object = "") -> Any:
        return json.loads(run(probe, "control", daemon.control, command, argument))

    assert ask("tare") == daemon.status()["reference"]["scans"]
    names = ("sensor", "session", "version", "state", "tier")  # the last two may change between

    def asked_twice() -> tuple[Any, ...]:
        both = ask("status"), daemon.status()
        return both if all(both[0][name] == both[1][name] for name in names) else ()

    status, told = wait_until(asked_twice, "the same of both clients")
    assert status["ports"] == len(told["ports"]) == 2
    assert status["url"] == told["ports"][0]["url"]
    path = ask("record_start", "from-cpp.mcap")
    assert Path(path).name == "from-cpp.mcap"
    stopped = ask("record_stop")
    assert stopped == {"path": path, "bytes": Path(path).stat().st_size}
    assert ask("set_tier", "noser") == "noser"
    wait_until(lambda: daemon.status()["tier_requested"] == "noser", "the tier")
    assert ask("set_tier", "fit") == "fit"
    assert ask("set_budget", 25) == 25
    wait_until(lambda: daemon.status()["budget_ms"] == 25, "the budget")
    assert ask("set_budget") is None
    wait_until(lambda: daemon.status()["budget_ms"] is None, "no budget")
    assert ask("reload_calibration") == "none"
    refused = subprocess.run(
        [probe, "control", daemon.control, "set_tier", "best"], capture_output=True, text=True
    )
    assert refused.returncode == 1
    assert refused.stderr.startswith("bad_argument: ")
    assert "use one of: auto" in refused.stderr


@pytest.mark.slow
def test_nothing_answers(probe: Path) -> None:
    with FakeSensor("left") as silent:
        free = silent.address
    did = subprocess.run([probe, "control", free, "status"], capture_output=True, text=True)
    assert did.returncode == 1
    assert did.stderr.startswith("no_answer: ")
    assert "tactomo daemon" in did.stderr
    bad = subprocess.run([probe, "control", "nowhere", "status"], capture_output=True, text=True)
    assert bad.stderr.startswith("bad_address: ")
    name = subprocess.run([probe, "watch", "a b", free, "map"], capture_output=True, text=True)
    assert name.stderr.startswith("malformed_message: 'a b' is not a sensor name")
    status, said = give(probe, "connect_timeout", 300, "ipc:///nowhere/at/all")
    assert status == 1
    assert said.startswith("no_answer: nothing answered at ipc:///nowhere/at/all within ")
    assert "ms: nothing listens there; start the daemon" in said
    with socket.create_server(("127.0.0.1", 0)) as busy:  # the kernel answers for it
        address = f"tcp://127.0.0.1:{busy.getsockname()[1]}"
        status, said = give(probe, "timeout", 1500, address)
    assert status == 1
    assert ", though something listens there; " in said


def give(program: Path, option: str, value: int, address: str) -> tuple[int, str]:
    """Use an option of this value; what came of it, and all that was said."""
    command = [str(program), "give", option, str(value), address]
    did = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    return did.returncode, did.stdout + did.stderr


LEAST, MOST = -(2**63), 2**63 - 1


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [
        ("timeout", 0, "timeout is 0 ms: give more than 0"),
        ("connect_timeout", -5, "connect_timeout is -5 ms: give more than 0"),
        ("stale_after", -1, "stale_after is negative"),
        ("max_contacts", 4097, "max_contacts is 4097: a frame has at most 4096"),
    ],
)
def test_what_makes_no_sense_is_refused_at_once(
    probe: Path, option: str, value: int, says: str
) -> None:
    status, said = give(probe, option, value, "ipc:///nowhere/at/all")
    assert status == 1
    assert said.startswith("invalid_argument: ")
    assert says in said


@pytest.mark.slow
def test_the_longest_times_serve(checked: Path) -> None:
    with FakeControl({"tare": {"scans": 3}}) as control, FakeSensor("left") as sensor:
        assert give(checked, "timeout", MOST, control.address) == (0, "")
        assert give(checked, "connect_timeout", MOST, control.address) == (0, "3\n")
        for option in ("stale_after", "max_contacts"):
            value = MOST if option == "stale_after" else 4096
            assert give(checked, option, value, sensor.address) == (0, "no frame\n")
        assert give(checked, "wait", LEAST, sensor.address) == (0, "no frame\n")
        with ThreadPoolExecutor() as beside:
            waiting = beside.submit(give, checked, "wait", MOST, sensor.address)
            wait_until(waiting.done, "a frame", step_s=0.05, meanwhile=sensor.publish)
            assert waiting.result() == (0, "a frame\n")


@pytest.mark.slow
def test_with_keys(probe: Path, start: Callable[..., DaemonProcess], tmp_path: Path) -> None:
    robot = tmp_path / "robot"
    key_files.make_pair(robot, SENSOR, is_server=True)
    folders = {name: tmp_path / name for name in ("desk", "stranger")}
    for name, folder in folders.items():
        key_files.make_pair(folder, name)
        shutil.copy(key_files.public_path(robot, SENSOR), folder)
    desk = folders["desk"]
    key_files.allow(robot, key_files.public_path(desk, "desk"), SENSOR, may_command=True)
    curve = {
        "secret": str(key_files.secret_path(robot, SENSOR)),
        "clients": str(key_files.clients_folder(robot, SENSOR)),
    }
    daemon = start(curve=curve)
    with Watch(probe, SENSOR, daemon.stream, "contacts", desk) as skin:
        skin.frames(2)
    assert json.loads(run(probe, "control", daemon.control, "status", "", desk))["sensor"] == SENSOR
    with Watch(probe, SENSOR, daemon.stream, "contacts", folders["stranger"]) as skin:
        skin.wait(lambda said: said["door"] == "key_refused", "the refusal")
        stranger = key_files.public_path(folders["stranger"], "stranger")
        key_files.allow(robot, stranger, SENSOR)
        skin.frames(1)
    with Watch(probe, SENSOR, daemon.stream, "contacts") as skin:
        skin.wait(lambda said: said["door"] == "keys_needed", "the refusal")
    key_files.make_pair(tmp_path, "impostor")
    shutil.copy(key_files.public_path(tmp_path, "impostor"), folders["stranger"] / f"{SENSOR}.key")
    with Watch(probe, SENSOR, daemon.stream, "contacts", folders["stranger"]) as skin:
        skin.wait(lambda said: said["door"] == "wrong_server", "the refusal")
    key_files.secret_path(desk, "desk").chmod(0o644)
    told = subprocess.run(
        [probe, "control", daemon.control, "status", "", desk], capture_output=True, text=True
    )
    assert told.stderr.startswith("bad_keys: users other than the owner may read")


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("other.key", 'public-key = "abc"', "should hold one server's public key, and holds 2"),
        ("server.key", 'public-key = "abc"', "holds no public-key of 40 characters"),
        ("desk.key_secret", "", "holds no public-key of 40 characters"),
    ],
)
def test_a_folder_of_keys_that_cannot_be_used(
    probe: Path, tmp_path: Path, name: str, text: str, complaint: str
) -> None:
    for owner in ("desk", "server"):
        key_files.make_pair(tmp_path, owner)
    key_files.secret_path(tmp_path, "server").unlink()
    (tmp_path / name).write_text(text)
    told = subprocess.run(
        [probe, "watch", "left", ANYWHERE, "map", tmp_path], capture_output=True, text=True
    )
    assert told.returncode == 1
    assert complaint in told.stderr


def test_keys_that_systemd_holds_and_a_folder_at_home(
    probe: Path, tmp_path: Path, sensor: FakeSensor
) -> None:
    """Others may read what systemd guards by its own means: then it is the stream that says no."""
    folder = tmp_path / "keys"
    for owner in ("desk", "server"):
        key_files.make_pair(folder, owner)
    key_files.secret_path(folder, "server").unlink()
    key_files.secret_path(folder, "desk").chmod(0o644)
    command = [str(probe), "control", sensor.address, "status", "", "~/keys"]
    said = []
    for more in ({}, {"CREDENTIALS_DIRECTORY": str(folder)}):
        environment = {**os.environ, "HOME": str(tmp_path), **more}
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        said.append(done.stderr.partition(":")[0])
    assert said[0] == "bad_keys"
    assert said[1] in ("wrong_server", "no_answer")


def test_gaps_malformed_messages_and_a_flag_of_tomorrow(sensor: FakeSensor, probe: Path) -> None:
    with Watch(probe, "left", sensor.address, "contacts") as skin:
        assert sensor.wait_for_subscriber(PATIENCE_S) == b"left/contacts\0"
        for sequence in (1, 2, 5):
            sensor.publish(sequence=sequence)
        seen = skin.wait(lambda said: said["missed"] == 2, "the gap")
        assert seen["frame"]["sequence"] == 5
        sensor.send(b"left/contacts\0\x93")
        sensor.send(b"left/contacts\0" + msgpack.packb({"schema": 2}))
        sensor.publish(flags=["of_tomorrow", "misfit_high"], brand_new={"a": [1]}, sequence=6)
        seen = skin.wait(lambda said: said["frame"], "the next frame")
    assert seen["frame"]["flags"] == ["of_tomorrow", "misfit_high"]
    assert (seen["malformed"], seen["malformed_by"], seen["missed"]) == (2, "schema", 2)


def test_a_limit_is_judged_as_in_python(sensor: FakeSensor, probe: Path) -> None:
    hard = Contact(1, 0.0, 0.0, 700.0, 0.2, 0.01, 170.0, max_kpa=180.0)
    light = Contact(2, 30.0, 0.0, 700.0, 0.0, 0.01, None, pressure_range="below", max_kpa=134.0)
    unknown = Contact(3, 0.0, 30.0, 700.0, None, None, None)
    cases: list[tuple[list[Contact], list[str], str]] = [
        ([], [], "no"),
        ([], ["electrode_fault", "saturated"], "cannot tell"),
        ([], ["electrode_fault", "no_usable_scan"], "cannot tell"),
        ([light], [], "no"),
        ([light], ["misfit_high"], "cannot tell"),
        ([light, unknown], [], "cannot tell"),
        ([unknown, hard], ["misfit_high"], "yes"),
    ]
    with (
        Watch(probe, "left", sensor.address, "contacts") as skin,
        subscribe("left", address=sensor.address, kind="contacts", timeout_s=PATIENCE_S) as python,
    ):
        for _ in range(2):
            sensor.wait_for_subscriber(PATIENCE_S)
        for contacts, flags, answer in cases:
            ahead_ns = time.monotonic_ns() + 10**12  # not old by the time at which it is asked
            sensor.publish(contacts, flags=flags, acquired_monotonic_ns=ahead_ns)
            frame = next(python)
            assert frame.exceeds(150).value == answer
            said = skin.wait(lambda said: said["frame"], "the frame")
            assert said["frame"]["exceeds_150"] == answer
            assert said["frame"]["is_known"] == frame.is_known


def test_an_old_frame_is_stale_and_silence_makes_one_stale(sensor: FakeSensor, probe: Path) -> None:
    old_ns = time.monotonic_ns() - 2_000_000_000
    with Watch(probe, "left", sensor.address, "contacts") as skin:
        sensor.wait_for_subscriber(PATIENCE_S)
        sensor.publish(acquired_monotonic_ns=old_ns)
        assert skin.wait(lambda said: said["frame"], "the old frame")["stale"]
        # Another computer's clock says nothing: its age at publication counts.
        there: dict[str, Any] = {"clock_id": "another", "age_ns": 2_000_000}

        def is_fresh() -> bool:  # not where a busy computer took long to say so
            sensor.publish(acquired_monotonic_ns=old_ns, **there)
            return not skin.wait(lambda said: said["frame"], "the fresh frame")["stale"]

        wait_until(is_fresh, "a fresh frame")
        skin.wait(lambda said: said["stale"], "silence to make it stale")


@pytest.mark.slow
def test_no_allocation_however_frames_differ(sensor: FakeSensor, probe: Path) -> None:
    """From none to as many contacts as there is room for, long reasons, flags, malformed ones."""
    stop = threading.Event()
    dice = random.Random(1)

    def publish() -> None:
        sensor.wait_for_subscriber(PATIENCE_S)
        for count in range(10**6):
            contacts = [Contact(i, 1.0, 2.0, 3.0, 0.1, None, 150.0) for i in range(count % 65)]
            reason = "in words " * (count % 100)
            flags = [f"flag_number_{i}" for i in range(count % 17)]
            sensor.publish(contacts, tier_reason=reason, flags=flags)
            stop.wait(0.002)
            sensor.send(b"left/contacts\0" + dice.randbytes(count % 300))
            if stop.wait(0.002):
                return

    publisher = threading.Thread(target=publish)
    publisher.start()
    try:
        did = json.loads(run(probe, "loop", "left", sensor.address, "contacts", 3000))
    finally:
        stop.set()
        publisher.join()
    assert did["frames"] > 20
    assert did["malformed"] > 20
    assert did["after_first"] == 0


def examples() -> dict[str, dict[str, Any]]:
    """Fields of a `map` and of a `contacts` message."""
    image = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    contact = {**CONTACT, "magnitude_sigma": 0.5, "force_n": 2, "pressure_range": "below"}
    soft = {**CONTACT, "pressure_kpa": 120.0, "peak_kpa": 160, "peak_sigma_kpa": 3.0, "edge": 0.5}
    where = {"position_m": [0.1, -0.2, 3], "normal": [0.0, 0.6, 0.8], "frame": "left_forearm"}
    contacts = [contact | {"max_kpa": 134.0}, {**soft, **where}, dict(CONTACT)]
    total = {"force_n": 41.5, "force_sigma_n": 2}
    fields = {**HEADER, **total, "contacts": contacts, "clock_id": "a", "dated_by": "device"}
    array = {"shape": [3, 4], "dtype": "<f4", "data": image.tobytes()}
    images = {"map": array, "pressure_kpa": None, "structure": dict(array)}
    extent = {"x_mm": [-75.0, 75.0], "y_mm": [-75, 75]}
    return {MAP: {**fields, **images, **extent}, CONTACTS: fields}


def any_value(dice: random.Random) -> Any:
    """A value of some type, often of a right one."""
    return dice.choice(
        [
            *(None, True, 0, 1, -1, 255, 2**32, -(2**31), 2**62, 1.5, -0.0, "", "within", "ä€😀"),
            *(math.nan, -math.inf, 2**63, 2**64 - 1, -(2**63)),
            *(b"", b"\0" * 48, [], {}, [1, 2], [3.5, -4], [[]], {"a": 1}, ["misfit_high"]),
            *("left", "map", "contacts", "<f4", "<f8"),
            *([3, 4], [4, 3], [0, 0], [12], [2**20, 2**20]),
        ]
    )


def mutated(fields: dict[str, Any], dice: random.Random) -> dict[str, Any]:
    """The fields with some values replaced, left out or added, at any depth."""
    changed: dict[str, Any] = msgpack.unpackb(msgpack.packb(fields))
    for _ in range(dice.choice((0, 1, 1, 2, 3))):
        place: Any = changed
        while True:
            key = dice.choice(list(place) if isinstance(place, dict) else range(len(place)))
            inner = place[key]
            if not isinstance(inner, dict | list) or not inner or dice.random() < 0.3:
                break
            place = inner
        action = dice.random()
        if action < 0.2:
            del place[key]
        elif action < 0.3 and isinstance(place, dict):
            place[f"new_{key}"] = any_value(dice)
        else:
            place[key] = any_value(dice)
        if not place:
            break
    return changed


def expected(message: bytes) -> dict[str, Any] | None:
    """What the Python client makes of it; None where it is no frame."""
    with contextlib.suppress(ClientError):
        return python_view(frame_from_message(decode_message(message), time.monotonic_ns(), 0.5))
    return None


@pytest.mark.slow
@pytest.mark.parametrize("kind", [CONTACTS, MAP])
def test_both_clients_agree_on_what_is_a_frame(checked: Path, kind: str) -> None:
    dice = random.Random(f"agree on {kind}")
    head = f"left/{kind}\0".encode()
    whole = {"schema": 1, "sensor": "left", "kind": kind, **examples()[kind]}
    messages = [head + msgpack.packb(mutated(whole, dice)) for _ in range(3000)]
    outcomes = decode(checked, "left", kind, messages)
    assert len(outcomes) == len(messages)
    accepted = 0
    for message, outcome in zip(messages, outcomes, strict=True):
        wanted = expected(message)
        got = None if "problem" in outcome else cpp_view(outcome)
        if wanted is not None:
            accepted += 1
            for contact in wanted["contacts"]:
                known = contact["pressure_range"] in ("within", "below", "above")
                contact["pressure_range"] = contact["pressure_range"] if known else "unknown"
            texts = ("tier", "tier_reason", "dated_by")
            wanted = {**wanted, **{name: wanted[name] or None for name in texts}}
        assert got == wanted, (outcome.get("problem"), msgpack.unpackb(message[len(head) :]))
    assert 300 < accepted < 2700


@pytest.mark.slow
def test_no_reply_crashes_it(checked: Path) -> None:
    dice = random.Random(8)
    port = {"url": "/dev/x", "connected": True, "state": "running", "problem": None}
    words = {name: name for name in ("sensor", "session", "version", "state")}
    result = {**words, "uptime_s": 1.5, "tier": None, "flags": ["a"], "rates": {"frames_hz": 20.0}}
    whole = {"schema": 1, "ok": True, "result": {**result, "ports": [port]}}
    refusal = {"name": "tare_refused", "cause": "somebody presses", "next_step": ""}
    refused = {"schema": 1, "ok": False, "error": refusal}

    class Answers(dict[str, Mapping[str, Any] | ControlError | bytes]):
        """Another one at each time: whole, mutated, damaged."""

        given = 0

        def get(self, command: str, otherwise: Any = None) -> Any:
            self.given += 1
            fields = refused if self.given % 5 == 0 else whole
            if self.given % 3 == 0:
                return msgpack.packb(fields)
            if self.given % 3 == 1:
                return msgpack.packb(mutated(fields, dice))
            data = bytearray(msgpack.packb(fields))
            data[dice.randrange(len(data))] = dice.choice((0xC0, 0xDF, 0xC6, 0xFF, 0xDD))
            return bytes(data[: dice.randrange(1, 2 * len(data))])

    with FakeControl() as daemon:
        daemon.answers = Answers()
        said = run(checked, "statuses", daemon.address, 600).split()
    assert len(said) == 600
    assert said.count('""') > 150
    assert said.count('"malformed_message"') > 150
    assert said.count('"tare_refused"') > 30
