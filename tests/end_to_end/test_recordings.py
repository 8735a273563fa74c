"""Recordings: a replay gives the live maps again, and a measured stream goes the same way."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from mcap.reader import make_reader
from selenium.webdriver import Chrome
from shared_data import measured
from tactomo_client import Frame, request, subscribe
from tactomo_client.messages import MAP, decode_message
from waiting import PATIENCE_S, wait_until
from whole_system import ANYWHERE, SENSOR, Demo


def tactomo(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tactomo.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def maps_in(recording: Path) -> dict[int, dict[str, Any]]:
    """Maps of a recording by their scan counter."""
    found = {}
    with recording.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.topic == MAP:
                decoded = decode_message(message.data)
                assert decoded.kind == MAP
                found[decoded.fields["scan_counter"]] = decoded.fields
    return found


class Listener(threading.Thread):
    """Keeps every map that a demo publishes, by its scan counter."""

    def __init__(self, demo: Demo) -> None:
        super().__init__(daemon=True)
        self.frames: dict[int, Frame] = {}
        self._subscription = subscribe(SENSOR, address=demo.stream, timeout_s=PATIENCE_S)
        self._done = threading.Event()

    def __enter__(self) -> Self:
        self.start()
        wait_until(lambda: self.frames, "the first frame")
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self.join(PATIENCE_S)
        self._subscription.close()

    def hear_more(self, count: int) -> None:
        """Wait for so many more frames than there are now."""
        heard = len(self.frames)
        wait_until(lambda: len(self.frames) >= heard + count, f"{count} frames")

    def run(self) -> None:
        for frame in self._subscription:
            self.frames[frame.scan_counter] = frame
            if self._done.is_set():
                break


@pytest.mark.slow
def test_a_replay_gives_the_maps_of_the_live_run(demo: Demo, tmp_path: Path) -> None:
    again = tmp_path / "again.mcap"
    demo.press(15.0, 20.0, id="a")  # begun under load: the reference must come along
    with subscribe(SENSOR, address=demo.stream, timeout_s=PATIENCE_S) as frames:
        next(frame for frame in frames if frame.contacts)
    with Listener(demo) as listener:
        started = request("record_start", demo.control, PATIENCE_S, path="live.mcap")
        live = Path(started["path"])
        for x_mm, y_mm in ((15.0, 20.0), (0.0, 0.0), (-40.0, -35.0)):
            demo.press(x_mm, y_mm, id="a", pressure_kpa=170)
            listener.hear_more(12)
        demo.press(40.0, -40.0, id="b", shape="rectangle")
        listener.hear_more(12)
        demo.clear()
        listener.hear_more(8)
        request("record_stop", demo.control, PATIENCE_S)
        last = request("status", demo.twin, PATIENCE_S)["counter"]
        wait_until(lambda: max(listener.frames) > last, "all that was recorded")
    replayed = tactomo(
        *("daemon", "--port", f"replay://{live}?port=0&speed=0"),
        *("--port", f"replay://{live}?port=1&speed=0", "--set", f"recording.file={again}"),
        *(
            "--set",
            "recording.maps=true",
            "--set",
            "exit_at_end=true",
            "--stream",
            ANYWHERE,
            "--control",
            ANYWHERE,
        ),
    )
    assert replayed.returncode == 0, replayed.stderr
    replays = maps_in(again)
    assert len(replays) > 20
    assert any(fields["contacts"] for fields in replays.values())
    for counter, got in replays.items():
        expected = listener.frames[counter]
        assert got["tier"] == expected.tier
        for name, image in (("map", expected.map), ("structure", expected.structure)):
            if image is None:  # of a scan that came too late on a busy computer
                assert got[name] is None
            else:
                np.testing.assert_allclose(array(got[name]), image, atol=1e-6)
        assert [c["x_mm"] for c in got["contacts"]] == pytest.approx(
            [c.x_mm for c in expected.contacts], abs=1e-6
        )


def array(wire: Any) -> Any:
    return np.frombuffer(wire["data"], wire["dtype"]).reshape(wire["shape"])


@pytest.mark.slow
def test_a_measured_stream_is_imported_replayed_and_located(tmp_path: Path) -> None:
    recording, again = tmp_path / "tank.mcap", tmp_path / "again.mcap"
    tank = measured("tank_sciospec_20fps.npz")
    imported = tactomo(
        *("import", tank, recording, "--description", "tank_disc", "--reference-frames", "0:20")
    )
    assert imported.returncode == 0, imported.stderr
    replayed = tactomo(
        *(
            "daemon",
            "--description",
            "tank_disc",
            "--port",
            f"replay://{recording}?port=0&speed=0",
        ),
        *("--set", f"recording.file={again}", "--set", "recording.maps=true"),
        *("--set", "exit_at_end=true"),
        *("--stream", ANYWHERE, "--control", ANYWHERE),
    )
    assert replayed.returncode == 0, replayed.stderr
    maps = maps_in(again)
    assert len(maps) == 255
    frames = [maps[counter] for counter in sorted(maps)]
    assert all(not frame["contacts"] for frame in frames[:20]), "the tank is empty at first"
    moving = [frame["contacts"] for frame in frames[130:200]]
    assert all(len(contacts) == 1 for contacts in moving), "one cup"
    angle = np.unwrap([math.atan2(contacts[0]["y_mm"], contacts[0]["x_mm"]) for contacts in moving])
    # The hand leads it around the tank, counter-clockwise, by well over half a turn.
    assert angle[-1] - angle[0] > math.pi
    assert np.diff(angle).min() > -0.2


@pytest.mark.slow
@pytest.mark.browser
def test_a_replay_with_a_page_begins_when_the_page_is_open(
    demo: Demo, browser: Chrome, tmp_path: Path
) -> None:
    with Listener(demo) as listener:
        started = request("record_start", demo.control, PATIENCE_S, path="short.mcap")
        path = Path(started["path"])
        listener.hear_more(20)
        request("record_stop", demo.control, PATIENCE_S)
    control = f"ipc://{tmp_path}/control"
    command = ["replay", path, "--viewer", "--loop", "--viewer-port", 0, "--control", control]
    command += ["--stream", f"ipc://{tmp_path}/stream"]
    replay = subprocess.Popen(
        [sys.executable, "-m", "tactomo.cli", *map(str, command)],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert replay.stdout is not None
        words = (word for line in replay.stdout for word in line.split())
        page = next(word for word in words if word.startswith("http://"))
        waiting = request("status", control, PATIENCE_S)
        assert (waiting["state"], waiting["frames"]) == ("paused", 0)
        browser.get(page)
        wait_until(
            lambda: request("status", control, PATIENCE_S)["frames"] > 40, "the second round"
        )
    finally:
        replay.terminate()
        replay.communicate(timeout=PATIENCE_S)
