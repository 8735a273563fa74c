"""docs/first_skin.md as somebody without a skin follows it."""

from __future__ import annotations

from pathlib import Path

import pytest
from newcomer import Newcomer
from page import Page

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]  # a dozen programs, one after another

SHORTER = {"--seconds 10": "--seconds 3", "doctor ": "doctor --seconds 2 "}
PAGE = Page("docs/first_skin.md")
NEED_OTHERS = ("ports", "daemon", "calibrate", "replay")  # adapters, a load cell, a browser


def test_a_simulated_skin_does_for_a_real_one(tmp_path: Path) -> None:
    commands = [line.split("#")[0] for line in PAGE.commands()]
    simulated = commands[-2:]
    done = {}
    with Newcomer(tmp_path, SHORTER) as newcomer:
        newcomer.follow(simulated)
        for command in commands[:-2]:
            name = command.split()[1]
            if name == "record":
                newcomer.run("tactomo poke press x_mm=10 y_mm=-20")
            if name == "recover":
                whole = (tmp_path / "grasp.mcap").read_bytes()
                (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
            if name not in NEED_OTHERS:
                done[name] = newcomer.run(command)
    assert done.keys() == {"doctor", "record", "plot", "export", "foxglove", "recover"}
    assert "1 contact(s)" in done["plot"]
    assert "cut-recovered.mcap: kept" in done["recover"]
