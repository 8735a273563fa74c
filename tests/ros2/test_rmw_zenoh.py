"""`tactomo ros2`: a node of rmw_zenoh, as a Zenoh session sees it that is none of ours.

What it must look like is written out here from rmw_zenoh's design page; hashes of types are those
of ROS 2 Kilted's own packages. rmw_zenoh itself comes with a ROS installation alone.
"""

from __future__ import annotations

import json
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from recorded_grasp import contacts_of, images_of
from rosbags.typesys import Stores, get_typestore
from tactomo_client.fake import FakeSensor
from waiting import PATIENCE_S, wait_until

PRESSED = 50
DOMAIN = 7
CLOUD = "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
WRENCH = "RIHS01_8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
Samples = list[zenoh.Sample]


def decoded(kind: str, data: bytes) -> Any:
    """Decode CDR by a library that did not write it."""
    text, _ = get_typestore(Stores.ROS2_KILTED).generate_msgdef(kind, ros_version=2)
    decode = DecoderFactory().decoder_for("cdr", Schema(1, text.encode(), "ros2msg", kind))
    assert decode is not None
    return decode(data)


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[zenoh.Session]:
    """A Zenoh router at a file, in a folder that holds what connects to it, too."""
    at = {"endpoints": [f"unixsock-stream/{tmp_path / 'router'}"]}
    quiet = {"scouting": {"multicast": {"enabled": False}}}
    (tmp_path / "router.json5").write_text(json.dumps({"mode": "router", "listen": at, **quiet}))
    (tmp_path / "node.json5").write_text(json.dumps({"mode": "client", "connect": at, **quiet}))
    session = zenoh.open(zenoh.Config.from_file(str(tmp_path / "router.json5")))
    yield session
    session.close()  # type: ignore[no-untyped-call]


@pytest.fixture
def sensor() -> Iterator[FakeSensor]:
    with FakeSensor("left") as fake:
        yield fake


def start(sensor: FakeSensor, config: Path) -> subprocess.Popen[str]:
    command = (
        *(sys.executable, "-m", "tactomo.cli", "ros2", "left", "--stream", sensor.address),
        *("--domain", str(DOMAIN), "--config", str(config)),
    )
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.fixture
def node(tmp_path: Path, sensor: FakeSensor) -> Iterator[subprocess.Popen[str]]:
    with start(sensor, tmp_path / "node.json5") as process:
        assert process.stdout is not None
        assert "/left/map" in process.stdout.readline()
        yield process
        process.kill()


def heard(session: zenoh.Session, key: str) -> Samples:
    samples: Samples = []
    session.declare_subscriber(key, samples.append)
    return samples


def test_messages_are_cdr_under_the_keys_of_rmw_zenoh(
    graph: zenoh.Session, sensor: FakeSensor, node: subprocess.Popen[str]
) -> None:
    maps = heard(graph, f"{DOMAIN}/left/map/sensor_msgs::msg::dds_::PointCloud2_/{CLOUD}")
    wrenches = heard(
        graph, f"{DOMAIN}/left/contact_wrenches/geometry_msgs::msg::dds_::WrenchStamped_/{WRENCH}"
    )
    images: dict[str, Any] = images_of(PRESSED)

    def publish() -> None:
        sensor.publish(contacts_of(PRESSED), **images)

    wait_until(lambda: len(maps) > 1 and len(wrenches) > 1, meanwhile=publish, step_s=0.02)
    cloud = decoded("sensor_msgs/msg/PointCloud2", maps[0].payload.to_bytes())
    assert (cloud.height, cloud.width, cloud.header.frame_id) == (51, 51, "left")
    wrench = decoded("geometry_msgs/msg/WrenchStamped", wrenches[0].payload.to_bytes())
    assert wrench.wrench.force.z == -(contacts_of(PRESSED)[0].force_n or 0.0)
    numbers = [attachment(sample) for sample in maps[:2]]
    assert numbers[1][0] == numbers[0][0] + 1  # sequence numbers of one publisher
    assert numbers[0][2] == numbers[1][2] != attachment(wrenches[0])[2]
    stamp_ns = cloud.header.stamp.sec * 1_000_000_000 + cloud.header.stamp.nanosec
    assert 0 < numbers[0][1] - stamp_ns < 60_000_000_000


def attachment(sample: zenoh.Sample) -> tuple[int, int, bytes]:
    """Read sequence number, time and identity as rmw_zenoh does; anything else ends its node."""
    assert sample.attachment is not None
    data = sample.attachment.to_bytes()
    assert len(data) == 33
    sequence, time_ns, length = struct.unpack_from("<qqB", data)
    assert length == 16
    return sequence, time_ns, data[17:]


def test_the_node_is_in_the_graph_until_it_stops(
    graph: zenoh.Session, node: subprocess.Popen[str]
) -> None:
    tokens: set[str] = set()
    lock = threading.Lock()

    def take(sample: zenoh.Sample) -> None:
        with lock:
            change = tokens.add if sample.kind == zenoh.SampleKind.PUT else tokens.discard
            change(str(sample.key_expr))

    liveliness = graph.liveliness()
    liveliness.declare_subscriber(f"@ros2_lv/{DOMAIN}/**", take, history=True)
    wait_until(lambda: len(tokens) >= 7)
    parts = sorted(token.split("/") for token in tokens)
    (alone,) = [each for each in parts if each[5] == "NN"]
    assert alone[3:] == ["0", "0", "NN", "%", "%", "tactomo_left"]
    publishers = {each[9]: each for each in parts if each[5] == "MP"}
    assert set(publishers) == {
        *("%left%map", "%left%contacts", "%left%contact_wrenches", "%left%contact_poses"),
        *("%tf", "%diagnostics"),
    }
    of_map = publishers["%left%map"]
    assert of_map[:4] == alone[:4]  # of this node
    assert of_map[5:9] == ["MP", "%", "%", "tactomo_left"]
    assert of_map[10:] == ["sensor_msgs::msg::dds_::PointCloud2_", CLOUD, "::,10:,:,:,,"]
    assert len({each[4] for each in parts}) == len(parts)  # each entity has its own number
    node.send_signal(signal.SIGTERM)
    assert node.wait(PATIENCE_S) == 0
    wait_until(lambda: not tokens)


@pytest.mark.slow
def test_silence_is_told(
    graph: zenoh.Session, sensor: FakeSensor, node: subprocess.Popen[str]
) -> None:
    said = heard(graph, f"{DOMAIN}/diagnostics/**")

    def levels() -> list[int]:
        messages = [decoded(DIAGNOSTICS, sample.payload.to_bytes()) for sample in list(said)]
        return [message.status[0].level for message in messages]

    wait_until(lambda: 0 in levels(), meanwhile=sensor.publish, step_s=0.05)
    wait_until(lambda: levels()[-1] == 3)  # STALE, and not that before the first frame
    last = decoded(DIAGNOSTICS, said[-1].payload.to_bytes())
    assert "is the daemon running?" in last.status[0].message


def test_that_there_is_no_router_is_told(sensor: FakeSensor, tmp_path: Path) -> None:
    listen = {"endpoints": [f"unixsock-stream/{tmp_path / 'alone'}"]}
    alone = {"mode": "peer", "listen": listen, "scouting": {"multicast": {"enabled": False}}}
    (tmp_path / "alone.json5").write_text(json.dumps(alone))
    with start(sensor, tmp_path / "alone.json5") as process:
        assert process.stderr is not None
        assert "rmw_zenohd" in process.stderr.readline()
        process.kill()


def test_a_configuration_that_is_none_is_named(tactomo: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "bad.json5").write_text("{mode: nonsense}")
    for config in ("bad.json5", "none.json5"):
        result = tactomo("ros2", "left", "--config", config)
        assert result.returncode == 1
        assert "rmw_zenohd" in result.stderr
