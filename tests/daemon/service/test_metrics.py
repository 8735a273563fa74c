"""The Prometheus endpoint: a real scrape of a real daemon, read by the standard parser."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from fixture_types import Start
from prometheus_client import parser
from tactomo.config import load_config
from tactomo.errors import AddressError, ConfigError
from tactomo.service import metrics
from waiting import PATIENCE_S

RULES = Path(__file__).parents[3] / "deploy/prometheus/tactomo.rules.yml"
ANYWHERE = "127.0.0.1:0"


def scrape(daemon: Any) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    """Every sample by its name and its labels but for the sensor's, which all must have."""
    with urlopen(daemon.metrics_address, timeout=30) as answer:
        text = answer.read().decode()
    found = {}
    for family in parser.text_string_to_metric_families(text):
        for sample in family.samples:
            labels = dict(sample.labels)
            if sample.name.startswith("tactomo_"):
                assert labels.pop("sensor") == "left"
            found[sample.name, frozenset(labels.items())] = sample.value
    return found


def key(name: str, **labels: str) -> tuple[str, frozenset[tuple[str, str]]]:
    return f"tactomo_{name}", frozenset(labels.items())


def test_only_who_names_this_computer_is_answered(bench: Start) -> None:
    address = bench(ports=1, metrics=ANYWHERE).daemon.metrics_address
    with urlopen(Request(address, headers={"Host": "localhost:1"}), timeout=30) as answer:
        assert b"tactomo_" in answer.read()
    foreign = Request(address, headers={"Host": "evil.example:80"})  # made to point here
    with pytest.raises(HTTPError) as refused:
        urlopen(foreign, timeout=30)
    assert refused.value.code == 403
    assert b"tactomo_" not in refused.value.read()


def test_a_scrape_says_what_the_status_says(bench: Start, tmp_path: Path) -> None:
    made = bench(ports=1, metrics=ANYWHERE, recording={"file": tmp_path / "a.mcap"}).tare()
    made.step(load=0.5)
    made.skin.lines[0].say(b"\1\2\3\0")
    made.listener.event("corrupt_packets")
    found, status = scrape(made.daemon), made.ask("status")
    port = status["ports"][0]["url"]
    assert found[key("frames_total")] == status["frames"] == 4
    assert found[key("scans_total", channel="magnitude")] == 4
    assert found[key("state", state="running")] + found[key("state", state="stale")] == 1
    assert found[key("port_corrupt_total", port=port)] == status["ports"][0]["corrupt"] > 0
    assert found[key("port_up", port=port)] == 1
    assert found[key("latency_seconds_count")] == 4
    assert found[key("latency_seconds_sum")] > 0
    assert found[key("latency_seconds", quantile="0.99")] > 0
    assert found[key("stage_seconds_count", stage="reconstruct")] == 4
    assert found[key("events_total", event="corrupt_packets")] == 1
    assert found[key("flag", flag="electrode_fault")] == 0
    assert found[key("recording")] == 1
    assert found[key("recording_bytes")] >= 0
    assert found[key("age_seconds")] > 0
    built = {"version": status["version"], "model": "paper_square"}
    assert found[key("build_info", **built)] == 1
    assert found["process_resident_memory_bytes", frozenset()] > 1e7


def test_what_is_unknown_is_left_out_and_the_rules_name_what_there_is(bench: Start) -> None:
    assert bench(ports=1).daemon.metrics_address == ""  # none where there is no key
    daemon = bench(ports=1, metrics=ANYWHERE).daemon
    names = {name for name, _ in scrape(daemon)}
    assert "tactomo_age_seconds" not in names
    assert "tactomo_frames_total" in names
    asked = set(re.findall(r"\btactomo_[a-z_]+", RULES.read_text("utf-8")))
    assert asked - names <= {"tactomo_age_seconds", "tactomo_events_total"}


def test_a_slow_scraper_disturbs_nobody_and_does_not_hold_up_the_stop(
    bench: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metrics._Handler, "timeout", PATIENCE_S)
    made = bench(ports=1, metrics=ANYWHERE).tare()
    port = int(made.daemon.metrics_address.split(":")[2].split("/")[0])
    with socket.create_connection(("127.0.0.1", port)) as slow:
        slow.sendall(b"GET /met")
        made.step()
        assert made.ask("status")["frames"] == 4
        assert scrape(made.daemon)[key("frames_total")] == 4, "another scraper waits for nobody"
        begin_s = time.monotonic()
        made.daemon.stop()
        assert time.monotonic() - begin_s < PATIENCE_S / 2, "less than the scraper's time"


def test_a_port_in_use_is_named_and_nothing_recorded(bench: Start, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = f"127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(AddressError, match=f"cannot offer metrics at {taken}") as caught:
            bench(ports=1, metrics=taken, recording={"file": tmp_path / "a.mcap"})
    assert caught.value.next_step
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("0.0.0.0:9460", "can be reached from other computers"),
        ("127.0.0.1", "use 127.0.0.1:PORT"),
        ("http://127.0.0.1:9460", "use 127.0.0.1:PORT"),
    ],
)
def test_an_address_that_nothing_guards_is_refused(address: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        load_config(ports=["a"], metrics=address)


@pytest.mark.slow
def test_a_missing_library_is_named(tmp_path: Path, make_skin: Callable[[Path, int], Any]) -> None:
    port = make_skin(tmp_path, 1).lines[0].path
    program = (
        "import sys; sys.modules['prometheus_client'] = None; from tactomo.cli import main; "
        f"sys.argv = 'tactomo daemon -p {port} --set metrics={ANYWHERE}'.split(); "
        "main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "pip install 'tactomo[metrics]'" in done.stderr
    assert "Traceback" not in done.stderr
