"""What a node publishes of a running sensor, without ROS."""

from __future__ import annotations

from typing import Any

import pytest
from tactomo_client import subscribe
from tactomo_client.fake import FakeSensor

pytest.importorskip("rosbags")

from tactomo_ros2.live import run
from tactomo_ros2.messages import TYPES, RosMessage

HUMS = {"severity": "error", "what": "it hums", "next_step": "oil it"}
CREAKS = {"severity": "warning", "what": "it creaks", "next_step": "leave it"}


@pytest.mark.parametrize(
    ("issues", "level", "words"),
    [([], 0, "running"), ([CREAKS], 1, "it creaks"), ([HUMS, CREAKS], 2, "it hums; it creaks")],
)
def test_what_the_daemon_finds_wrong_is_a_diagnostic(
    issues: list[dict[str, str]], level: int, words: str
) -> None:
    said: list[RosMessage] = []
    with (
        FakeSensor("left") as sensor,
        subscribe("left", kind=("map", "status"), address=sensor.address) as skin,
    ):
        sensor.wait_for_subscriber()
        sensor.wait_for_subscriber()
        sensor.publish_message("status", {"state": "running", "issues": issues})
        run(skin, said.append, lambda: bool(said))
    told: Any = TYPES.deserialize_cdr(said[0].cdr, said[0].type)
    (status,) = told.status
    assert (status.name, status.level, status.message) == ("tactomo: left: daemon", level, words)
    steps = {each.key: each.value for each in status.values}
    assert steps == {issue["what"]: issue["next_step"] for issue in issues}
