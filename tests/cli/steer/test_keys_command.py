"""`tactomo keys`: what is made, what is printed, and what never is."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest
from fixture_types import Run
from tactomo.config import load_config
from tactomo_client import Keys
from tactomo_client.keys import read_public, read_secret


@pytest.fixture
def keys(tactomo: Run, tmp_path: Path) -> Run:
    """Run `tactomo keys ARGUMENTS` with a folder of keys of its own."""
    own = ("--keys", tmp_path / "keys")
    return lambda *arguments, **ending: tactomo("keys", *arguments, *own, **ending)


def test_what_make_prints_leads_to_a_client_that_is_let_in(
    keys: Run, tactomo: Run, tmp_path: Path
) -> None:
    folder = tmp_path / "keys"
    made = keys("make", "left", "--server", status=0)
    secret = read_secret(folder / "left.key_secret")[1].decode()
    (line,) = [line.strip() for line in made.stdout.splitlines() if "clients = " in line]
    (other,) = [line.strip() for line in made.stdout.splitlines() if "secret = " in line]
    config = tmp_path / "left.toml"
    config.write_text(f"ports = ['a']\nstream = 'tcp://0.0.0.0:1'\n[curve]\n{line}\n{other}\n")
    assert load_config(config).curve

    desk = tactomo("keys", "make", "desk", "--keys", tmp_path / "desk")
    assert "tactomo keys allow desk.key --for SERVER" in desk.stdout
    desk_key = tmp_path / "desk" / "desk.key"
    allowed = keys("allow", desk_key, "--for", "left", "--may-command", status=0)
    (tmp_path / "desk" / "left.key").write_bytes((folder / "left.key").read_bytes())
    loaded = Keys.load(tmp_path / "desk")
    assert loaded.public.decode() in allowed.stdout
    assert str(folder) in allowed.stdout
    assert f"tactomo keys allow CLIENT.key --for left --keys {folder}" in made.stdout
    assert loaded.server == read_public(folder / "left.key")
    listed = keys("list").stdout
    (row,) = (line for line in listed.splitlines() if loaded.public.decode() in line)
    assert row.split()[0] == "desk"
    assert row.endswith("command")
    for said in (made, desk, allowed, keys("list")):
        assert secret not in said.stdout + said.stderr
        assert loaded.secret.decode() not in said.stdout + said.stderr
    assert loaded.secret.decode() not in repr(loaded)


def test_secrets_are_their_owners_and_public_keys_everybodys(keys: Run, tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        keys("make", "left", "--server")
    finally:
        os.umask(before)
    folder = tmp_path / "keys"
    assert stat.S_IMODE((folder / "left.key_secret").stat().st_mode) == 0o600
    assert stat.S_IMODE((folder / "left.key").stat().st_mode) == 0o644
    assert {path.name for path in folder.iterdir()} == {
        "left.key",
        "left.key_secret",
        "left.clients",
    }


def test_nothing_is_overwritten_without_force(keys: Run, tmp_path: Path) -> None:
    keys("make", "left", "--server")
    first = read_public(tmp_path / "keys" / "left.key")
    assert "--force" in keys("make", "left", status=1).stderr
    assert read_public(tmp_path / "keys" / "left.key") == first
    keys("make", "left", "--force", status=0)
    assert read_public(tmp_path / "keys" / "left.key") != first


def test_a_client_is_listed_once_and_taken_off(keys: Run, tactomo: Run, tmp_path: Path) -> None:
    keys("make", "left", "--server")
    public = tmp_path / "desk" / "desk.key"
    tactomo("keys", "make", "desk", "--keys", public.parent)
    keys("allow", public, "--for", "left", "--may-command")
    assert "desk" in keys("allow", public, "--for", "left").stdout
    assert keys("list").stdout.count("desk   ") == 1
    assert "and command" not in keys("list").stdout
    tactomo("keys", "make", "desk", "--keys", public.parent, "--force")
    keys("allow", public, "--for", "left", status=1)
    keys("allow", public, "--for", "left", "--force", status=0)
    keys("revoke", "desk", "--for", "left", status=0)
    assert "desk   " not in keys("list").stdout
    assert "on it: nobody" in keys("revoke", "desk", "--for", "left", status=1).stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("make", "../left"), "'../left' is not a key name"),
        (("allow", "none.key", "--for", "left"), "No such file"),
        (("allow", "empty.key", "--for", "left"), "cannot read a key"),
        (("allow", "desk.key_secret", "--for", "left"), "must not leave its computer"),
        (("allow", "desk.key", "--for", "left"), "no server key 'left' in"),
        (("allow", "desk.key", "--for", "left"), "there are: arm"),
        (("revoke", "desk", "--for", "arm"), "not on the list"),
    ],
)
def test_what_cannot_be_done_says_why(
    keys: Run, tactomo: Run, tmp_path: Path, arguments: tuple[str, ...], said: str
) -> None:
    (tmp_path / "empty.key").touch()
    tactomo("keys", "make", "desk", "--keys", tmp_path)
    keys("make", "arm", "--server")
    assert said in keys(*arguments, status=1).stderr
    assert not (tmp_path / "keys" / "left.clients").exists()


def test_a_clients_folder_must_be_unambiguous(keys: Run, tactomo: Run, tmp_path: Path) -> None:
    for name in ("desk", "arm", "leg"):
        tactomo("keys", "make", name, "--keys", tmp_path / name)
    folder = tmp_path / "desk"
    there = "--address", "tcp://127.0.0.1:9", "--keys", folder
    nobody = tactomo("status", *there, status=1)
    assert "should hold one server's public key, and holds none" in nobody.stderr
    for name in ("arm", "leg"):
        (folder / f"{name}.key").write_bytes((tmp_path / name / f"{name}.key").read_bytes())
    two = tactomo("watch", *there)
    assert "holds 2: arm.key, leg.key" in two.stderr
