"""Other people's hardware: the commands of docs/other_hardware.md, as they stand there."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from newcomer import Newcomer
from page import Page
from tactomo.config import load_config
from tactomo.protocols import NATIVE, available_protocols, protocol_named
from tactomo.twin.sciospec import SciospecEmulator
from tactomo_client import request
from tactomo_models import Press as Cup
from tactomo_models import SkinSimulator, load_description
from tactomo_protocol import Channel
from waiting import PATIENCE_S, wait_until
from whole_system import repository

PAGE = Page("docs/other_hardware.md")


@pytest.fixture
def newcomer(tmp_path: Path) -> Iterator[Newcomer]:
    with Newcomer(tmp_path) as newcomer:
        yield newcomer


def wait_for_a_reference(newcomer: Newcomer) -> None:
    control = newcomer.addresses["control"]
    wait_until(lambda: request("status", control, PATIENCE_S)["reference"], "a reference")


@pytest.mark.long
@pytest.mark.timeout(400)
def test_a_researcher_with_a_sciospec_and_no_instrument_yet(newcomer: Newcomer) -> None:
    twin, daemon, *then = PAGE.commands("Sciospec, emulated")
    newcomer.follow([twin, daemon])
    wait_for_a_reference(newcomer)
    _, status, _, info, plot = newcomer.follow(then)
    assert "sciospec" in status
    assert "sciospec, protocol sciospec" in info
    assert "1 contact in" in plot
    port = request("status", newcomer.addresses["control"], PATIENCE_S)["ports"][0]
    assert (port["state"], port["protocol"]) == ("running", "sciospec")


@pytest.mark.slow
def test_what_is_done_with_an_instrument(newcomer: Newcomer) -> None:
    _, copied, _ = newcomer.follow(PAGE.commands("Sciospec, the instrument"))
    assert "wrote tank.toml" in copied
    assert load_description(newcomer.folder / "tank.toml") == load_description("sciospec_disc")


def save_eit_files(folder: Path) -> None:
    """A cup that comes into an empty tank, as Sciospec's program saves it."""
    sensor = load_description("sciospec_disc")
    skin = SkinSimulator(sensor, 8e-3)
    empty, full = (
        skin.voltages(cups)[Channel.STRUCTURE] for cups in ([], [Cup(0.04, 0.02, 100.0, 0.015)])
    )
    noise = np.random.default_rng(0).normal(scale=1e-3, size=(30, sensor.measurements))
    spread = SciospecEmulator(sensor, 20.0)
    folder.mkdir()
    for number in range(30):
        volts = (empty if number < 20 else full) * (1 + noise[number])
        potentials = spread.potentials_of(volts)
        lines = ["18", "2", "setup_00001", f"2024.01.31. 12:00:{number / 20:06.3f}", "1e4", "1e4"]
        lines += ["0", "1", "0.001", "20.0", *[""] * 8]
        for (source, sink), row in zip(sensor.drive_pairs + 1, potentials, strict=True):
            lines.append(f"{source} {sink}")
            lines.append("\t".join(f"{value.real:.9E}\t{value.imag:.9E}" for value in row))
        (folder / f"setup_00001_{number:05d}.eit").write_text("\n".join(lines) + "\n")


@pytest.mark.slow
def test_its_files_become_a_recording(newcomer: Newcomer) -> None:
    save_eit_files(newcomer.folder / "setup_00001")
    imported, _, examined = newcomer.follow(PAGE.commands("Sciospec, its files"))
    assert "30 scans" in imported
    assert "reciprocity" in examined


@pytest.mark.long
def test_a_researcher_with_a_board_that_prints(newcomer: Newcomer) -> None:
    twin, daemon, poke, status = PAGE.commands("Tables, emulated")
    newcomer.follow([twin, daemon])
    wait_for_a_reference(newcomer)
    newcomer.run(poke)
    assert "skin: running" in newcomer.run(status)
    here = f'"skin", address="{newcomer.addresses["stream"]}"'
    (program,) = PAGE.blocks("python")
    said = newcomer.python(program.replace('"skin"', here))
    place = re.match(r"\((-?[\d.]+), (-?[\d.]+)\) mm", said)
    assert place is not None
    assert [float(mm) for mm in place.groups()] == pytest.approx([25, 10], abs=3)


@pytest.mark.slow
def test_a_board_that_prints_is_described(newcomer: Newcomer) -> None:
    for command in PAGE.commands("Tables, the board"):
        newcomer.run(command)
        name, copied = command.split()[-2:]
        assert load_description(newcomer.folder / copied) == load_description(name)


@pytest.mark.parametrize("name", [name for name in available_protocols() if name != NATIVE])
def test_each_protocol_has_an_example_of_a_configuration(name: str) -> None:
    config = load_config(repository() / "deploy" / "examples" / f"{name}.toml")
    assert config.protocol == name
    protocol_named(name, load_description(config.description))
