"""`tactomo service`, into the root of a robot's disk that a test makes up."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
from fixture_types import Run
from tactomo.acquisition.adapters import Adapter
from tactomo.config import load_config, load_skins
from tactomo.errors import ServiceError
from tactomo.service import installation
from tactomo.service.installation import udev_rules

ROOT = Path(__file__).parents[3]
DEPLOY = ROOT / "deploy"
EXAMPLES = sorted((DEPLOY / "examples").glob("*.toml"))
PROGRAM = "/usr/bin/tactomo"

needs_systemd = pytest.mark.skipif(
    not all(map(shutil.which, ("systemctl", "systemd-analyze", "systemd-sysusers"))),
    reason="needs systemd's tools",
)


def adapter(number: int, **differs: Any) -> Adapter:
    """An FTDI adapter as Linux and udev show it."""
    return Adapter(
        **{
            "path": f"/dev/ttyUSB{number}",
            "names": (
                f"/dev/serial/by-id/usb-FTDI_FT232R_A10K2QX{number}-if00-port0",
                f"/dev/serial/by-path/pci-0000:00:14.0-usb-0:{number}:1.0-port0",
            ),
            "driver": "ftdi_sio",
            "vendor_id": 0x0403,
            "product_id": 0x6001,
            "maker": "FTDI",
            "product": "FT232R USB UART",
            "serial_number": f"A10K2QX{number}",
            "interface": 0,
            "latency_timer_ms": 16,
            "is_kept_from_modem_manager": False,
            **differs,
        }
    )


@pytest.fixture
def disk(tmp_path: Path) -> Path:
    """The root of a disk on which tactomo's program is installed."""
    program = tmp_path / "disk" / PROGRAM.lstrip("/")
    program.parent.mkdir(parents=True)
    program.touch(0o755)
    return tmp_path / "disk"


@pytest.fixture
def install(tactomo: Run, disk: Path) -> Run:
    """Install onto the disk: ``install(NAME, PORT, ...)``."""

    def run(name: str, *ports: str, more: tuple[str, ...] = ()) -> Any:
        options = [option for port in ports for option in ("--port", port)]
        where = ("--root", disk, "--program", PROGRAM)
        return tactomo("service", "install", name, *options, *where, *more)

    return run


def files_of(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@needs_systemd
def test_installing_twice_is_installing_once(install: Run, disk: Path) -> None:
    assert install("palm", "/dev/ttyACM0").returncode == 0
    config = load_config(disk / "etc/tactomo/palm.toml")
    assert config.ports == ("/dev/ttyACM0",)
    assert config.wait_for_ports
    assert (disk / "etc/systemd/system/multi-user.target.wants/tactomo@palm.service").is_symlink()
    assert "tactomo:" in (disk / "etc/passwd").read_text()
    before = files_of(disk)
    again = install("palm", "/dev/ttyACM0")
    assert again.returncode == 0
    assert "write" not in again.stdout
    assert files_of(disk) == before


@needs_systemd
def test_a_configuration_is_its_owners_and_survives(install: Run, tactomo: Run, disk: Path) -> None:
    install("palm", "/dev/ttyACM0")
    config = disk / "etc/tactomo/palm.toml"
    config.write_text(mine := 'ports = ["/dev/ttyACM7"]\n')
    assert f"keep       {config}" in install("palm", "/dev/ttyACM0").stdout
    tactomo("service", "uninstall", "--root", disk, status=0)
    left = {path.relative_to(disk) for path in files_of(disk / "etc") if "tactomo" in str(path)}
    assert left == {Path("etc/tactomo/palm.toml")}
    assert config.read_text() == mine


@needs_systemd
def test_skins_of_one_computer_get_addresses_of_their_own(install: Run, disk: Path) -> None:
    names = ("palm", "back", "thumb")
    for index, name in enumerate(names):
        install(name, f"/dev/ttyACM{index}")
    configs = [load_config(disk / f"etc/tactomo/{name}.toml") for name in names]
    assert len({address for c in configs for address in (c.stream, c.control)}) == 6
    assert installation.installed(disk) == sorted(names)


@needs_systemd
def test_the_files_of_a_package_are_left_to_it(install: Run, disk: Path) -> None:
    packaged = disk / "usr/lib/systemd/system/tactomo@.service"
    packaged.parent.mkdir(parents=True)
    packaged.write_text(installation.shipped("systemd/tactomo@.service"))
    (disk / "usr/lib/sysusers.d").mkdir()
    (disk / "usr/lib/sysusers.d/tactomo.conf").write_text(installation.shipped("sysusers.conf"))
    said = install("palm", "/dev/ttyACM0")
    assert said.returncode == 0
    assert not list((disk / "etc/systemd/system").glob("*.service"))
    assert not (disk / "etc/udev").exists()


def test_a_dry_run_shows_all_and_does_nothing(install: Run, disk: Path) -> None:
    before = files_of(disk)
    said = install("palm", "/dev/ttyACM0", more=("--dry-run",))
    assert said.returncode == 0
    assert files_of(disk) == before
    assert said.stderr == "No USB adapter is at /dev/ttyACM0: the service keeps this name.\n\n"
    for file in ("tactomo@.service", "71-tactomo.rules", "palm.toml"):
        assert re.search(rf"^write .*{file}$", said.stdout, re.M)
    assert "    WatchdogSec=" in said.stdout
    assert re.search(r"^run +systemctl .* enable tactomo@palm.service$", said.stdout, re.M)


def test_what_stands_in_the_way_is_said(tactomo: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    here = ("--port", "/dev/ttyACM0", "--program", PROGRAM)
    assert "letters, digits" in tactomo("service", "install", "left arm", *here).stderr
    if not Path("/run/systemd/system").exists():
        said = tactomo("service", "install", "palm", *here, status=1)
        assert "this computer does not run systemd" in said.stderr
    for place in ("/home/me/venv/bin/python", "/root/.pyenv/bin/python"):
        monkeypatch.setattr("sys.executable", place)
        with pytest.raises(ServiceError, match="does not see"):
            installation.this_program()
    look = tactomo("service", "install", "palm", "--port", "/dev/ttyACM0", "--dry-run", status=0)
    assert "does not see" in look.stderr
    assert "tactomo@palm.service" in look.stdout


def test_an_adapter_is_known_by_its_serial_number() -> None:
    adapters = [adapter(0), adapter(1)]
    text, names = udev_rules("palm", ["/dev/ttyUSB1"], adapters)
    assert names == ("/dev/tactomo/palm",)
    tty, usb = text.splitlines()[1:]
    assert tty == (
        'SUBSYSTEM=="tty", ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6001", '
        'ATTRS{serial}=="A10K2QX1", ENV{ID_USB_INTERFACE_NUM}=="00", ENV{TACTOMO}="palm"'
    )
    assert 'ENV{DEVTYPE}=="usb_device", ATTR{idVendor}=="0403"' in usb


@pytest.mark.parametrize("serial_number", ["", "0001", 'A"1', "A*"])
def test_adapters_that_look_alike_are_known_by_their_sockets(serial_number: str) -> None:
    adapters = [adapter(number, serial_number=serial_number) for number in (1, 2)]
    text, names = udev_rules("palm", [a.path for a in adapters], adapters)
    assert names == ("/dev/tactomo/palm-0", "/dev/tactomo/palm-1")
    assert text.splitlines()[1:] == [
        f'SUBSYSTEM=="tty", ENV{{ID_PATH}}=="pci-0000:00:14.0-usb-0:{number}:1.0", '
        f'ENV{{.ID_PORT}}=="0", ENV{{TACTOMO}}="palm-{number - 1}"'
        for number in (1, 2)
    ]


def test_a_port_with_a_lasting_name_or_none_keeps_its_name() -> None:
    by_id = adapter(0).names[0]
    assert udev_rules("palm", [by_id, "/dev/ttyAMA0"], [adapter(0)])[0] == ""
    with pytest.raises(ServiceError, match="no serial number"):
        udev_rules("palm", ["/dev/ttyUSB0"], [adapter(0, serial_number="", names=())])


@needs_systemd
@pytest.mark.parametrize("unit", ["tactomo@.service", "tactomo-zenoh.service"])
def test_the_exposure_of_the_services_is_small(unit: str, tmp_path: Path) -> None:
    command = ["systemd-analyze", "security", "--offline=yes", "--threshold=15"]
    done = subprocess.run(
        [*command, str(DEPLOY / "systemd" / unit)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout.splitlines()[-1]


@needs_systemd
def test_systemd_understands_the_units(disk: Path, tmp_path: Path) -> None:
    for unit in ("tactomo@.service", "tactomo-zenoh.service"):
        text = (DEPLOY / "systemd" / unit).read_text()
        place = tmp_path / unit.replace("@", "@palm")
        place.write_text(text.replace(PROGRAM, f"{disk}{PROGRAM}"))
        command = ["systemd-analyze", "verify", "--man=no", str(place)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        ours = [line for line in done.stderr.splitlines() if "tactomo" in line]
        assert ours == []


def test_udev_understands_the_rules(tmp_path: Path) -> None:
    help_text = subprocess.run(
        ["sh", "-c", "udevadm --help"], capture_output=True, text=True, check=False
    ).stdout
    if "verify" not in help_text:
        pytest.skip("needs udevadm verify (systemd 254)")
    skin = tmp_path / "70-tactomo-palm.rules"
    skin.write_text(udev_rules("palm", ["/dev/ttyUSB0"], [adapter(0)])[0])
    for rules in (DEPLOY / "udev/71-tactomo.rules", skin):
        subprocess.run(["udevadm", "verify", str(rules)], check=True)


@pytest.mark.parametrize(
    "example", sorted((DEPLOY / "examples").glob("*.toml")), ids=lambda p: p.stem
)
def test_the_examples_load(example: Path) -> None:
    loaded = load_skins(example)
    assert all(skin.ports for skin in (loaded if isinstance(loaded, tuple) else [loaded]))


BUILD = "from hatchling.build import build_wheel; import sys; build_wheel(sys.argv[1])"


@pytest.mark.slow
def test_an_installed_package_has_the_files_along(tmp_path: Path) -> None:
    command = [sys.executable, "-c", BUILD, str(tmp_path)]
    subprocess.run(command, cwd=ROOT, env={**os.environ, "CC": ""}, check=True, timeout=100)
    (wheel,) = tmp_path.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {f"tactomo/deploy/{file}" for file in installation.SHARED} <= names
    assert "tactomo_models/libinner_loop.so" in names
    assert not wheel.name.endswith("-none-any.whl")  # but for machines of this kind


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["", "no-such-compiler"])
def test_without_a_compiler_a_build_says_what_to_do(tmp_path: Path, compiler: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", BUILD, str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "CC": compiler, "PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )
    assert done.returncode
    assert "install gcc or clang" in done.stderr + done.stdout
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.glob("*.whl"))
