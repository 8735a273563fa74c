"""Beyond the machine: who has an allowed key gets in, nobody else does, nobody can listen in."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from fixture_types import Run, Start
from page import Page
from tactomo.config import load_config
from tactomo.endpoint import bind
from tactomo.errors import AddressError, ConfigError
from tactomo.log import configure_logging
from tactomo.service.daemon import Daemon
from tactomo.stream import keys as key_files
from tactomo.stream.access_control import AccessControl, ServerKeys
from tactomo_client import (
    ClientError,
    Frame,
    Keys,
    KeysError,
    NoAnswer,
    Status,
    Subscription,
    aio,
    request,
    subscribe,
)
from tactomo_client import Daemon as Commander
from tactomo_client.keys import read_public, read_secret
from tactomo_viewer.browser import Feed
from waiting import PATIENCE_S, wait_until

SERVER = "left"


def own_address() -> str:
    """Return an address of this computer that others can reach, or that stands for all of them."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing
        except OSError:
            return "0.0.0.0"
        return str(probe.getsockname()[0])


class Robot:
    """The robot's folder of keys, and those of its clients."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "robot"
        self._clients = folder / "clients"
        key_files.make_pair(self.folder, SERVER, is_server=True)

    @property
    def config(self) -> dict[str, Any]:
        address = f"tcp://{own_address()}:0"
        return {
            "stream": address,
            "control": address,
            "curve": {
                "secret": str(key_files.secret_path(self.folder, SERVER)),
                "clients": str(key_files.clients_folder(self.folder, SERVER)),
            },
        }

    def client(self, name: str, *, server: str = SERVER) -> Path:
        """Make a client's folder of keys, with a server's public key in it."""
        folder = self._clients / name
        key_files.make_pair(folder, name)
        shutil.copy(key_files.public_path(self.folder, server), folder)
        return folder

    def allow(self, folder: Path, *, may_command: bool = False) -> Path:
        public = key_files.public_path(folder, folder.name)
        key_files.allow(self.folder, public, SERVER, may_command=may_command)
        return folder

    def revoke(self, name: str) -> None:
        key_files.revoke(self.folder, name, SERVER)


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    return Robot(tmp_path)


@pytest.fixture
def guarded(bench: Start, robot: Robot) -> Any:
    """A daemon at an address that others can reach, and one who may command it: ``desk``."""
    desk = robot.allow(robot.client("desk"), may_command=True)
    return bench(keys=Keys.load(desk), **robot.config)


def first_frame(guarded: Any, skin: Subscription[Frame]) -> Frame:
    """Return the first frame that comes to a subscription, of a skin that goes on scanning."""
    frame = wait_until(skin.latest, meanwhile=lambda: guarded.step(0.1))
    assert frame is not None
    return frame


@pytest.mark.slow
def test_a_stranger_is_turned_away_in_an_event_loop_until_allowed(
    guarded: Any, robot: Robot
) -> None:
    guarded.tare()
    folder = robot.client("stranger")

    async def look() -> None:
        stream, control = guarded.daemon.stream_address, guarded.daemon.control_address
        async with (
            aio.subscribe(SERVER, address=stream, kind="status", keys=folder) as statuses,
            aio.Control(control, keys=folder, timeout_s=PATIENCE_S) as daemon,
            asyncio.timeout(PATIENCE_S),
        ):
            with pytest.raises(KeysError, match="does not let this client in"):
                await anext(statuses)
            with pytest.raises(KeysError, match="does not let this client in"):
                await daemon.request("status")
            robot.allow(folder, may_command=True)
            while True:  # it knocks again by itself
                with contextlib.suppress(KeysError):
                    assert (await anext(statuses)).session == guarded.daemon.session
                    break
            while True:
                with contextlib.suppress(KeysError):
                    assert (await daemon.request("status"))["session"] == guarded.daemon.session
                    break

    asyncio.run(look())


def test_another_process_gets_in_with_the_folder_alone(
    guarded: Any, robot: Robot, tactomo: Run
) -> None:
    words = ["status", "--json", "--address", guarded.daemon.stream_address]
    command = [sys.executable, "-m", "tactomo.cli", *words]
    desk = robot.folder.parent / "clients" / "desk"
    environment = {**os.environ, "TACTOMO_KEYS": str(desk)}
    said = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert said.returncode == 0, said.stderr
    assert '"state"' in said.stdout
    said = tactomo(*words, status=1)
    assert "hangs up on a client without keys" in said.stderr
    assert "TACTOMO_KEYS" in said.stderr


def test_who_is_allowed_reads_and_commands_and_so_do_viewer_and_specification(
    guarded: Any, robot: Robot, tmp_path: Path
) -> None:
    address = guarded.daemon.stream_address
    folder = robot.allow(robot.client("ros"))
    (example,) = Page("clients/STREAM.md").blocks("python", "Beyond the machine")
    (tmp_path / "health.py").write_text(example)
    command = [sys.executable, "-I", tmp_path / "health.py", folder, SERVER, address]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "waiting_for_data\n"
        process.kill()
    guarded.tare()
    with subscribe(SERVER, address=address, keys=folder) as skin:
        assert first_frame(guarded, skin).sensor == SERVER

    async def look() -> tuple[Status, dict[str, Any]]:
        feed = Feed(SERVER, address, guarded.keys, lambda: None)
        link = aio.Control(guarded.daemon.control_address, keys=guarded.keys)
        reading = asyncio.create_task(feed.run())
        try:
            async with asyncio.timeout(PATIENCE_S):
                while feed.status is None:
                    await asyncio.sleep(0.01)
            return feed.status, await link.request("status", PATIENCE_S)
        finally:
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)
            link.close()

    status, answer = asyncio.run(look())
    assert status.fields["session"] == answer["session"] == guarded.daemon.session


@pytest.mark.slow
def test_a_client_that_is_not_listed_is_refused_and_told_of(guarded: Any, robot: Robot) -> None:
    stranger = robot.client("stranger")
    address = guarded.daemon.stream_address
    with subscribe(SERVER, address=address, keys=stranger) as skin:
        with pytest.raises(KeysError, match="does not let this client in") as caught:
            next(skin)
        event = guarded.listener.event("client_refused")
        public = Keys.load(stranger).public.decode()
        assert public in caught.value.cause
        assert public in event["detail"]
        assert own_address() in event["detail"] or "127.0.0.1" in event["detail"]
        command = f"`tactomo keys allow CLIENT.key --for {SERVER} --keys {robot.folder}`"
        assert command in event["next_step"]
        assert f"`tactomo keys allow stranger.key --for {SERVER}`" in caught.value.next_step
        with pytest.raises(KeysError) as refused:
            request("status", guarded.daemon.control_address, PATIENCE_S, keys=stranger)
        assert refused.value.name == "key_refused"
        robot.allow(stranger)  # and now it is let in, without a restart of either
        guarded.tare()
        assert first_frame(guarded, skin)


def test_a_reader_may_not_command_and_another_servers_key_is_noticed(
    guarded: Any, robot: Robot
) -> None:
    ros = robot.allow(robot.client("ros"))
    with pytest.raises(KeysError) as refused:
        request("tare", guarded.daemon.control_address, PATIENCE_S, keys=ros)
    assert refused.value.name == "key_refused"
    event = guarded.listener.event("client_refused")
    assert "may not use the control" in event["detail"]
    assert f"--for {SERVER} --may-command --keys {robot.folder}`" in event["next_step"]
    key_files.make_pair(robot.folder, "impostor", is_server=True)
    misled = robot.allow(robot.client("misled", server="impostor"))
    with pytest.raises(KeysError) as caught:
        request("status", guarded.daemon.control_address, PATIENCE_S, keys=misled)
    assert caught.value.name == "wrong_server"


@pytest.mark.slow
def test_who_is_revoked_is_cut_off_and_the_others_come_back(guarded: Any, robot: Robot) -> None:
    guarded.tare()
    ros = robot.allow(robot.client("ros"))
    with subscribe(SERVER, address=guarded.daemon.stream_address, keys=ros) as skin:
        last = first_frame(guarded, skin)
        robot.revoke("ros")
        refused: list[dict[str, Any]] = []
        while not refused:  # it tries to come in again and again
            with contextlib.suppress(KeysError):
                last = next(skin)
            refused = [e for e in guarded.listener.of("event") if e["name"] == "client_refused"]
        assert Keys.load(ros).public.decode() in refused[0]["detail"]
        for _ in range(5):
            assert guarded.step(0.2)["scan_counter"] > last.scan_counter
        assert skin.latest() is last
        with pytest.raises(KeysError):
            next(skin)
    assert guarded.ask("status")["state"]


@pytest.mark.slow
def test_a_command_of_one_who_was_revoked_ends(
    guarded: Any, robot: Robot, capsys: pytest.CaptureFixture[str]
) -> None:
    """ZeroMQ drops a connection that was refused; sending into what is left would never return."""
    configure_logging("info", "text")  # to the captured stream
    ros = robot.allow(robot.client("ros"), may_command=True)
    with Commander(guarded.daemon.control_address, keys=ros, timeout_s=PATIENCE_S) as commander:
        assert commander.status().state
        robot.revoke("ros")
        # Read in the log: the listener was cut off, too, and may come back after the only event.
        guarded.until(lambda: "client_refused" in capsys.readouterr().err)
        commander.timeout_s = 2.0
        with pytest.raises(ClientError):
            commander.status()


def test_without_access_control_nobody_gets_in(robot: Robot) -> None:
    """ZeroMQ's own default lets everybody in when nobody is there to ask."""
    keys = Keys.load(robot.allow(robot.client("desk"), may_command=True))
    secret = read_secret(key_files.secret_path(robot.folder, SERVER))[1]
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    with context, context.socket(zmq.ROUTER) as server:
        server.setsockopt(zmq.LINGER, 0)
        address = bind(server, "tcp://127.0.0.1:0", "control", secret=secret)
        with pytest.raises(KeysError):
            request("status", address, PATIENCE_S, keys=keys)
        assert not server.poll(0)


def test_access_control_that_dies_is_noticed_and_can_be_stopped(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    def trip(*_: object) -> bool:
        raise RuntimeError

    monkeypatch.setattr("threading.excepthook", lambda _: None)
    monkeypatch.setattr(AccessControl, "callback", trip)
    clients = key_files.clients_folder(robot.folder, SERVER)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    keeper = AccessControl(context, ServerKeys(b"", clients), lambda *_, **__: None, lambda: None)
    keeper.start()
    assert keeper.is_alive
    with context.socket(zmq.REQ) as asking:
        asking.setsockopt(zmq.LINGER, 0)
        asking.connect("inproc://zeromq.zap.01")
        question = [b"1.0", b"1", b"stream", b"127.0.0.1", b"", b"CURVE", bytes(32)]
        asking.send_multipart(question)
        wait_until(lambda: not keeper.is_alive)
    keeper.stop()
    context.term()


@pytest.mark.parametrize(
    ("mode", "place"), [(0o777, ""), (0o775, "may_command"), (0o757, "may_command/desk.key")]
)
def test_a_list_that_others_can_write_to_is_refused(
    bench: Start, robot: Robot, mode: int, place: str
) -> None:
    robot.allow(robot.client("desk"), may_command=True)
    (key_files.clients_folder(robot.folder, SERVER) / place).chmod(mode)
    with pytest.raises(KeysError, match=f"{mode:o}") as caught:
        bench(**robot.config)
    assert "chmod go-w" in caught.value.next_step


@pytest.mark.slow
def test_nobody_new_comes_in_by_a_list_that_was_opened(guarded: Any, robot: Robot) -> None:
    folder = key_files.clients_folder(robot.folder, SERVER)
    folder.chmod(0o777)
    ros = robot.allow(robot.client("ros"))
    assert "chmod go-w" in guarded.listener.event("client_key_unusable")["next_step"]
    assert guarded.ask("status")  # who was in stays in
    with (
        pytest.raises(KeysError),
        subscribe(
            SERVER, address=guarded.daemon.stream_address, timeout_s=PATIENCE_S, keys=ros
        ) as skin,
    ):
        next(iter(skin))


def test_a_bad_file_on_the_list_locks_nobody_else_out_and_no_list_everybody(
    guarded: Any, robot: Robot
) -> None:
    listed = key_files.clients_folder(robot.folder, SERVER)
    (listed / "broken.key").write_text("public-key = nonsense\n")
    (listed / "folder.key").mkdir()
    assert "broken.key" in guarded.listener.event("client_key_unusable")["detail"]
    assert guarded.ask("status")
    shutil.rmtree(listed)  # and one that cannot be read lets nobody in

    def is_locked_out() -> bool:
        try:
            request("status", guarded.daemon.control_address, 2.0, keys=guarded.keys)
        except KeysError:
            return True
        except NoAnswer:  # cut off before the answer
            pass
        return False

    wait_until(is_locked_out)


@pytest.mark.parametrize("mode", [0o640, 0o604])
def test_a_secret_that_others_may_read_is_refused(robot: Robot, mode: int) -> None:
    secret = key_files.secret_path(robot.folder, SERVER)
    secret.chmod(mode)
    with pytest.raises(KeysError, match="other than the owner") as caught:
        Daemon(load_config(ports=["/dev/null"], **robot.config))
    assert f"chmod 600 {secret}" in caught.value.next_step


def test_a_secret_that_systemd_guards_is_taken(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    secret = key_files.secret_path(robot.folder, SERVER)
    secret.chmod(0o440)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(robot.folder))
    assert read_secret(secret)[0] == read_public(key_files.public_path(robot.folder, SERVER))


@pytest.mark.parametrize(
    ("key", "host"),
    [("stream", "0.0.0.0"), ("control", "*"), ("stream", "eth0"), ("control", "[::]")],
)
def test_beyond_loopback_needs_keys(key: str, host: str, robot: Robot) -> None:
    settings: dict[str, Any] = {"ports": ["/dev/null"], key: f"tcp://{host}:5560"}
    with pytest.raises(ConfigError, match="can be reached from other computers") as caught:
        load_config(**settings)
    assert "tactomo keys make" in caught.value.cause
    assert load_config(**settings, curve=robot.config["curve"]).curve


def test_no_socket_of_ours_is_bound_beyond_loopback_without_keys() -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    with context, pytest.raises(AddressError) as caught:
        bind(context.socket(zmq.REP), "tcp://0.0.0.0:0", "control")
    assert caught.value.name == "keys_needed"


@pytest.fixture
def unchecked_umask() -> Iterator[None]:
    before = os.umask(0)
    yield
    os.umask(before)


@pytest.mark.usefixtures("unchecked_umask")
def test_an_ipc_file_is_for_owner_and_group(bench: Start, tmp_path: Path) -> None:
    path = tmp_path / "left.stream"
    bench(stream=f"ipc://{path}")
    assert path.stat().st_mode & 0o777 == 0o660
    (tmp_path / "other").touch()
    assert (tmp_path / "other").stat().st_mode & 0o777 == 0o666  # the process's own is untouched


def test_an_ipc_path_that_cannot_be_looked_at_is_refused() -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    with context, pytest.raises(AddressError, match="File name too long"):
        bind(context.socket(zmq.REP), f"ipc:///tmp/{'x' * 300}", "control")


def test_a_stale_ipc_file_is_replaced_and_a_file_of_yours_is_not(tmp_path: Path) -> None:
    stale = tmp_path / "stale"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as killed:
        killed.bind(str(stale))
    assert stale.is_socket()
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    with context, context.socket(zmq.REP) as fresh:
        assert bind(fresh, f"ipc://{stale}", "control")
        with pytest.raises(AddressError, match="in use"):
            bind(context.socket(zmq.REP), f"ipc://{stale}", "control")
        assert stale.is_socket()
    yours = tmp_path / "thesis.tex"
    yours.write_text("years of work")
    with context, pytest.raises(AddressError, match="is no socket"):
        bind(zmq.Context.instance().socket(zmq.REP), f"ipc://{yours}", "control")
    assert yours.read_text() == "years of work"
