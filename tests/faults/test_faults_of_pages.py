"""A web page of somebody else, in a real browser on the robot's computer or a desk beside it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from fixture_types import Figure
from hostile_page import SUBSCRIBE, Attacker, HostileSite
from selenium import webdriver
from tactomo.cli.children import ProcessGroup
from tactomo.stream import keys as key_files
from tactomo_client import request
from tactomo_client.messages import encode_request
from waiting import PATIENCE_S
from whole_system import ANYWHERE, SENSOR

SET_TIER = [b"", encode_request("set_tier", {"tier": "noser"})]
PRESS = [b"", encode_request("press", {"x_mm": 0.0, "y_mm": 0.0})]
PROTOCOL = "foxglove.sdk.v1"


@pytest.fixture
def attacker(browser: webdriver.Chrome) -> Iterator[Attacker]:
    """A hostile page that is known to reach a socket without a guard."""
    site = HostileSite()
    page = Attacker(browser, site)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    unguarded = context.socket(zmq.ROUTER)
    port = unguarded.bind_to_random_port("tcp://127.0.0.1", min_port=32_768, max_port=60_999)
    page.post(f"tcp://127.0.0.1:{port}", SET_TIER)
    got = [unguarded.recv_multipart() for _ in range(10) if unguarded.poll(200)]
    unguarded.close(0)
    context.term()
    assert SET_TIER[1] in [parts[-1] for parts in got], "the attack itself fails"
    yield page
    site.close()


def a_clients_keys(robot: Path, desk: Path) -> list[str]:
    """Make a daemon's keys and those of a client who may command; gives the daemon's options."""
    key_files.make_pair(robot, SENSOR, is_server=True)
    key_files.make_pair(desk, "desk")
    public = key_files.public_path(robot, SENSOR)
    (desk / public.name).write_bytes(public.read_bytes())
    key_files.allow(robot, key_files.public_path(desk, "desk"), SENSOR, may_command=True)
    secret, clients = key_files.secret_path(robot, SENSOR), key_files.clients_folder(robot, SENSOR)
    return [*("--set", f'curve.secret="{secret}"'), *("--set", f'curve.clients="{clients}"')]


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.parametrize("keys", ["without", "with"])
@pytest.mark.fault(
    "A hostile page: a browser shows a page of another port of this computer; {keys} keys",
    "the page can neither read, command nor press",
    "headless Chromium; POSTs that parse as ZeroMQ messages, to the daemon's and the twin's "
    "sockets; websockets to the viewer and the Foxglove bridge; a read of the viewer's page. "
    "With keys, the daemon's sockets need keys, and viewer and bridge have a client's keys; the"
    " twin takes none",
)
def test_a_hostile_page(attacker: Attacker, tmp_path: Path, figure: Figure, keys: str) -> None:
    robot, desk = tmp_path / "robot", tmp_path / "desk"
    under = a_clients_keys(robot, desk) if keys == "with" else []
    ours = ["--keys", str(desk)] if under else []
    with ProcessGroup() as group:
        skin = group.start(
            *("twin", "twin", "--link", str(tmp_path), "--twin-control", ANYWHERE, "--announce")
        ).wait_ready()
        lines = [word for path in skin["ports"] for word in ("--port", path)]
        daemon = group.start(
            *("daemon", "daemon", "--sensor", SENSOR, *lines, *under),
            *("--stream", ANYWHERE, "--control", ANYWHERE),
        ).wait_ready()
        stream, control, twin = daemon["stream"], daemon["control"], skin["control"]

        def status() -> dict[str, Any]:
            return request("status", control, PATIENCE_S, keys=desk if ours else None)

        before = status()
        attacker.post(control, SET_TIER)
        attacker.post(stream, [SUBSCRIBE])
        attacker.post(twin, PRESS)
        after = status()
        is_obeyed = [
            after["tier_requested"] != before["tier_requested"],
            after["subscribers"] != before["subscribers"],
            request("scene", twin, PATIENCE_S)["presses"] != [],
        ]
        page = group.start(
            *("viewer", "viewer", "--sensor", SENSOR, "--viewer-port", "0", *ours),
            *("--address", stream, "--control", control, "--twin-control", twin),
        ).wait_ready()["url"]
        bridge = group.start(
            *("bridge", "foxglove", SENSOR, "--foxglove-port", "0", "--announce", *ours),
            *("--address", stream),
        ).wait_ready()["url"]
        sockets = {"the viewer's": page.replace("http", "ws") + "socket", "the bridge's": bridge}
        opened = [name for name, at in sockets.items() if attacker.opens_socket(at, PROTOCOL)]
        is_read = attacker.reads(page)
    figure(
        f"{sum(is_obeyed)} of {len(is_obeyed)} POSTs obeyed; websockets opened: "
        f"{', '.join(opened) or 'none'}; the page {'read' if is_read else 'not read'}"
    )
    assert not any(is_obeyed)
    assert opened == []
    assert not is_read
