"""docs/first_skin.md as somebody follows it in order, with a board on pseudo-terminals."""

from __future__ import annotations

import urllib.request
from pathlib import Path

import pytest
from newcomer import Newcomer
from page import Page

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]  # a dozen programs, one after another

INSTEAD = {
    "--seconds 10": "--seconds 3",
    "tactomo doctor": "tactomo doctor --seconds 2",
    "tactomo watch": "tactomo watch --seconds 2",
    "ports --ask": "ports --ask /dev/ttyACM0",
    "--viewer": "--speed max",  # and not until Ctrl-C
}


def test_the_page_can_be_followed_in_order(tmp_path: Path) -> None:
    said: dict[str, str] = {}
    with Newcomer(tmp_path, INSTEAD) as newcomer:
        for command in Page("docs/first_skin.md").commands():
            name = " ".join(command.split()[1:3])
            if name == "record grasp.mcap":
                newcomer.run("tactomo poke press x_mm=10 y_mm=-20")
            said[name] = newcomer.run(command)
            if name.startswith("daemon"):
                newcomer.wait_for("tactomo status", "left_forearm: running")
            if name == "viewer":
                with urllib.request.urlopen(newcomer.addresses["url"]) as page:
                    assert b"<title>" in page.read()
    assert "  device   twin-paper_square" in said["ports --ask"]
    assert "nothing pressed" in said["watch"]
    assert "new reference from 20 dual scans" in said["tare"]
    assert "healthy" in said["doctor"]
    assert "1 contact in" in said["plot grasp.mcap"]
    assert (tmp_path / "contacts.csv").read_text().count("\n") > 10
