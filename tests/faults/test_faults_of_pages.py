"""A web page of somebody else, in a real browser on the robot's computer or a desk beside it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zmq
from daemon_process import DaemonProcess
from hostile_page import SUBSCRIBE, Attacker, HostileSite
from pty_skin import PtySkin
from selenium import webdriver
from tactomo.stream import keys as key_files
from tactomo_client import request
from tactomo_client.messages import encode_request
from viewer_process import viewer_process
from waiting import PATIENCE_S, wait_until
from whole_system import SENSOR, running_demo

Start = Callable[..., DaemonProcess]
Figure = Callable[[str], None]
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


@contextmanager
def bridge(stream: str) -> Iterator[str]:
    """Serve a sensor to Foxglove; gives the address."""
    command = [*(sys.executable, "-m", "tactomo.cli", "foxglove", SENSOR, "--announce")]
    options = ["--stream", stream, "--foxglove-port", "0"]
    with subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = next((line for line in process.stdout if line.startswith("{")), "{}")
        try:
            yield json.loads(line)["url"]
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(PATIENCE_S)


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.fault(
    "A hostile page: a browser shows a page of another port of this computer",
    "the page reads nothing, commands nothing and presses nothing",
    "headless Chromium; POSTs that read as ZeroMQ messages, and reach a socket without a guard, to "
    "the stream and the control sockets of daemon and twin; websockets to the viewer and the "
    "Foxglove bridge; the viewer's page read",
)
def test_a_hostile_page(attacker: Attacker, figure: Figure) -> None:
    with running_demo() as demo, bridge(demo.stream) as url:
        before = request("status", demo.control, PATIENCE_S)
        attacker.post(demo.control, SET_TIER)
        attacker.post(demo.stream, [SUBSCRIBE])
        attacker.post(demo.twin, PRESS)
        sockets = {
            "the viewer's": demo.page.replace("http", "ws") + "socket",
            "the bridge's": url,
        }
        opened = [name for name, at in sockets.items() if attacker.opens_socket(at, PROTOCOL)]
        is_read = attacker.reads(demo.page)
        after = request("status", demo.control, PATIENCE_S)
        presses = request("scene", demo.twin, PATIENCE_S)["presses"]
    figure(f"3 POSTs: none obeyed; websockets opened: {', '.join(opened) or 'none'}")
    assert after["tier_requested"] == before["tier_requested"]
    assert after["subscribers"] == before["subscribers"]
    assert presses == []
    assert opened == []
    assert not is_read


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.fault(
    "A hostile page, against a daemon and a viewer with keys",
    "likewise",
    "the daemon's sockets on loopback under CURVE, the viewer beside them with a client's keys",
)
def test_a_hostile_page_and_keys(
    attacker: Attacker, skin: PtySkin, start: Start, tmp_path: Path, figure: Figure
) -> None:
    folder, desk = tmp_path / "robot", tmp_path / "desk"
    key_files.make_pair(folder, "left", is_server=True)
    key_files.make_pair(desk, "desk")
    public = key_files.public_path(folder, "left")
    (desk / public.name).write_bytes(public.read_bytes())
    key_files.allow(folder, key_files.public_path(desk, "desk"), "left", may_command=True)
    curve = {
        "secret": str(key_files.secret_path(folder, "left")),
        "clients": str(key_files.clients_folder(folder, "left")),
    }
    daemon = start(skin.paths, curve=curve)

    def status() -> dict[str, Any]:
        return request("status", daemon.control, PATIENCE_S, keys=desk)

    before = wait_until(status)
    attacker.post(daemon.control, SET_TIER)
    attacker.post(daemon.stream, [SUBSCRIBE])
    viewer = viewer_process(stream=daemon.stream, control=daemon.control)
    try:
        assert viewer.stdout is not None
        page = viewer.stdout.readline().split()[-1]
        opened = attacker.opens_socket(page.replace("http", "ws") + "socket")
        is_read = attacker.reads(page)
    finally:
        viewer.terminate()
        viewer.communicate()
    after = status()
    figure(f"2 POSTs: none obeyed; the viewer's websocket {'opened' if opened else 'refused'}")
    assert after["tier_requested"] == before["tier_requested"]
    assert after["subscribers"] == before["subscribers"]
    assert not opened
    assert not is_read
