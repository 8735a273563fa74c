"""The live bridge: a sensor on a real socket on one side, Foxglove's protocol on the other."""

from __future__ import annotations

import json
import queue
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from foxglove_client import PROTOCOL, FoxgloveClient
from fuzz_targets import ENVELOPE
from recorded_grasp import contacts_of, images_of
from tactomo.cli.children import ProcessGroup
from tactomo.imaging.frames import description_fields
from tactomo_client import Contact, MessageError
from tactomo_client.fake import FakeSensor
from tactomo_client.messages import encode_message
from tactomo_foxglove import Bridge, BridgeError
from tactomo_models import load_description
from variants import variant
from waiting import PATIENCE_S, repeated

PRESSED = 50
DESCRIPTION = description_fields(load_description("paper_square"))
ALL = {"sheet", "contacts", "surface", "grid", "frame", "events"}
STATUS: Mapping[str, Any] = {
    "issues": [{"severity": "error", "what": "it hums", "next_step": "oil it"}],
    "state": "running",
    "description": DESCRIPTION,
}


class Publishing:
    """A sensor that publishes the same frame again and again unless it is paused."""

    def __init__(self, sensor: FakeSensor) -> None:
        self.sensor = sensor
        self.paused = False
        self.also: queue.SimpleQueue[bytes] = queue.SimpleQueue()  # the socket is its thread's

    def say(self) -> None:
        self.sensor.publish_message("status", STATUS)
        while not self.also.empty():
            self.sensor.send(self.also.get())
        if not self.paused:
            images: Mapping[str, Any] = images_of(PRESSED)
            self.sensor.publish(contacts_of(PRESSED), **images)


@contextmanager
def publishing(sensor: FakeSensor) -> Iterator[Publishing]:
    source = Publishing(sensor)
    with repeated(source.say, 0.01):
        yield source


@contextmanager
def bridged(stream: str, **options: Any) -> Iterator[Bridge]:
    stop = threading.Event()
    with Bridge(["left"], stream, port=0, **options) as bridge:
        thread = threading.Thread(target=bridge.run, args=(stop,))
        thread.start()
        try:
            yield bridge
        finally:
            stop.set()
            thread.join()


@pytest.fixture
def source(sensor: FakeSensor) -> Iterator[Publishing]:
    with publishing(sensor) as source:
        yield source


@pytest.fixture
def client(source: Publishing) -> Iterator[FoxgloveClient]:
    with bridged(source.sensor.address) as bridge, FoxgloveClient(bridge.url) as client:
        yield client


def words_of(scene: Any) -> str:
    return " ".join(text.text for entity in scene.entities for text in entity.texts)


def test_it_advertises_its_topics_and_the_sheet_lies_in_the_world(client: FoxgloveClient) -> None:
    assert set(client.channels) == {"/tf", *(f"/left/{name}" for name in ALL)}
    assert all(channel["schema"] for channel in client.channels.values())
    numbers = json.loads(client.channels["/left/frame"]["schema"])["properties"]
    contact = numbers["contacts"]["items"]["properties"]
    assert contact["taught"] == {"type": "boolean"}
    kinds = {topic: channel["schemaName"] for topic, channel in client.channels.items()}
    assert kinds["/left/contacts"] == "foxglove.SceneUpdate"
    assert kinds["/left/grid"] == "foxglove.Grid"
    assert kinds["/left/events"] == "foxglove.Log"
    transform = client.wait("/tf").transforms[0]
    sheet = client.wait("/left/sheet").entities[0]
    assert (transform.parent_frame_id, transform.child_frame_id) == ("world", "left")
    assert (transform.translation.x, transform.rotation.w) == (0.0, 1.0)
    assert len(sheet.cubes) == 16
    assert max(point.x for point in sheet.lines[0].points) == pytest.approx(0.075)


def test_contacts_are_discs_as_high_as_the_pressure(client: FoxgloveClient) -> None:
    firm, _ = contacts_of(PRESSED)
    assert firm.pressure_kpa is not None
    scene = client.wait("/left/contacts", lambda scene: len(scene.entities) == 2)
    one, other = (entity.cylinders[0] for entity in scene.entities)
    assert one.pose.position.x == pytest.approx(firm.x_mm * 1e-3)
    assert one.pose.position.y == pytest.approx(firm.y_mm * 1e-3)
    assert np.pi / 4 * one.size.x**2 == pytest.approx(firm.area_mm2 * 1e-6)
    assert one.size.z == pytest.approx(firm.pressure_kpa / 300.0 * 0.25 * 0.15)
    assert other.size.z == pytest.approx(0.001)
    assert f"1: {firm.pressure_kpa:.0f} ± 2 kPa" in words_of(scene)
    assert "touched, pressure unknown" in words_of(scene)
    assert scene.deletions[0].type == 1  # all that were there before
    assert {e.frame_id for e in scene.entities} == {"left"}


def test_a_mounted_sheet_is_drawn_on_its_surface(sensor: FakeSensor) -> None:
    mount = {"frame": "arm", "cylinder": {"radius_m": 0.05}}
    sheet = description_fields(variant(load_description("paper_square"), mount=mount))
    status = {**STATUS, "description": sheet}
    up: dict[str, Any] = {"position_m": (0.05, 0.0, 0.01), "normal": (1.0, 0.0, 0.0)}
    contact = Contact(1, 0.0, 10.0, 700.0, 0.1, 0.01, 170.0, force_n=8.0, frame="arm", **up)
    image = np.zeros((51, 51), np.float32)

    def say() -> None:
        sensor.publish_message("status", status)
        sensor.publish([contact], map=image, structure=image)

    with bridged(sensor.address) as bridge, FoxgloveClient(bridge.url) as client:
        sensor.wait_for_subscriber()
        with repeated(say):
            tf = client.wait("/tf", lambda tf: tf.transforms[0].child_frame_id == "arm")
            scene = client.wait("/left/contacts", lambda scene: bool(scene.entities))
            surface = client.wait("/left/surface", lambda _: True)
            drawn = client.wait("/left/sheet", lambda _: True)
    (entity,) = scene.entities
    arrow, disc = entity.arrows[0].pose, entity.cylinders[0]
    assert entity.frame_id == "arm"
    assert arrow.position.x > 0.06
    assert arrow.position.z == pytest.approx(0.01)
    q = arrow.orientation
    along = (1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.z * q.w), 2 * (q.x * q.z - q.y * q.w))
    assert along == pytest.approx((-1, 0, 0), abs=1e-9)  # into the sheet
    assert disc.pose.position.x - disc.size.z / 2 == pytest.approx(0.05)
    (triangles,) = surface.entities[0].triangles
    assert len(triangles.indices) == 50 * 50 * 6
    outline = drawn.entities[0].lines[0].points
    for point in (*triangles.points, *outline):
        assert np.hypot(point.x, point.y) == pytest.approx(0.05, rel=0.01)
    assert drawn.entities[0].frame_id == "arm"
    assert tf.transforms[0].parent_frame_id == "world"


def test_the_grid_has_the_numbers_and_lies_where_the_map_is(client: FoxgloveClient) -> None:
    types = {1: "u1", 7: "<f4"}

    def cells_of(grid: Any) -> Any:
        kind = np.dtype([(field.name, types[field.type]) for field in grid.fields])
        return np.frombuffer(grid.data, kind).reshape(51, 51)

    def is_coloured(grid: Any) -> bool:  # grey is for what is old
        return bool((cells_of(grid)["red"] != cells_of(grid)["blue"]).any())

    grid = client.wait("/left/grid", is_coloured)
    names = [field.name for field in grid.fields]
    assert names == ["red", "green", "blue", "alpha", "pressure_kpa", "magnitude", "structure"]
    cells = cells_of(grid)
    np.testing.assert_array_equal(cells["pressure_kpa"], images_of(PRESSED)["pressure_kpa"])
    np.testing.assert_array_equal(cells["structure"], images_of(PRESSED)["structure"])
    assert grid.row_stride == 51 * grid.cell_stride == 51 * cells.itemsize
    assert grid.pose.position.x + grid.cell_size.x / 2 == pytest.approx(-0.075)
    assert grid.cell_size.y == pytest.approx(0.003)
    assert (cells["alpha"] == 255).all()


def test_numbers_to_plot_and_what_the_daemon_finds_wrong(
    source: Publishing, client: FoxgloveClient
) -> None:
    firm, _ = contacts_of(PRESSED)
    numbers = client.wait("/left/frame", lambda m: "period_ms" in m)
    assert numbers["contact_count"] == 2
    assert numbers["contacts"][0]["pressure_kpa"] == firm.pressure_kpa
    assert numbers["contacts"][1]["pressure_range"] == "below"
    assert "pressure_kpa" not in numbers["contacts"][1]  # unknown, so it is left out
    assert numbers["force_n"] == firm.force_n
    assert numbers["misfit"] == 1.0
    assert 0 <= numbers["age_ms"] < 20_000
    client.wait_said(lambda said: said["op"] == "status" and said["message"] == "it hums: oil it")
    source.also.put(b"left/map\0nonsense")  # what breaks the rules is skipped
    source.also.put(encode_message("left", "map", {**ENVELOPE, "contacts": "none"}))
    event = {"name": "port_lost", "severity": "error", "detail": "unplugged", "next_step": "plug"}
    source.also.put(encode_message("left", "event", {**ENVELOPE, **event}))
    line = client.wait("/left/events")
    assert (line.level, line.name, line.file) == (4, "left", "port_lost")
    assert line.message == "port_lost: unplugged -> plug"
    client.wait("/left/frame", anew=True)


def test_old_data_are_shown_as_old_until_new_ones_come(
    source: Publishing, client: FoxgloveClient
) -> None:
    client.wait("/left/grid")
    source.paused = True
    scene = client.wait("/left/contacts", lambda scene: "STALE" in words_of(scene))
    assert len(scene.entities) == 3  # the contacts are still there, and grey
    colour = scene.entities[0].cylinders[0].color
    assert colour.r == colour.g == colour.b
    warning = client.wait_said(lambda said: said["op"] == "status" and "STALE" in said["message"])
    assert "the daemon says: running" in warning["message"]
    source.paused = False
    client.wait_said(lambda said: said["op"] == "removeStatus")
    scene = client.wait("/left/contacts", lambda s: len(s.entities) == 2, anew=True)
    assert "STALE" not in words_of(scene)


@pytest.mark.slow
def test_it_says_when_no_daemon_answers() -> None:
    with bridged("tcp://127.0.0.1:9") as bridge, FoxgloveClient(bridge.url) as client:
        warning = client.wait_said(lambda said: said["op"] == "status")
        assert "no daemon answers" in warning["message"]


def test_the_daemon_may_be_restarted(sensor: FakeSensor) -> None:
    with bridged(sensor.address) as bridge, FoxgloveClient(bridge.url) as client:
        with publishing(sensor):
            first = client.wait("/left/frame")["session"]
        sensor.close()
        with FakeSensor("left", sensor.address) as again, publishing(again):
            later = client.wait("/left/frame", lambda m: m["session"] != first)
    assert later["missed_frames"] == 0


@pytest.mark.slow
def test_who_does_not_read_holds_up_nobody(sensor: FakeSensor) -> None:
    with (
        bridged(sensor.address) as bridge,
        publishing(sensor),
        FoxgloveClient(bridge.url, reads=False),
        FoxgloveClient(bridge.url) as client,
        FoxgloveClient(bridge.url) as other,
    ):
        for _ in range(100):  # some 5 MB
            client.wait("/left/grid", anew=True)
        assert client.wait("/left/frame", anew=True)["age_ms"] < 20_000
        other.wait("/left/frame", anew=True)


def test_an_address_that_is_taken(sensor: FakeSensor) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(BridgeError, match=r"Address already in use.*--foxglove-port"):
            Bridge(["left"], sensor.address, port=taken.getsockname()[1])
    with pytest.raises(BridgeError, match="cannot listen on nowhere"):
        Bridge(["left"], sensor.address, host="nowhere.invalid", port=0)
    with pytest.raises(MessageError):
        Bridge(["no sensor"], sensor.address, port=0)


def test_the_command_serves_until_it_is_stopped(sensor: FakeSensor, tmp_path: Path) -> None:
    layout = tmp_path / "left.json"
    with ProcessGroup() as group:
        bridge = group.start(
            *("bridge", "foxglove", "left", "--address", sensor.address, "--announce"),
            *("--foxglove-port", "0", "--layout", str(layout)),
        )
        url = bridge.wait_ready()["url"]
        with publishing(sensor), FoxgloveClient(url) as client:
            client.wait("/left/frame")
            bridge.stop(PATIENCE_S)
        assert bridge.status == 0
    assert "/left/contacts" in layout.read_text()


def test_without_the_extra(tactomo: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    result = tactomo("foxglove", status=1)
    assert "pip install 'tactomo[foxglove]'" in result.stderr


APP = "https://app.foxglove.dev"
MINE = "http://localhost:8080"


def answer_to(url: str, **headers: str) -> int:
    """Ask for a websocket as a browser does for a page; return the status of the answer."""
    where = urlsplit(url)
    connection = HTTPConnection(where.hostname or "", where.port, timeout=PATIENCE_S)
    upgrade = {
        **{"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"},
        **{"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol": PROTOCOL},
    }
    connection.request("GET", "/", headers={**upgrade, **headers})
    status = connection.getresponse().status
    connection.close()
    return status


def test_a_page_from_elsewhere_may_not_look(source: Publishing) -> None:
    """Only Foxglove's own pages and `MINE` may; nor is a name served that was made to lead here."""
    with bridged(source.sensor.address, origins=[MINE]) as bridge:
        for origin in (APP, MINE, "file://", "foxglove://app"):
            assert answer_to(bridge.url, Origin=origin) == 101, origin
        evil = ("http://127.0.0.1:8000", "null", f"{APP}.evil.example", "HTTP://evil.example")
        for origin in (*evil, "http:"):
            assert answer_to(bridge.url, Origin=origin) == 403, origin
        for host in ("localhost", "[::1]:8765"):
            assert answer_to(bridge.url, Host=host, Origin=APP) == 101, host
        for host in ("evil.example", "", "["):
            assert answer_to(bridge.url, Host=host, Origin=APP) == 403, host


@pytest.mark.slow
def test_what_is_no_request_goes_no_further(source: Publishing) -> None:
    with bridged(source.sensor.address) as bridge, FoxgloveClient(bridge.url) as client:
        where = urlsplit(bridge.url)
        address = where.hostname, where.port
        for head in (b"\0" * 20, b"GET / HTTP/1.1\r\n\r\n", b"x" * 100_000):
            with socket.create_connection(address, PATIENCE_S) as line, suppress(ConnectionError):
                line.sendall(head)
                assert b"101" not in line.recv(100)
            client.wait("/left/contacts", anew=True)
