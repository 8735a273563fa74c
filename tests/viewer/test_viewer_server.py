"""The viewer's server, seen from a page's websocket: real sockets on all its sides."""

from __future__ import annotations

import asyncio
import functools
import json
import re
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from importlib import resources
from pathlib import Path
from typing import Any, ParamSpec

import aiohttp
import numpy as np
import pytest
import tactomo_viewer
from aiohttp.test_utils import TestClient, TestServer
from fake_control import FakeControl
from tactomo_client import ClientError, Contact
from tactomo_client.fake import FakeSensor
from tactomo_viewer import ViewerError

CONTACT = Contact(2, 12.0, -30.0, 707.0, 0.18, 0.01, None)
RAMP = np.tile(np.linspace(0, 1, 51, dtype=np.float32), (51, 1))
NOBODY = "tcp://127.0.0.1:1"

P = ParamSpec("P")
Message = dict[str, Any]


def on_loop(test: Callable[P, Coroutine[Any, Any, None]]) -> Callable[P, None]:
    @functools.wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        asyncio.run(asyncio.wait_for(test(*args, **kwargs), 90))

    return run


class Page:
    """An open page: reads what comes and confirms frames as `link.js` does."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse, confirms: bool = True) -> None:
        self.socket = socket
        self.confirms = confirms
        self.frames: list[int] = []
        self.hello: Message = {}

    async def next(self, kind: str) -> Message:
        """Return the next message of this kind."""
        while True:
            message = await self.socket.receive(timeout=30)
            assert message.type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY), message
            content = parse(message.data)
            if content["type"] == "frame":
                self.frames.append(content["sequence"])
                if self.confirms:
                    await self.socket.send_json({"type": "confirm"})
            if content["type"] == kind:
                return content

    async def frame(self, sequence: int) -> Message:
        """Return the frame of this number."""
        while (frame := await self.next("frame"))["sequence"] != sequence:
            pass
        return frame

    async def ask(self, **question: Any) -> Message:
        """Ask something and return the reply."""
        await self.socket.send_json({"request": 7, **question})
        while (reply := await self.next("reply"))["request"] != 7:
            pass
        return reply


def parse(data: str | bytes) -> Message:
    if isinstance(data, str):
        message: Message = json.loads(data)
        return message
    length = int.from_bytes(data[:4], "little")
    assert length % 4 == 0
    frame: Message = json.loads(data[4 : 4 + length])
    values = data[4 + length :]
    for image in frame["images"]:
        size = 4 * image["shape"][0] * image["shape"][1]
        frame[image["name"]] = np.frombuffer(values[:size], "<f4").reshape(image["shape"])
        values = values[size:]
    assert not values
    return frame | {"type": "frame"}


class Viewer:
    """A viewer served at an ephemeral port."""

    def __init__(self, client: TestClient[Any, Any]) -> None:
        self.client = client

    @property
    def origin(self) -> str:
        return str(self.client.make_url("/")).rstrip("/")

    @asynccontextmanager
    async def page(self, confirms: bool = True) -> AsyncIterator[Page]:
        async with self.client.ws_connect("/socket", origin=self.origin) as websocket:
            page = Page(websocket, confirms)
            page.hello = await page.next("hello")
            yield page


@asynccontextmanager
async def viewer_of(
    sensor: FakeSensor, control: str = NOBODY, twin: str | None = None, host: str = "127.0.0.1"
) -> AsyncIterator[Viewer]:
    app = tactomo_viewer.Viewer("left", sensor.address, control, twin, host).app()
    async with TestClient(TestServer(app)) as client:
        topics = {await asyncio.to_thread(sensor.wait_for_subscriber) for _ in range(3)}
        assert topics == {b"left/map\0", b"left/status\0", b"left/event\0"}
        yield Viewer(client)


# What the page gets


@on_loop
async def test_a_frame_comes_whole_and_malformed_messages_are_skipped(sensor: FakeSensor) -> None:
    async with viewer_of(sensor) as viewer, viewer.page() as page:
        sensor.send(b"left/map\0\xc1")
        sensor.send(b"left/status\0")
        sensor.publish_message("map", {"contacts": 7})
        structure = RAMP.T > 0.5
        sensor.publish(
            [CONTACT],
            map=RAMP,
            structure=structure.astype(np.float32),
            flags=["misfit_high"],
            misfit=None,
        )
        frame = await page.frame(2)
        assert page.frames == [2]
        assert [image["name"] for image in frame["images"]] == ["map", "structure"]
        np.testing.assert_array_equal(frame["map"], RAMP)
        np.testing.assert_array_equal(frame["structure"], structure)
        assert frame["contacts"][0]["x_mm"] == 12.0
        assert frame["contacts"][0]["pressure_kpa"] is None
        assert frame["flags"] == ["misfit_high"]
        assert frame["misfit"] is None
        assert (frame["x_mm"], frame["y_mm"]) == ([-75, 75], [-75, 75])
        assert 0 <= frame["age_ms"] < 20_000


@on_loop
async def test_the_age_is_the_one_at_sending(sensor: FakeSensor) -> None:
    async with viewer_of(sensor) as viewer:
        sensor.publish(clock_id="elsewhere", age_ns=2_000_000_000)
        ages_ms = [2000.0]
        while ages_ms[-1] < 2200:
            async with viewer.page() as page:
                ages_ms.append((await page.frame(1))["age_ms"])
        assert ages_ms == sorted(ages_ms)


@on_loop
async def test_a_newcomer_gets_what_there_is(sensor: FakeSensor) -> None:
    async with viewer_of(sensor) as viewer:
        async with viewer.page() as first:
            sensor.publish_message("status", {"state": "running", "loss": float("inf")})
            for name in ("tared", "channel_lost"):
                sensor.publish_message("event", {"name": name, "severity": "info"})
            sensor.publish(map=RAMP)
            await first.frame(1)
        async with viewer.page() as second:
            assert (await second.next("status"))["status"]["loss"] is None
            assert (await second.next("event"))["event"]["name"] == "tared"
            assert (await second.next("event"))["event"]["name"] == "channel_lost"
            await second.frame(1)


@on_loop
async def test_an_event_is_as_old_as_when_it_came(sensor: FakeSensor) -> None:
    async with viewer_of(sensor) as viewer:
        async with viewer.page() as page:
            # The envelope has the time of the newest dual scan: it is of before an outage.
            sensor.publish_message("event", {"name": "port_back", "acquired_realtime_ns": 10**18})
            assert (await page.next("event"))["age_ms"] < 10_000
        await asyncio.sleep(0.2)
        async with viewer.page() as page:
            assert (await page.next("event"))["age_ms"] >= 200


@on_loop
async def test_a_page_that_is_loaded_again_finds_its_own_press_gone(sensor: FakeSensor) -> None:
    with FakeControl({"scene": {"presses": []}, "press": {}, "release": {}}) as twin:
        async with viewer_of(sensor, twin=twin.address) as viewer:
            async with viewer.page() as page, viewer.page() as other:
                await page.ask(type="press", press="idle-0", x_mm=0, y_mm=0)
                (press,) = [asked["id"] for command, asked in twin.requests if command == "press"]
                twin.answers["scene"] = {"presses": [{"id": press}]}
                while not (await other.next("twin"))["others_press"]:
                    pass
            while "release" not in [command for command, _ in twin.requests]:
                await asyncio.sleep(0.01)
            await asyncio.sleep(0.1)
            async with viewer.page() as page:
                assert not (await page.next("twin"))["others_press"]


@pytest.mark.slow
@on_loop
async def test_silence_is_told_from_a_hang(sensor: FakeSensor) -> None:
    async with viewer_of(sensor) as viewer, viewer.page() as page:
        await page.next("alive")
        await page.next("alive")


@on_loop
async def test_a_slow_page_gets_few_frames_and_none_of_them_old(sensor: FakeSensor) -> None:
    async with (
        viewer_of(sensor) as viewer,
        viewer.page(confirms=False) as slow,
        viewer.page() as quick,
    ):
        for sequence in range(1, 31):
            sensor.publish(map=RAMP)
            await quick.frame(sequence)
        assert quick.frames == list(range(1, 31))
        assert (await slow.next("frame"))["sequence"] == 1
        assert (await slow.next("frame"))["sequence"] == 2
        await slow.socket.send_json({"type": "confirm"})
        assert (await slow.next("frame"))["sequence"] == 30


# What the page may do


FORBIDDEN: list[tuple[Message, str]] = [
    ({"type": "command", "command": "shutdown"}, "unknown_command"),
    ({"type": "command", "command": ["tare"]}, "unknown_command"),
    ({"type": "command", "command": "record_start", "arguments": {"path": "/x"}}, "bad_argument"),
    ({"type": "command", "command": "tare", "arguments": 3}, "bad_argument"),
    ({"type": "dance"}, "unknown_command"),
    ({"type": "press", "press": "1", "x_mm": 0, "y_mm": 0}, "no_twin"),
]


@on_loop
async def test_what_a_page_may_not_do_is_refused(sensor: FakeSensor) -> None:
    with FakeControl() as daemon:
        async with viewer_of(sensor, daemon.address) as viewer, viewer.page() as page:
            for question, name in FORBIDDEN:
                reply = await page.ask(**question)
                assert (reply["ok"], reply["error"]["name"]) == (False, name), question
    assert daemon.requests == []


@on_loop
async def test_no_question_breaks_the_socket(sensor: FakeSensor) -> None:
    async with viewer_of(sensor) as viewer, viewer.page() as page:
        for text in ("", "{", "[]", "7", "null", "[" * 10_000, '{"type": "press", "press": {}}'):
            await page.socket.send_str(text)
        await page.socket.send_str('{"type": "command", "command": "\\ud800"}')
        await page.socket.send_bytes(b"\0\xff")
        sensor.publish(map=RAMP)
        await page.frame(1)


# Pressing


@on_loop
async def test_a_page_that_goes_away_lifts_its_presses_but_not_the_held_ones(
    sensor: FakeSensor,
) -> None:
    with FakeControl() as twin:
        async with viewer_of(sensor, twin=twin.address) as viewer, viewer.page() as other:
            await other.ask(type="press", press="1", x_mm=9, y_mm=9)
            async with viewer.page() as page:
                await page.ask(type="press", press="1", x_mm=1, y_mm=1)
                await page.ask(type="press", press="2", x_mm=2, y_mm=2)
                await page.ask(type="press", press="2", x_mm=2, y_mm=2, hold=True)
            released: list[str] = []
            while not released:
                await asyncio.sleep(0.01)
                released = [a["id"] for command, a in twin.requests if command == "release"]
            names = {a["x_mm"]: a["id"] for command, a in twin.requests if command == "press"}
            assert released == [names[1]]
            assert len(set(names.values())) == 3


@pytest.mark.slow
@on_loop
async def test_the_page_hears_when_the_twin_comes_and_goes(
    sensor: FakeSensor, tmp_path: Path
) -> None:
    twin = FakeControl(address=f"ipc://{tmp_path}/twin")  # a port may be another's meanwhile
    async with viewer_of(sensor, twin=twin.address) as viewer, viewer.page() as page:
        while not (await page.next("twin"))["answers"]:
            pass  # a busy computer may take longer for the first answer than is waited for
        twin.close()
        assert (await page.next("twin"))["answers"] is False
        with FakeControl(address=twin.address):
            assert (await page.next("twin"))["answers"] is True


@on_loop
async def test_served_to_others_it_only_shows(sensor: FakeSensor) -> None:
    with FakeControl() as daemon, FakeControl() as twin:
        async with (
            viewer_of(sensor, daemon.address, twin.address, host="0.0.0.0") as viewer,
            viewer.page() as page,
        ):
            assert page.hello["read_only"] is True
            reply = await page.ask(type="command", command="tare")
            assert reply["error"]["name"] == "read_only"
            reply = await page.ask(type="press", press="1", x_mm=0, y_mm=0)
            assert reply["error"]["name"] == "read_only"
            sensor.publish(map=RAMP)
            await page.frame(1)
    assert daemon.requests == twin.requests == []


# Who may ask


@on_loop
async def test_a_foreign_name_or_page_is_turned_away(sensor: FakeSensor) -> None:
    ours = (None, "localhost:8750", "[::1]:8750", "192.168.7.2")
    foreign = ("evil.example", "127.0.0.1.evil.example:8750", "localhost.evil.example", "[")
    origins = (None, "null", "https://evil.example", "http://127.0.0.1:1", "http://[x")
    async with viewer_of(sensor) as viewer:
        for host in (*ours, *foreign):
            headers = {} if host is None else {"Host": host}
            async with viewer.client.get("/", headers=headers) as response:
                assert response.status == (200 if host in ours else 403), host
        for origin in origins:
            with pytest.raises(aiohttp.WSServerHandshakeError) as caught:
                await viewer.client.ws_connect("/socket", origin=origin)
            assert caught.value.status == 403, origin


@on_loop
async def test_the_page_brings_everything_itself(sensor: FakeSensor) -> None:
    names = [file.name for file in (resources.files("tactomo_viewer") / "page").iterdir()]
    assert {"index.html", "viewer.js", "viewer.css"} <= set(names)
    async with viewer_of(sensor) as viewer:
        for name in names:
            async with viewer.client.get("/" if name == "index.html" else f"/{name}") as response:
                assert response.status == 200
                assert "script-src 'self'" in response.headers["Content-Security-Policy"]
                text = await response.text()
            foreign = re.findall(r"https?://[^\s'\"]+", text)
            # Names of XML's languages, which nobody fetches.
            assert set(foreign) <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xhtml"}
            for wanted in re.findall(r"""(?:from |src=|href=)["']\.?/?([\w.]+\.\w+)["']""", text):
                assert wanted in names


# Starting and stopping


PROGRAM = """
import json, sys, tactomo_viewer
tactomo_viewer.Viewer("left", **json.loads(sys.argv[1])).serve(0)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_prints_its_address_and_stops_when_told_though_pages_are_open(
    sensor: FakeSensor, number: signal.Signals
) -> None:
    viewer = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, json.dumps({"stream": sensor.address})],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert viewer.stdout is not None
    try:
        line = viewer.stdout.readline()
        assert re.fullmatch(r"viewer: http://127\.0\.0\.1:[1-9]\d*/\n", line)
        url = line.split()[-1]

        async def stop_under_a_page() -> None:
            async with (
                aiohttp.ClientSession() as session,
                session.ws_connect(url + "socket", origin=url.rstrip("/")) as websocket,
            ):
                await websocket.receive()
                viewer.send_signal(number)
                while not websocket.closed:
                    await websocket.receive(timeout=60)
                assert websocket.close_code == aiohttp.WSCloseCode.GOING_AWAY

        asyncio.run(stop_under_a_page())
        output, errors = viewer.communicate(timeout=60)
        assert (viewer.returncode, output, errors) == (0, "", "")
    finally:
        viewer.kill()
        viewer.communicate()


def test_a_port_in_use_says_what_to_do() -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = holder.getsockname()[1]
        with pytest.raises(
            ViewerError, match=rf"cannot listen on 127.0.0.1 port {port}.*--viewer-port"
        ):
            tactomo_viewer.Viewer("left", NOBODY).serve(port)


def test_where_no_port_is_asked_for_the_next_free_one_is_taken() -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        taken = holder.getsockname()[1]
        program = (
            f"from tactomo_viewer import server; server.DEFAULT_PORT = {taken}; "
            f"server.Viewer('left', {NOBODY!r}).serve()"
        )
        with subprocess.Popen(
            [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True
        ) as viewer:
            assert viewer.stdout is not None
            port = int(viewer.stdout.readline().rstrip("/\n").rpartition(":")[2])
            viewer.terminate()
        assert taken < port <= taken + 20


def test_a_mistake_is_explained() -> None:
    for sensor, given, message in (
        ("left", {"stream": "nonsense"}, "cannot connect to 'nonsense'"),
        ("left", {"host": "203.0.113.1"}, "cannot listen on 203.0.113.1"),
        ("left arm", {}, "'left arm' is not a sensor name"),
    ):
        with pytest.raises(ClientError, match=message):
            tactomo_viewer.Viewer(sensor, **{"stream": NOBODY, **given}).serve(0)  # type: ignore[arg-type]
