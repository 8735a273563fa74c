"""Two independent implementations meet: firmware in C behind a pty, and the real daemon."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from builds import runs
from c_firmware import C_FOLDER, CHECKED, build
from daemon_process import DaemonProcess
from ears import Ears, Heard
from needs import need
from page import Page
from waiting import wait_until

QUICK = {"method": "tikhonov"}  # what the map is worth is tried elsewhere


class Emulator:
    """The emulator program, and the paths of its ports."""

    def __init__(self, program: Path, folder: Path, *options: object) -> None:
        command = [program, "--link", folder, *options]
        self._errors = folder / "emulator.log"
        with self._errors.open("wb") as errors:
            self.popen = subprocess.Popen(
                list(map(str, command)),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        assert self.popen.stdout is not None
        ports = options[options.index("--ports") + 1] if "--ports" in options else 1
        self.paths = [self.popen.stdout.readline().strip() for _ in range(int(str(ports)))]
        assert all(self.paths), self.said()

    def said(self) -> str:
        """Return what it wrote about itself."""
        return self._errors.read_text()

    @property
    def resets(self) -> int:
        """How often the last board was reset."""
        return self.said().count("port1: reset")

    def press_enter(self) -> None:
        """Show the next file."""
        assert self.popen.stdin is not None
        print(file=self.popen.stdin, flush=True)

    def reset(self, number: int) -> None:
        """Send a signal that resets the last board, and wait until it did."""
        before = self.resets
        self.popen.send_signal(number)
        wait_until(lambda: self.resets > before, "the reset")

    def signal(self, number: int) -> None:
        """Send a signal."""
        self.popen.send_signal(number)

    def stop(self) -> None:
        """End it as Ctrl-C does; its links are gone, and no sanitizer complained."""
        self.popen.send_signal(signal.SIGINT)
        assert self.popen.wait(60) == 0, self.said()
        assert not any(Path(path).is_symlink() for path in self.paths)


@pytest.fixture(scope="module")
def program() -> Path:
    """The emulator, with sanitizers where the compiler has them."""
    need("cc")
    return build("tactomo_emulator", CFLAGS=CHECKED if runs("cc", CHECKED) else "-O2")


@pytest.fixture(scope="module")
def presses(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The files that the README's Python makes: a bare skin, and a press."""
    folder = tmp_path_factory.mktemp("press")
    [code] = Page("firmware_protocol/c/README.md").blocks("python")
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True)
    return folder / "bare.csv", folder / "press.csv"


class Rig:
    """An emulator, a daemon that reads it, and a subscriber."""

    def __init__(self, program: Path, folder: Path, *options: object, **config: Any) -> None:
        self.emulator = Emulator(program, folder, *options)
        self.daemon = DaemonProcess(folder, self.emulator.paths, **config)
        self.ears = Ears(self.daemon.stream, kinds=("contacts", "event"))

    def frame(self, since: int, what: str, condition: Any = lambda fields: True) -> dict[str, Any]:
        """Wait for a frame of both channels from message number `since` on."""

        def fits(heard: Heard) -> bool:
            fields = heard.fields
            return (
                heard.kind == "contacts"
                and not {"magnitude_missing", "structure_missing", "no_reference"}
                & set(fields["flags"])
                and condition(fields)
            )

        return self.ears.wait(fits, what, since).fields

    def flow(self, after: str) -> None:
        """Wait for more frames of both channels than may have been under way."""
        for _ in range(10):
            self.frame(len(self.ears.heard), f"both channels, after {after}")

    def event(self, since: int, name: str) -> None:
        """Wait for an event."""
        self.ears.wait(lambda h: h.kind == "event" and h.fields["name"] == name, name, since)

    def ports(self) -> list[dict[str, Any]]:
        """What the daemon says of its ports."""
        ports: list[dict[str, Any]] = self.daemon.status()["ports"]
        return ports

    def stop(self) -> None:
        """Stop everything, in order."""
        self.ears.close()
        self.daemon.stop()
        self.emulator.stop()


@pytest.fixture
def rigs() -> Iterator[list[Rig]]:
    """Rigs to be cleared away, however their test ends."""
    started: list[Rig] = []
    yield started
    for rig in started:
        rig.ears.close()
        rig.emulator.popen.kill()
        rig.emulator.popen.communicate()
        rig.daemon.kill()


@pytest.mark.slow
@pytest.mark.parametrize("ports", [1, 2])
def test_a_press_on_the_emulator_is_found_where_it_was(
    rigs: list[Rig], program: Path, presses: tuple[Path, Path], tmp_path: Path, ports: int
) -> None:
    rig = Rig(program, tmp_path, "--ports", ports, *presses)
    rigs.append(rig)
    wait_until(lambda: rig.daemon.told("tared"), "a reference")
    rig.emulator.press_enter()
    pressed = rig.frame(0, "a contact", lambda fields: len(fields["contacts"]) == 1)
    [contact] = pressed["contacts"]
    assert contact["x_mm"] == pytest.approx(30, abs=3)
    assert contact["y_mm"] == pytest.approx(-20, abs=3)
    for port in rig.ports():
        assert port["corrupt"] == 0
        assert port["device"]["device_id"].startswith("twin-emulator")
    rig.emulator.press_enter()
    lifted = len(rig.ears.heard)
    rig.frame(lifted, "the lift", lambda fields: not fields["contacts"])
    rig.stop()


@pytest.mark.slow
def test_resets_silence_and_unplugging_pass(rigs: list[Rig], program: Path, tmp_path: Path) -> None:
    rig = Rig(program, tmp_path, "--ports", 2, "--away", 0.5, **QUICK)
    rigs.append(rig)
    rig.flow("the start")
    for number in (signal.SIGHUP, signal.SIGUSR2, signal.SIGUSR1):
        since = len(rig.ears.heard)
        rig.emulator.reset(number)
        if number == signal.SIGUSR1:
            rig.event(since, "port_lost")
        rig.flow(signal.Signals(number).name)
    rig.emulator.signal(signal.SIGSTOP)
    wait_until(lambda: not rig.daemon.status()["rates"]["frames_hz"], "silence to be seen")
    rig.emulator.signal(signal.SIGCONT)
    rig.flow("SIGCONT")
    rig.stop()


@pytest.mark.long
def test_damage_and_gaps_are_counted_and_survived(
    rigs: list[Rig], program: Path, tmp_path: Path
) -> None:
    rig = Rig(program, tmp_path, "--corrupt", 7, "--drop", 5, "--drift", 100, "--rate", 50, **QUICK)
    rigs.append(rig)
    rig.frame(0, "a map", lambda fields: fields["scan_counter"] > 100)
    [port] = rig.ports()
    assert port["corrupt"] > 10
    counters = {heard.fields["scan_counter"] for heard in rig.ears.of("contacts")}
    assert not any(counter % 5 == 4 for counter in counters), "those were never sent"
    rig.stop()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--rate", "0"), "--rate takes a number from 0.01 to 1000, not: 0"),
        (("--id", "x" * 65), "an id has 1 to 62 bytes"),
        (("words.csv",), "line 2 holds something that is no voltage: words.csv"),
        (("short.csv",), "line 1 has 3 voltages where 208 (or 416: both channels)"),
        (("--ports", "2", "single.csv"), "two ports need both channels"),
        (("both.csv", "single.csv"), "it has other channels than the first file: single.csv"),
        (("both.csv",) * 17, "that is one file too many: both.csv"),
        (("--wrong",), "--help shows"),
    ],
)
def test_what_the_emulator_cannot_do_is_said(
    program: Path, tmp_path: Path, options: tuple[str, ...], told: str
) -> None:
    (tmp_path / "words.csv").write_text("# rest\nvolts, 0.1\n")
    (tmp_path / "short.csv").write_text("0.1 0.2;0.3\n")
    (tmp_path / "empty.csv").write_text("\n# nothing\n")
    (tmp_path / "single.csv").write_text(",".join(["0.1"] * 208))
    (tmp_path / "both.csv").write_text(",".join(["0.1"] * 416))
    done = subprocess.run([program, *options], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert told in done.stderr


def test_the_emulator_needs_a_folder_and_a_file_that_are_there(
    program: Path, tmp_path: Path
) -> None:
    (tmp_path / "port0").write_text("mine")
    for options in (("--link", "absent"), ("absent.csv",), ("--link", ".")):
        done = subprocess.run([program, *options], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 1, options
        assert "give" in done.stderr
    assert (tmp_path / "port0").read_text() == "mine"


def test_the_emulators_help_names_every_option(program: Path) -> None:
    done = subprocess.run([program, "--help"], capture_output=True, text=True, check=True)
    source = (C_FOLDER / "tactomo_emulator.c").read_text()
    known = re.findall(r'\{"([a-z-]+)", (?:required|no)_argument', source)
    assert len(known) > 8
    assert all(f"--{name}" in done.stdout for name in known if name != "help")
