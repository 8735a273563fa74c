"""docs/your_own_sensor.md, the step that trains: with fewer scenes and epochs than it says."""

from __future__ import annotations

from pathlib import Path

import pytest
from newcomer import Newcomer
from page import Page

pytestmark = [pytest.mark.train, pytest.mark.timeout(600)]

PAGE = Page("docs/your_own_sensor.md")
FILE = "my_sheet.toml"
SMALLER = {
    "--scenes 2000": "--scenes 60 --jobs 1",
    "--epochs 20": "--epochs 1 --batch 16",
    "--count 20": "--count 1",
}


def test_a_network_of_ones_own_proposes_to_auto(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / FILE).write_text(PAGE.file(FILE))
    with Newcomer(tmp_path, SMALLER) as newcomer:
        *_, judged = newcomer.follow(PAGE.commands("6"))
        assert "method auto" in judged
        demo, press, _, status, _ = PAGE.commands("4")
        newcomer.run(demo)
        newcomer.run(press)
        said = newcomer.wait_for(f"{status} --json", '"tier": "')
        assert "no network" not in said
        newcomer.wait_for(f"{status} --json", '"network": {')  # the time of its stage
        newcomer.stop()
        (tmp_path / FILE).write_text(PAGE.file(FILE).replace("0.005 ", "0.004 "))
        newcomer.run(demo)
        newcomer.run(press)
        said = newcomer.wait_for(f"{status} --json", "was trained before")
        assert "train anew" in said
