"""docs/ros2.md and docs/lerobot.md as somebody follows them who has neither ROS 2 nor LeRobot."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from newcomer import Newcomer
from page import Page
from recorded_grasp import contacts_of, images_of
from rosbags.highlevel import AnyReader
from tactomo_client.fake import FakeSensor
from waiting import wait_until

PAGE_OF_LEROBOT = Page("docs/lerobot.md")
PRESSED = 50  # the frame of the recorded grasp that is published


@pytest.mark.slow
def test_a_skin_becomes_a_bag_with_the_topics_of_the_page(tmp_path: Path) -> None:
    page = Page("docs/ros2.md")
    demo, *bag = page.commands("A recording")
    topics = {
        name.replace("SENSOR", "skin") for name in re.findall(r"^\| `(/\S+)`", page.text, re.M)
    }
    with Newcomer(tmp_path, {"--seconds 16": "--seconds 4"}) as newcomer:
        newcomer.run(demo.split("#")[0])
        newcomer.follow(bag)
    with AnyReader([tmp_path / "grasp_bag"]) as reader:
        assert {connection.topic for connection in reader.connections} == topics
        maps = [c for c in reader.connections if c.topic == "/skin/map"]
        clouds: list[Any] = [
            reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(maps)
        ]
    assert len(clouds) > 20
    assert all(cloud.width == cloud.height == 51 for cloud in clouds)


def test_the_arrays_of_a_policy_come_live(tmp_path: Path) -> None:
    (code,) = [block for block in PAGE_OF_LEROBOT.blocks("python") if "Touch(" in block]
    images: dict[str, Any] = images_of(PRESSED)
    with FakeSensor("skin") as sensor:
        program = (
            "from tactomo_client import subscribe\nfrom tactomo_client.touch import Touch\n"
            + code.replace('"skin"', f'"skin", address={sensor.address!r}')
            + '    np.savez("arrays.npz", **arrays)\n    break\n'
        )
        command = [sys.executable, "-c", f"import numpy as np\n{program}"]
        with subprocess.Popen(command, cwd=tmp_path) as running:
            wait_until(
                lambda: running.poll() is not None,
                meanwhile=lambda: sensor.publish(contacts_of(PRESSED), **images),
                step_s=0.05,
            )
        assert running.returncode == 0
    arrays = np.load(tmp_path / "arrays.npz")
    assert arrays["pressure_kpa"].shape == (51, 51)
    assert f"`contacts` | {arrays['contacts'].shape}" in PAGE_OF_LEROBOT.text
    assert f"`contacts_known` | {arrays['contacts_known'].shape}" in PAGE_OF_LEROBOT.text
    assert arrays["is_known"].item() == 1
