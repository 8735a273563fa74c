"""A configuration that cannot be used is refused with the file, the key and what is allowed."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from pydantic import BaseModel
from tactomo.config import BaselineConfig, DaemonConfig, RecordingConfig, load_config, load_skins
from tactomo.errors import ConfigError

EXAMPLE = Path(__file__).parents[3] / "deploy" / "daemon.example.toml"


def config_file(folder: Path, text: str) -> Path:
    path = folder / "skin.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("ports = [", "not valid TOML"),
        ("name = 'left'", "ports is missing"),
        ("ports = ['a']\nprot = 1", "unknown key prot"),
        ("ports = ['a', 'b', 'c']", "at most 2"),
        ("ports = ['a', 'a']", "the two ports are the same"),
        ("ports = 'a'", "ports = 'a': give a list, in brackets"),
        ("ports = ['a']\nstream = 'ipc:///x'\ncontrol = 'ipc:///x'", "the same address"),
        ("ports = ['a']\nbaud = 'fast'", "baud = 'fast'"),
        ("ports = ['a']\ntare_scans = 1", "greater than or equal to 2"),
        ("ports = ['a']\nbudget_ms = 0", "greater than or equal to 0.01"),
        ("ports = ['a']\nmethod = 'best'", "use one of: auto, tikhonov, "),
        ("ports = ['a']\nname = 'left arm'", "letters, digits"),
        ("ports = ['a']\nstream = 'tcp://0.0.0.0:5560'", "can be reached from other computers"),
        ("ports = ['a']\ncontrol = 'tcp://127.0.0.1'", "use tcp://127.0.0.1:PORT"),
        ("ports = ['a']\nrecording = 'yes'", "recording = 'yes'"),
        ("ports = ['a']\n[recording]\nrotate_mb = 0", "recording.rotate_mb = 0"),
        ("ports = ['a']\n[recording]\nkeep_gb = 0.9", "no room for four files"),
        ("ports = ['a']\n[recording]\nfile = 'a'\nat_start = true", "give one of them"),
        ("ports = ['a']\n[recording]\nmap = true", "unknown key recording.map"),
        ("ports = ['a']\n[recording]\nfolder = ''", "recording.folder = '': give the path"),
        ('ports = ["a"]\n[recording]\nfile = "a\\u0000"', "not empty and has no NUL"),
        ('ports = ["a"]\ncalibration = "a\\u0000"', "not empty and has no NUL"),
        ('ports = ["a"]\ndescription = "a\\u0000"', "not empty and has no NUL"),
        ('ports = ["a"]\nstream = "ipc://a\\u0000"', "or ipc://PATH"),
    ],
)
def test_a_bad_file_is_refused_with_the_reason(tmp_path: Path, text: str, said: str) -> None:
    path = config_file(tmp_path, text)
    with pytest.raises(ConfigError, match=r".") as caught:
        load_config(path)
    assert str(path) in caught.value.cause
    assert said in caught.value.cause
    assert caught.value.next_step


def test_ports_may_be_given_in_both_ways(tmp_path: Path) -> None:
    for path in (None, config_file(tmp_path, "name = 'left'")):
        with pytest.raises(ConfigError, match="ports is missing") as caught:
            load_config(path)
        assert "give --port /dev/ttyACM0" in caught.value.next_step
        assert 'a configuration file with ports = ["/dev/ttyACM0"]' in caught.value.next_step
    with pytest.raises(ConfigError, match="unknown key port") as misspelt:
        load_config(config_file(tmp_path, "port = '/dev/ttyACM0'"))
    assert "known keys: name, " in misspelt.value.next_step


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        load_config(tmp_path / "none.toml")


def test_flags_win_and_are_blamed_themselves(tmp_path: Path) -> None:
    path = config_file(tmp_path, "ports = ['a']\ntare_scans = 7\nbaud = 9600")
    assert load_config(path, tare_scans=9, baud=None) == DaemonConfig(
        ports=("a",), tare_scans=9, baud=9600
    )
    with pytest.raises(ConfigError, match="command line: tare_scans = 0"):
        load_config(path, tare_scans=0)


def test_flags_reach_into_tables(tmp_path: Path) -> None:
    path = config_file(tmp_path, "ports = ['a']\n[recording]\nmaps = true\nsync_s = 1")
    recording = load_config(path, **{"recording.file": tmp_path / "a.mcap"}).recording
    assert (recording.file, recording.maps, recording.sync_s) == (tmp_path / "a.mcap", True, 1)
    with pytest.raises(ConfigError, match=r"command line: recording.maps = 3"):
        load_config(path, **{"recording.maps": 3})
    path.write_text("ports = ['a']\nrecording = 'yes'")
    with pytest.raises(ConfigError, match=r"skin.toml: recording = 'yes'"):
        load_config(path, **{"recording.maps": True})


@pytest.mark.parametrize(
    "endpoint",
    ["tcp://127.0.0.1:0", "tcp://localhost:5560", "tcp://[::1]:5560", "ipc:///run/tactomo/left"],
)
def test_endpoints_on_this_computer_are_accepted(endpoint: str) -> None:
    assert load_config(ports=["a"], stream=endpoint).stream == endpoint


def test_the_example_shows_every_key_and_loads() -> None:
    load_config(EXAMPLE)
    text = EXAMPLE.read_text()
    # Keys without a value in the example are there as comments.
    commented = [line.removeprefix("# ") for line in text.splitlines() if " = " in line]
    shown = {line.partition(" = ")[0] for line in commented}
    tables: dict[str, type[BaseModel]] = {"baseline": BaselineConfig, "recording": RecordingConfig}
    assert set(DaemonConfig.model_fields) - tables.keys() <= shown
    assert all(f"[{name}]" in text for name in tables)
    assert all(set(table.model_fields) <= shown for table in tables.values())
    assert tomllib.loads(text)


TWO_SKINS = """
tare_scans = 40
recording = { maps = true, keep_gb = 20 }
[skins.left]
ports = ["a"]
recording = { at_start = true }
[skins.right]
ports = ["b"]
tare_scans = 5
"""


def test_skins_of_one_file_share_its_keys_and_have_addresses_of_their_own(tmp_path: Path) -> None:
    loaded = load_skins(config_file(tmp_path, TWO_SKINS), method="tikhonov")
    assert isinstance(loaded, tuple)
    left, right = loaded
    assert (left.name, left.tare_scans, left.method) == ("left", 40, "tikhonov")
    assert (left.recording.at_start, left.recording.maps, left.recording.keep_gb) == (
        True,
        True,
        20,
    )
    assert (right.name, right.tare_scans, right.recording.at_start) == ("right", 5, False)
    assert (left.stream, right.stream) == ("tcp://127.0.0.1:5560", "tcp://127.0.0.1:5580")
    assert (left.control, right.control) == ("tcp://127.0.0.1:5561", "tcp://127.0.0.1:5581")


def test_one_skin_of_a_file_is_chosen_by_its_name(tmp_path: Path) -> None:
    path = config_file(tmp_path, TWO_SKINS)
    right = load_skins(path, name="right")
    assert isinstance(right, DaemonConfig)
    assert (right.ports, right.stream) == (("b",), "tcp://127.0.0.1:5580")
    with pytest.raises(ConfigError, match="use one of: left, right"):
        load_skins(path, name="palm")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[skins]", "at least 1"),
        ("skins = 3", "skins = 3"),
        ("[skins.left]\nports = ['a']\nprot = 1", "[skins.left]: unknown key prot"),
        (
            "[skins.left]\nports = ['a']\n[skins.right]\nports = ['a']",
            "left and right both have 'a'",
        ),
        ("stream = 'ipc:///x'\n[skins.l]\nports = ['a']\n[skins.r]\nports = ['b']", "ipc:///x"),
        ("proxy = 'ipc:///x'\n[skins.left]\nports = ['a']", "unknown key proxy"),
    ],
)
def test_a_bad_file_of_skins_is_refused_with_the_reason(
    tmp_path: Path, text: str, said: str
) -> None:
    path = config_file(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_skins(path)
    assert str(path) in caught.value.cause
    assert said in str(caught.value)
    assert caught.value.next_step
