"""`tactomo zenoh`: daemons' streams in Zenoh by key, and Zenoh's at one address of ZeroMQ."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest
import zenoh
import zmq
from hostile_page import SUBSCRIBE, post
from needs import need
from page import Page
from tactomo.stream import zenoh_bridge
from tactomo.stream.zenoh_bridge import ENCODING, HEARTBEAT_S, STATUS_HEARTBEAT_S
from tactomo_client import Contact, request, subscribe
from tactomo_client.fake import FakeSensor
from tactomo_client.messages import decode_message, topic
from waiting import PATIENCE_S, repeated, wait_until
from whole_system import SENSOR, running_demo

ZENOH = ("-m", "tactomo.cli", "zenoh")
EXAMPLES = Path(__file__).parents[3] / "deploy/examples"
Configure = Callable[..., Path]
TOUCH = [Contact(1, 10.0, 0.0, 700.0, 0.1, 0.01, 170.0)]


class LoggedProcess:
    """Python with some arguments, which logs JSON; it is ready, at `address`."""

    def __init__(self, *arguments: object) -> None:
        command = [sys.executable, *map(str, arguments)]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        self.address: str = self.said("ready")["stream"]

    def said(self, event: str) -> dict[str, Any]:
        """Return the next such line of its log."""
        assert self.process.stderr is not None
        for line in self.process.stderr:
            entry: dict[str, Any] = json.loads(line)
            if entry["event"] == event:
                return entry
        raise AssertionError(f"it ended with status {self.process.wait()}")

    def end(self) -> None:
        self.process.kill()
        self.process.communicate()


def next_of(socket: zmq.Socket[bytes], send: Callable[[], object]) -> Any:
    """Return the next message; `send` is called until it comes."""
    wait_until(lambda: socket.poll(20), "a message", meanwhile=send, step_s=0.0)
    return decode_message(socket.recv())


Start = Callable[..., LoggedProcess]


@pytest.fixture
def configuration(tmp_path: Path) -> Configure:
    """Write a configuration of Zenoh: ``configuration(mode="client", connect={...})``."""

    def write(**sections: object) -> Path:
        path = tmp_path / f"zenoh{len(list(tmp_path.iterdir()))}.json5"
        path.write_text(json.dumps({"scouting": {"multicast": {"enabled": False}}, **sections}))
        return path

    return write


@pytest.fixture
def desk(tmp_path: Path, configuration: Configure) -> Iterator[zenoh.Session]:
    """A Zenoh session that is a router, at a file; `client` of it connects there."""
    listen = {"endpoints": [f"unixsock-stream/{tmp_path / 'router'}"]}
    session = zenoh.open(zenoh.Config.from_file(str(configuration(mode="router", listen=listen))))
    yield session
    session.close()  # type: ignore[no-untyped-call]


@pytest.fixture
def start(tmp_path: Path, configuration: Configure, desk: zenoh.Session) -> Iterator[Start]:
    """Start a bridge that is a client of `desk`: ``start(*sensors, robot="arm", bind=...)``."""
    started: list[LoggedProcess] = []
    connect = {"endpoints": [f"unixsock-stream/{tmp_path / 'router'}"]}

    def go(*sensors: FakeSensor, **options: object) -> LoggedProcess:
        config = configuration(mode="client", connect=connect)
        words = [word for sensor in sensors for word in ("--from", sensor.address)]
        words += [str(word) for name, value in options.items() for word in (f"--{name}", value)]
        started.append(LoggedProcess(*ZENOH, "--config", config, *words))
        return started[-1]

    yield go
    for running in started:
        running.end()


class Samples:
    """What comes under a key expression: (key, its message, count of those sent)."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self.all: list[tuple[str, dict[str, Any], int]] = []
        self._subscriber = session.declare_subscriber(key, self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        assert str(sample.encoding) == "application/msgpack"
        assert sample.attachment
        fields = msgpack.unpackb(sample.payload.to_bytes())
        self.all.append((str(sample.key_expr), fields, int(sample.attachment.to_string())))

    def until(self, condition: Callable[[], object], send: Callable[[], object]) -> None:
        wait_until(condition, meanwhile=send, step_s=0.02)


def test_each_kind_has_its_key_and_its_count_and_a_query_gets_the_newest(
    left: FakeSensor, right: FakeSensor, start: Start, desk: zenoh.Session
) -> None:
    samples = Samples(desk, "tactomo/**")
    start(left, right, robot="arm")
    wanted = {f"tactomo/arm/{s}/{k}" for s in ("left", "right") for k in ("map", "contacts")}
    wanted.add("tactomo/arm/left/status")

    def send() -> None:
        left.publish(TOUCH, map=np.ones((3, 3), np.float32))
        left.publish_message("status", {"state": "running"})
        right.publish()

    samples.until(lambda: {key for key, _, _ in samples.all} == wanted, send)
    for key, fields, _ in samples.all:
        assert key == f"tactomo/arm/{fields['sensor']}/{fields['kind']}"
    counts = [n for key, _, n in samples.all if key == "tactomo/arm/left/contacts"]
    assert counts == list(range(counts[0], counts[0] + len(counts)))
    replies = {str(r.ok.key_expr): r.ok for r in desk.get("tactomo/*/left/*") if r.ok}
    assert replies.keys() == {"tactomo/arm/left/status", "tactomo/arm/left/contacts"}
    status = replies["tactomo/arm/left/status"]
    assert msgpack.unpackb(status.payload.to_bytes())["state"] == "running"
    assert status.attachment
    count = int(status.attachment.to_string())  # of the sample that it repeats
    wait_until(lambda: ("tactomo/arm/left/status", count) in {(k, n) for k, _, n in samples.all})
    contacts = msgpack.unpackb(replies["tactomo/arm/left/contacts"].payload.to_bytes())
    assert len(contacts["contacts"]) == 1


@pytest.mark.slow
def test_a_skin_at_rest_is_sent_by_a_heartbeat_and_a_touch_at_once(
    left: FakeSensor, start: Start, desk: zenoh.Session
) -> None:
    samples = Samples(desk, "tactomo/arm/left/contacts")
    start(left, robot="arm")
    began_s = time.monotonic()
    samples.until(lambda: samples.all, left.publish)
    samples.until(lambda: len(samples.all) >= 6, left.publish)  # its heart goes on beating
    seen, took_s = len(samples.all), time.monotonic() - began_s
    assert seen <= took_s / HEARTBEAT_S + 2
    left.publish(TOUCH)
    left.publish(flags=["misfit_high"])
    wait_until(lambda: samples.all[-1][1]["flags"])
    touches = [len(fields["contacts"]) for _, fields, _ in samples.all]
    assert [each for each, _ in groupby(touches)] == [0, 1, 0]
    counts = [count for _, _, count in samples.all]
    assert counts == list(range(counts[0], counts[0] + len(counts)))  # none is missed


@pytest.mark.slow
def test_a_status_is_sent_when_it_says_something_else_and_its_numbers_are_asked_for(
    left: FakeSensor, start: Start, desk: zenoh.Session, connect: Any
) -> None:
    samples = Samples(desk, "tactomo/arm/left/status")
    start(left, robot="arm")
    one = connect(zmq.SUB, start(bind="tcp://127.0.0.1:0").address, topic("left", "status"))
    began_s, seen = time.monotonic(), set[int]()
    said: dict[str, Any] = {"state": "running", "frames": 0, "ports": [{"state": "running"}]}
    said["recording"] = {"path": "/data/grasp.mcap", "bytes": 0}

    def send() -> None:
        said["frames"] += 1
        said["recording"]["bytes"] += 1
        left.publish_message("status", said)

    samples.until(lambda: samples.all, send)
    while len(seen) < 4:  # the proxy asks every second, so that clients of ZeroMQ hear of it
        seen.add(next_of(one, send).fields["frames"])
    came, took_s = len(samples.all), time.monotonic() - began_s
    assert came <= took_s / STATUS_HEARTBEAT_S + 2
    said["ports"] = [{"state": "silent"}]
    samples.until(lambda: samples.all[-1][1]["ports"] == said["ports"], send)
    said["state"] = "stale"
    samples.until(lambda: samples.all[-1][1]["state"] == "stale", send)
    came, took_s = len(samples.all), time.monotonic() - began_s
    assert came <= took_s / STATUS_HEARTBEAT_S + 4


@pytest.mark.slow
def test_contacts_of_a_simulated_skin_at_rest_are_sent_by_a_heartbeat(
    start: Start, desk: zenoh.Session
) -> None:
    """Behind a real daemon, whose frames differ in all numbers that say nothing new."""
    samples = Samples(desk, f"tactomo/arm/{SENSOR}/contacts")
    with running_demo() as demo:
        request("tare", demo.control, PATIENCE_S)
        start(SimpleNamespace(address=demo.stream), robot="arm")
        wait_until(lambda: samples.all)
        seen, began_s = len(samples.all), time.monotonic()
        wait_until(lambda: len(samples.all) >= seen + 10)
        came, took_s = len(samples.all) - seen, time.monotonic() - began_s
    assert came <= took_s / HEARTBEAT_S + 2


@pytest.mark.slow
def test_a_token_lives_as_long_as_the_daemon(
    left: FakeSensor, start: Start, desk: zenoh.Session
) -> None:
    heard: list[tuple[str, zenoh.SampleKind]] = []
    tokens = desk.liveliness().declare_subscriber(
        "tactomo/*/*", lambda s: heard.append((str(s.key_expr), s.kind)), history=True
    )
    start(left, robot="arm")
    wait_until(lambda: heard, meanwhile=left.publish, step_s=0.05)
    left.close()
    wait_until(lambda: len(heard) == 2)
    token = "tactomo/arm/left"
    assert heard == [(token, zenoh.SampleKind.PUT), (token, zenoh.SampleKind.DELETE)]
    assert not [reply for reply in desk.get("tactomo/arm/left/*") if reply.ok]
    tokens.undeclare()  # type: ignore[no-untyped-call]


@pytest.mark.slow
def test_clients_of_zeromq_find_all_skins_at_one_address_while_they_are_there(
    left: FakeSensor, right: FakeSensor, start: Start, connect: Any
) -> None:
    start(left, right, robot="arm")
    address = start(bind="tcp://127.0.0.1:0").address
    every = connect(zmq.SUB, address, b"")
    one = connect(zmq.SUB, address, topic("right", "contacts"))

    def send() -> None:
        left.publish(TOUCH, map=np.ones((3, 3), np.float32))
        right.publish(TOUCH)

    seen: set[tuple[str, str]] = set()
    while len(seen) < 4:
        message = next_of(every, send)
        seen.add((message.sensor, message.kind))
    assert seen == {(s, k) for s in ("left", "right") for k in ("map", "contacts")}
    with subscribe("right", address=address, kind="contacts") as skin:
        wait_until(lambda: (frame := skin.latest()) and frame.contacts, meanwhile=send, step_s=0.02)
        assert skin.latest() is not None
    last = 0
    for _ in range(20):
        message = next_of(one, send)
        assert (message.sensor, message.kind) == ("right", "contacts")
        assert message.fields["sequence"] > last  # once, however many subscriptions overlap
        last = message.fields["sequence"]
    status = connect(zmq.SUB, address, topic("left", "status"))
    next_of(status, lambda: left.publish_message("status", {"state": "running"}))
    left.close()

    def is_silent() -> bool:
        with connect(zmq.SUB, address, topic("left", "status")) as late:
            return not late.poll(500)

    wait_until(is_silent, "a status too old to be repeated")


def test_late_joiners_get_the_last_status_at_once(
    left: FakeSensor, start: Start, connect: Any
) -> None:
    start(left, robot="arm")
    address = start(bind="tcp://127.0.0.1:0", robot="arm").address
    first = connect(zmq.SUB, address, topic("left", "status"))

    def is_repeated(prefix: bytes) -> bool:
        sent = next_of(first, lambda: left.publish_message("status", {"state": "running"}))
        late = connect(zmq.SUB, address, prefix)
        # It is remembered for 3 s; a joiner whom a busy computer holds up for longer gets none.
        if not late.poll(2000):
            return False
        message = decode_message(late.recv())
        assert message.fields["sequence"] >= sent.fields["sequence"]
        assert message.kind == "status"
        return True

    for prefix in (topic("left", "status"), b"left/", b""):
        wait_until(partial(is_repeated, prefix), "a status at once")


def test_zenoh_is_asked_for_what_somebody_wants_what_is_lost_is_told_and_no_web_page_gets_it(
    desk: zenoh.Session, start: Start, connect: Any
) -> None:
    publisher: Any = desk.declare_publisher("tactomo/arm/left/contacts")  # typed as not so

    def is_wanted() -> bool:
        return bool(publisher.matching_status.matching)

    running = start(bind="tcp://127.0.0.1:0")
    wanted = [connect(zmq.SUB, running.address, topic("left", "contacts")) for _ in range(2)]
    wait_until(is_wanted, "a subscriber")
    for one in wanted:
        assert is_wanted()
        one.close()
    wait_until(lambda: not is_wanted(), "nobody")
    one = connect(zmq.SUB, running.address, b"left/")
    put = partial(desk.put, "tactomo/arm/left/contacts", b"\x80")
    wait_until(lambda: one.poll(0), meanwhile=lambda: put(attachment="1"), step_s=0.02)
    for count in ("2", "6", "not a number"):
        put(attachment=count)
    assert running.said("messages_lost")["detail"].startswith("3 so far")
    assert b"left" not in post(running.address, [SUBSCRIBE + b"left/"])


@pytest.mark.slow
def test_a_slow_subscriber_slows_nobody(desk: zenoh.Session, start: Start, connect: Any) -> None:
    running = start(bind="tcp://127.0.0.1:0")
    counts, image = iter(range(1, 10_000)), bytes(640_000)

    def put() -> None:
        desk.put("tactomo/arm/left/map", image, attachment=str(next(counts)))

    stalled = connect(zmq.SUB, running.address, topic("left", "map"))
    wait_until(lambda: stalled.poll(0), meanwhile=put, step_s=0.02)  # and reads no more
    healthy = connect(zmq.SUB, running.address, topic("left", "map"))
    wait_until(lambda: healthy.poll(0), meanwhile=put, step_s=0.02)  # before, it may not be heard
    for _ in range(600):  # 384 MB: more than any buffer holds
        put()
        assert healthy.poll(PATIENCE_S * 1000)
        healthy.recv()
    resident = Path(f"/proc/{running.process.pid}/statm").read_text().split()[1]
    assert int(resident) * os.sysconf("SC_PAGE_SIZE") < 400e6


@pytest.mark.slow
def test_a_source_that_never_answered_is_missed_once(tmp_path: Path, start: Start) -> None:
    with FakeSensor("left", f"ipc://{tmp_path}/left") as left:  # a port may be another's meanwhile
        pass
    running = start(left)
    warning = running.said("source_silent")
    assert f"nothing from {left.address}" in warning["detail"]
    assert "start its daemon" in warning["next_step"]
    with FakeSensor("left", left.address):
        assert left.address in running.said("source_came")["detail"]


@pytest.mark.slow
def test_two_robots_skins_of_one_name_are_not_mixed(
    desk: zenoh.Session, start: Start, connect: Any, left: FakeSensor
) -> None:
    running = start(bind="tcp://127.0.0.1:0")
    one = connect(zmq.SUB, running.address, topic("left", "contacts"))
    start(left, robot="arm")
    first = next_of(one, lambda: left.publish(TOUCH)).fields["session"]
    with FakeSensor("left") as other:
        # Where the first falls silent, if only while the other starts, that one takes its place.
        with repeated(lambda: left.publish(TOUCH)):
            start(other, robot="leg")
            samples = Samples(desk, "tactomo/leg/left/contacts")
            samples.until(lambda: len(samples.all) > 5, lambda: other.publish(TOUCH))
            warning = running.said("same_sensor_twice")
        assert warning["detail"] == "arm and leg both have a skin 'left'"
        assert "--robot leg" in warning["next_step"]
        while one.poll(0):
            assert decode_message(one.recv()).fields["session"] == first
        left.close()
        wait_until(lambda: next_of(one, lambda: other.publish(TOUCH)).fields["session"] != first)


def test_two_daemons_of_one_name_are_warned_of(
    left: FakeSensor, start: Start, desk: zenoh.Session
) -> None:
    samples = Samples(desk, "tactomo/**")
    with FakeSensor("left") as other:
        running = start(left, other, robot="arm")

        def send() -> None:
            left.publish()
            other.publish()

        sessions = {left.session, other.session}
        samples.until(lambda: {f["session"] for _, f, _ in samples.all} == sessions, send)
        warning = running.said("same_sensor_twice")
        assert left.address in warning["detail"]
        assert other.address in warning["detail"]
        assert "another name" in warning["next_step"]


@pytest.mark.slow
def test_a_signal_ends_it(left: FakeSensor, start: Start) -> None:
    for running in (start(left), start(bind="tcp://127.0.0.1:0")):
        running.process.send_signal(signal.SIGTERM)
        assert running.process.wait(PATIENCE_S) == 0
        assert running.process.stderr is not None
        assert "Traceback" not in running.process.stderr.read()


@pytest.mark.slow
def test_without_a_configuration_the_two_meet_on_this_computer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zenoh_bridge, "LOCAL", f"unixsock-stream/{tmp_path / 'local'}")
    with (
        zenoh_bridge.open_session(None, "connect") as desk,  # whichever comes first
        zenoh_bridge.open_session(None, "listen") as robot,
    ):
        heard: list[bytes] = []
        desk.declare_subscriber(
            "tactomo/**", lambda sample: heard.append(sample.payload.to_bytes())
        )
        wait_until(lambda: heard, meanwhile=lambda: robot.put("tactomo/a/b", b"1"), step_s=0.05)


def certificates(folder: Path, *names: str) -> None:
    """Make an authority and, by it, a certificate of `localhost` for each name."""
    need("openssl")

    def openssl(*words: object) -> None:
        subprocess.run(["openssl", *map(str, words)], cwd=folder, check=True, capture_output=True)

    new = ("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-keyout")
    openssl(*new, "authority.key", "-x509", "-out", "authority.pem", "-subj", "/CN=authority")
    (folder / "names").write_text("subjectAltName=DNS:localhost")
    authority = ("-CA", "authority.pem", "-CAkey", "authority.key", "-CAcreateserial")
    for name in names:
        openssl(*new, f"{name}.key.pem", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        signed = ("x509", "-req", "-in", f"{name}.csr", *authority, "-out", f"{name}.pem")
        openssl(*signed, "-extfile", "names")


def example(name: str, folder: Path, port: int) -> Path:
    """Write an example of deploy/ with its files in `folder` and its port on this computer."""
    text = (EXAMPLES / name).read_text("utf-8")
    text = text.replace("/etc/tactomo/keys/", "").replace("robot:", "localhost:")
    text = re.sub(r'"([\w.]+\.pem)"', lambda found: f'"{folder / found[1]}"', text)
    path = folder / name
    path.write_text(text.replace("7447", str(port)).replace("0.0.0.0", "127.0.0.1"))
    return path


@pytest.mark.slow
def test_the_examples_let_a_listed_certificate_read_and_no_more(
    left: FakeSensor, tmp_path: Path
) -> None:
    certificates(tmp_path, "arm", "desk", "stranger")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
    robot = example("zenoh_robot.json5", tmp_path, port)
    desk = example("zenoh_desk.json5", tmp_path, port)
    stranger = tmp_path / "stranger.json5"
    stranger.write_text(desk.read_text().replace("desk.", "stranger."))
    bridge = LoggedProcess(*ZENOH, "--from", left.address, "--robot", "arm", "--config", robot)
    try:
        with zenoh.open(zenoh.Config.from_file(str(desk))) as allowed:
            samples = Samples(allowed, "tactomo/**")
            samples.until(lambda: samples.all, left.publish)
            tokens = [t for t in allowed.liveliness().get("tactomo/*/*") if t.ok]
            assert [str(t.ok.key_expr) for t in tokens if t.ok] == ["tactomo/arm/left"]
            assert [r for r in allowed.get("tactomo/arm/left/contacts") if r.ok]
            with (
                zenoh.open(zenoh.Config.from_file(str(stranger))) as other,
                zenoh.open(zenoh.Config.from_file(str(desk))) as witness,
            ):
                nothing = Samples(other, "tactomo/arm/left/contacts")
                seen = Samples(witness, "tactomo/**")
                heard = len(samples.all)
                forged = msgpack.packb({"forged": True})
                for liar in (other, allowed):
                    liar.put("tactomo/arm/left/map", forged, encoding=ENCODING, attachment="1")
                samples.until(lambda: len(samples.all) > heard + 3 and seen.all, left.publish)
                assert not nothing.all
                assert seen.all
                assert not [fields for _, fields, _ in seen.all if "forged" in fields]
                assert not [r for r in other.get("tactomo/**") if r.ok]
            plain = zenoh.Config.from_file(str(desk))
            plain.insert_json5("connect/endpoints", f'["tcp/localhost:{port}"]')
            plain.insert_json5("connect/timeout_ms", "500")
            with pytest.raises(zenoh.ZError):
                zenoh.open(plain)
    finally:
        bridge.end()


def test_the_pages_program_prints_touches_and_who_is_there(
    left: FakeSensor, configuration: Configure, tmp_path: Path
) -> None:
    page = Page("docs/fleet.md")
    assert "tactomo zenoh --from tcp://127.0.0.1:5560 --robot arm" in page.commands()
    script = tmp_path / "touched.py"
    script.write_text(page.file("touched.py"))
    endpoint = {"endpoints": [f"unixsock-stream/{tmp_path / 'zenoh'}"]}
    bridge = LoggedProcess(
        *ZENOH, "--from", left.address, "--robot", "arm", "--config", configuration(listen=endpoint)
    )
    client = configuration(mode="client", connect=endpoint)
    command = [sys.executable, "-I", "-u", str(script), str(client)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        said: set[str] = set()
        with repeated(lambda: left.publish(TOUCH)):
            while len(said) < 2:  # it says a touch as often as it comes
                said.add(process.stdout.readline().strip())
        process.kill()
    bridge.end()
    assert said == {"tactomo/arm/left is there", "tactomo/arm/left/contacts 10, 0 mm"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        ([], 2, "give either --from or --bind"),
        (["--from", "ipc:///tmp/a", "--bind", "ipc:///tmp/b"], 2, "give either --from or --bind"),
        (["--from", "ipc:///tmp/none", "--robot", "a/b"], 2, "'a/b' is not a sensor name"),
        (
            ["--config", "LOCAL", "--from", "ipc:///tmp/a", "--from", "x"],
            1,
            "cannot connect to 'x'",
        ),
        (["--bind", "tcp://0.0.0.0:5570", "--config", "LOCAL"], 1, "reached from other computers"),
        (["--bind", "ipc:///tmp/x", "--config", "BAD"], 1, "unknown field `mod`"),
        (["--bind", "ipc:///tmp/x", "--config", "BUSY"], 1, "Zenoh cannot be opened"),
    ],
)
def test_what_cannot_be_done_says_why(
    arguments: list[str], status: int, said: str, configuration: Configure
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as busy:
        endpoint = f"tcp/127.0.0.1:{busy.getsockname()[1]}"
        files = {
            "LOCAL": configuration(listen={"endpoints": []}),
            "BAD": configuration(mod=3),
            "BUSY": configuration(listen={"endpoints": [endpoint]}),
        }
        words = [str(files.get(word, word)) for word in arguments]
        command = [sys.executable, "-m", "tactomo.cli", "zenoh", *words]
        outcome = subprocess.run(command, capture_output=True, text=True, check=False)
    told = " ".join(outcome.stderr.replace("│", " ").split())
    assert said in told
    assert outcome.returncode == status
    assert "Traceback" not in told
