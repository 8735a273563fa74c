"""`tactomo doctor` on files as people have them, and on a daemon that runs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixture_types import Run
from shared_data import measured
from tactomo.cli.doctor.evidence import evidence_of_messages, stream_findings
from tactomo.cli.sensors import of_this_version
from tactomo.errors import TactomoError
from tactomo.recordings.recording_writer import write_recording
from tactomo_client import request
from tactomo_client.fake import FakeSensor
from tactomo_client.messages import array_to_wire
from tactomo_models import DataError, SensorDescription, load_description, load_or_build_artifact
from tactomo_models.arrays import FloatArray
from tactomo_models.physics.bare_sheet import scan_voltages
from tactomo_models.sensor.description_file import shipped_text
from tactomo_models.sensor.named_pattern import NamedPattern
from tactomo_models.sensor.pattern import reciprocal_pairs, scan_pairs
from tactomo_protocol import Channel, Hello, SampleFormat, Scan, ScanFlag
from waiting import PATIENCE_S, repeated, wait_until
from whole_system import SENSOR, Demo, running_demo

NOISE = 1e-3


@pytest.fixture(scope="module")
def paper() -> SensorDescription:
    return load_description("paper_square")


@pytest.fixture(scope="module")
def rest(paper: SensorDescription) -> FloatArray:
    """Volts that differ from the model's by some per cent, reciprocal ones alike."""
    volts: FloatArray = scan_voltages(paper, load_or_build_artifact(paper).bare.transfer)
    i, j = reciprocal_pairs(paper.pairs).T
    factors = 1 + 0.03 * np.random.default_rng(4).standard_normal(len(i))
    volts[i] *= factors
    volts[j] *= factors
    return volts


def noisy(volts: FloatArray, count: int = 40) -> FloatArray:
    size = np.sqrt(np.mean(volts**2))
    rng = np.random.default_rng(1)
    made: FloatArray = volts + NOISE * size * rng.standard_normal((count, len(volts)))
    return made


def report(outcome: Any) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(outcome.stdout)
    return found


def about(findings: list[dict[str, Any]], what: str) -> dict[str, Any]:
    return next(finding for finding in findings if finding["about"] == what)


def test_a_healthy_batch(tactomo: Run, rest: FloatArray) -> None:
    np.savez("in.npz", magnitude=noisy(rest), structure=noisy(rest), t=np.arange(40) / 10)
    outcome = tactomo("doctor", "in.npz", "--json", status=0)
    found = report(outcome)
    assert found["verdict"] == "healthy"
    assert found["channels"].keys() == {"magnitude", "structure"}
    for channel in found["channels"].values():
        assert about(channel["findings"], "snr")["snr_db"] == pytest.approx(60, abs=1)
        assert channel["electrodes"] == ["good"] * 16
    assert found["stream"] == []


def test_what_one_scan_does_not_tell_is_null(tactomo: Run, rest: FloatArray) -> None:
    np.savez("in.npz", rest=rest[None])
    outcome = tactomo("doctor", "in.npz", "--json")
    assert "NaN" not in outcome.stdout
    assert set(report(outcome)["channels"]["rest"]["snr_db"]) == {None}


def test_a_table_names_the_electrode(
    tactomo: Run, rest: FloatArray, paper: SensorDescription, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    ends = np.hstack([paper.pairs.drive, paper.pairs.measure])
    np.savez("in.npz", structure=noisy(np.where((ends == 3).any(axis=1), 1e-6, 1.0) * rest))
    outcome = tactomo("doctor", "in.npz", status=1)
    assert "electrode 3 reads next to nothing" in outcome.stdout
    told = report(tactomo("doctor", "in.npz", "--json"))["channels"]["structure"]["findings"]
    steps = [finding["next_step"] for finding in told if finding["next_step"]]
    assert steps
    assert all(f" {step}\n" in outcome.stdout for step in steps)  # whole: to be copied
    assert "ill: follow the next steps" in outcome.stdout


def every_pair(electrodes: int, volts: FloatArray) -> FloatArray:
    """Scans of adjacent pairs as every drive by every measuring pair, zero where it cannot be."""
    pairs = scan_pairs(electrodes)
    full = np.zeros((len(volts), electrodes, electrodes))
    full[:, pairs.drive[:, 0], pairs.measure[:, 0]] = volts
    return full.reshape(len(volts), -1)


def test_an_unknown_device_is_read_by_its_zeros(tactomo: Run, rest: FloatArray) -> None:
    np.savez("in.npz", baseline=every_pair(16, np.abs(noisy(rest))), dv=np.zeros((3, 256)))
    outcome = tactomo("doctor", "in.npz", "--json", status=0)
    assert "read as 16:adjacent" in " ".join(report(outcome)["notes"])


def test_voltages_in_no_order_are_a_broken_device(tactomo: Run, rest: FloatArray) -> None:
    mixed = np.random.default_rng(0).permutation(rest)
    np.savez("in.npz", mine=noisy(mixed))
    outcome = tactomo("doctor", "in.npz", "--array", "mine", status=1)
    assert "broken: no reading" in outcome.stdout


def test_a_pattern_says_the_order(tactomo: Run, rest: FloatArray) -> None:
    rotated = NamedPattern.of_name("16:adjacent:rotated")
    np.savez("in.npz", empty=noisy(rest)[:, np.argsort(rotated.order)])
    for more in ([], ["--pattern", str(rotated)]):
        outcome = tactomo("doctor", "in.npz", *more, "--json", status=0)
        assert f"read as {rotated}" in " ".join(report(outcome)["notes"])
        (found,) = report(outcome)["channels"].values()
        assert about(found["findings"], "reciprocity")["level"] == "ok"


def test_complex_scans_are_turned(tactomo: Run, rest: FloatArray) -> None:
    np.savez("in.npz", reference=noisy(rest) * np.exp(0.5j), frames_=np.zeros(1))
    outcome = tactomo("doctor", "in.npz", "--frames", "0:10", "--json", status=0)
    assert "turned by -29 degrees" in " ".join(report(outcome)["notes"])


@pytest.mark.parametrize(
    ("arrays", "arguments", "says"),
    [
        ({"dv": (5, 208)}, [], "holds changes of voltages"),
        ({"other": (5, 208)}, [], "name the array of scans at rest with --array"),
        ({"rest": (5, 7)}, [], "give --description or --pattern"),
        ({"rest": (5, 256)}, [], "256 voltages a scan, which fit no pattern"),
        ({"rest": (5, 208)}, ["--array", "mine"], "there is no array 'mine'"),
        ({"rest": (5, 208)}, ["--pattern", "16:round"], "'16:round' is no pattern"),
        ({"rest": (5, 208)}, ["--frames", "7:9"], "give other --frames"),
    ],
)
def test_what_cannot_be_examined_is_said(
    tactomo: Run, arrays: dict[str, tuple[int, ...]], arguments: list[str], says: str
) -> None:
    np.savez("in.npz", **{name: np.ones(shape) for name, shape in arrays.items()})  # type: ignore[arg-type]
    outcome = tactomo("doctor", "in.npz", *arguments, status=1)
    assert says in outcome.stderr


def test_a_recording_is_examined_by_its_own_scans(tactomo: Run, rest: FloatArray) -> None:
    np.savez("in.npz", magnitude=noisy(rest), structure=noisy(rest))
    tactomo("import", "in.npz", "in.mcap", "--rate", "10", status=0)
    outcome = tactomo("doctor", "in.mcap", "--json", status=0)
    found = report(outcome)
    assert about(found["stream"], "packets")["packets"] >= 80
    assert about(found["stream"], "lost_scans")["number"] == 0
    drift = about(found["channels"]["magnitude"]["findings"], "drift")
    assert abs(drift["percent_per_min"]) < 0.5


@pytest.mark.parametrize(
    ("count", "pressed", "says", "step"),
    [
        (12, False, "not known from 12 scan(s) at rest in 1.1 s", "examine 2 s at rest, or more"),
        (40, True, "something presses, or a contact changes", "choose scans at rest by --frames"),
    ],
)
def test_what_a_recording_does_not_tell_is_said_of_a_recording(
    tactomo: Run, rest: FloatArray, count: int, pressed: bool, says: str, step: str
) -> None:
    volts = noisy(rest, count)
    if pressed:
        volts[count // 2 :, :60] *= 1.01
    np.savez("in.npz", magnitude=volts, structure=volts)
    tactomo("import", "in.npz", "in.mcap", "--rate", "10", status=0)
    found = report(tactomo("doctor", "in.mcap", "--json"))
    drift = about(found["channels"]["magnitude"]["findings"], "drift")
    assert says in drift["detail"]
    assert step in drift["next_step"]


def test_frames_beyond_a_recording_are_the_problem(
    tactomo: Run, paper: SensorDescription, rest: FloatArray
) -> None:
    record_board(paper, noisy(rest), range(40))
    outcome = tactomo("doctor", "board.mcap", "--frames", "50:60", status=1)
    assert "among these --frames" in outcome.stderr


def record_board(paper: SensorDescription, volts: FloatArray, numbers: Sequence[int]) -> None:
    """Record a board that prints: when its scans came is all that is known of time."""
    both = (Channel.MAGNITUDE, Channel.STRUCTURE)
    offsets = (paper.electrode_count, *paper.offsets, paper.measurements)
    hello = Hello("board", "1", both, *offsets, SampleFormat.FLOAT32, 1.0, 0.0)
    scans = [
        (0.1 * number, Scan(channel, number, 0, ScanFlag(0), scan.astype(np.float32)))
        for number, scan in zip(numbers, volts, strict=True)
        for channel in both
    ]
    write_recording(
        "board.mcap",
        hello,
        scans,
        sensor="skin",
        description="paper_square",
        description_sha256=paper.sha256,
    )


def test_a_device_without_a_clock_drifts_by_arrivals(
    tactomo: Run, rest: FloatArray, paper: SensorDescription
) -> None:
    record_board(paper, noisy(rest), range(40))
    found = report(tactomo("doctor", "board.mcap", "--json"))
    drift = about(found["channels"]["magnitude"]["findings"], "drift")
    assert abs(drift["percent_per_min"]) < 0.5
    assert {each["about"] for each in found["stream"]} == {"packets", "lost_scans"}


@pytest.mark.parametrize(
    ("lost", "level", "verdict"), [(1, "advice", "healthy"), (3, "fault", "ill")]
)
def test_one_lost_scan_is_no_rate_of_loss(
    tactomo: Run, rest: FloatArray, paper: SensorDescription, lost: int, level: str, verdict: str
) -> None:
    record_board(paper, noisy(rest), [*range(20), *range(20 + lost, 40 + lost)])
    found = report(tactomo("doctor", "board.mcap", "--json"))
    assert about(found["stream"], "lost_scans")["number"] == lost
    assert about(found["stream"], "lost_scans")["level"] == level
    assert found["verdict"] == verdict


def test_the_broken_device_is_called_broken(tactomo: Run) -> None:
    outcome = tactomo("doctor", measured("skin_bad_device_32el.npz"), status=1)
    assert "broken" in outcome.stdout
    assert "67.8%" in outcome.stdout


@pytest.mark.parametrize("arguments", [[], ["-d", "tank_disc"], ["--frames", "0:20"]])
def test_the_tank_is_not(tactomo: Run, arguments: list[str]) -> None:
    outcome = tactomo("doctor", measured("tank_sciospec_20fps.npz"), *arguments, "--json", status=0)
    assert report(outcome)["verdict"] == "healthy"


def said_by(description: SensorDescription, volts: FloatArray) -> dict[str, dict[str, Any]]:
    """A status, a scan and a map as a daemon sends them, as far as `doctor` reads them."""
    port = {"packets": 9, "corrupt": 0, "faulty": 0, "device": {"device_id": "board-1"}}
    about: dict[str, Any] = {"model": description.name, "file": None, "sha256": description.sha256}
    about["electrodes_mm"] = [[0.0, 0.0]] * description.electrode_count
    issue = {"severity": "warning", "what": "it hums", "next_step": "oil it"}
    status = {"state": "running", "description": about, "ports": [port], "dropped_scans": 0}
    scan = {name: array_to_wire(volts) for name in ("magnitude", "structure")}
    taken = {"scan_counter": 1, "device_us": 50_000, "acquired_monotonic_ns": 50_000_000}
    return {
        "status": {**status, "sensor": "skin", "issues": [issue]},
        "scan": {**scan, **taken},
        "map": {"flags": [], "contacts": []},
    }


def test_messages_that_no_daemon_sends_end_in_no_traceback(
    tactomo: Run, paper: SensorDescription, rest: FloatArray
) -> None:
    said = said_by(paper, rest)
    kinds = {kind: [fields] for kind, fields in said.items()}
    wrong_values: tuple[Any, ...] = (None, 7, "x", [], [1], {"a": 1}, [None], 1e308, [{}])
    sound = evidence_of_messages(kinds, kinds["status"] * 2, None, False)
    assert [finding.detail for finding in sound.issues] == ["it hums"]
    assert sound.devices == ("board-1",)
    for kind, fields in said.items():
        for key in fields:
            for value in wrong_values:
                wrong = {**kinds, kind: [{**fields, key: value}]}
                with suppress(TactomoError, DataError), of_this_version():
                    found = evidence_of_messages(wrong, wrong["status"], None, False)
                    stream_findings(found)
    wrong_status = {**said["status"], "dropped_scans": "few"}
    with FakeSensor("skin") as fake:

        def say() -> None:  # in one thread, as it is one socket
            fake.publish_message("scan", said["scan"])
            fake.publish_message("status", wrong_status)

        look = ("doctor", "-s", "skin", "--address", fake.address, "--seconds", "1")
        with repeated(say):
            told = tactomo(*look, status=1).stderr
    assert "what answers is no daemon of this version: " in told


def test_a_path_that_a_stranger_names_is_not_opened(
    tactomo: Run, paper: SensorDescription, rest: FloatArray, tmp_path: Path
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(shipped_text("paper_square"))
    said = said_by(paper, rest)
    for named in ({"file": str(file)}, {"model": str(file)}):
        about = {**said["status"]["description"], **named}
        status = {**said["status"], "description": about}
        for is_ours, is_opened in ((True, True), (False, False)):
            kinds = {"status": [status], "scan": [said["scan"]], "map": []}
            found = evidence_of_messages(kinds, [status], None, is_ours)
            assert isinstance(found.layout, SensorDescription) == is_opened
            assert any("give --description" in note for note in found.notes) != is_opened


@pytest.fixture(scope="module")
def demo() -> Iterator[Demo]:
    with running_demo() as running:
        yield running


@pytest.mark.slow
def test_the_description_that_a_daemon_holds_is_found(
    tactomo: Run, tmp_path_factory: pytest.TempPathFactory
) -> None:
    file = tmp_path_factory.mktemp("elsewhere") / "mine.toml"
    file.write_text(shipped_text("paper_square").replace('"paper_square"', '"mine"'))
    with running_demo("--description", str(file)) as demo:
        outcome = tactomo("doctor", "-s", SENSOR, "--address", demo.stream, "--seconds", "2")
    assert outcome.returncode == 0
    assert "is not here" not in outcome.stdout


def wait_for_more(count: str, address: str) -> None:
    """Wait until a status counts four more."""
    before = request("status", address, PATIENCE_S)[count]
    wait_until(lambda: request("status", address, PATIENCE_S)[count] >= before + 4)


@pytest.mark.slow
def test_a_healthy_skin_on_a_busy_computer_is_healthy(demo: Demo) -> None:
    """The daemon gets the processor for moments only; its frames are fewer, and none is wrong."""
    request("tare", demo.control, PATIENCE_S)
    daemon = request("status", demo.control, PATIENCE_S)["process"]["pid"]
    look = ["-s", SENSOR, "--address", demo.stream, "--seconds", "4", "--json"]
    program = (sys.executable, "-m", "tactomo.cli", "doctor", *look)
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as doctor:
        while doctor.poll() is None:
            os.kill(daemon, signal.SIGSTOP)
            try:
                wait_for_more("counter", demo.twin)
            finally:
                os.kill(daemon, signal.SIGCONT)
            wait_for_more("frames", demo.control)
        assert doctor.stdout is not None
        found = json.loads(doctor.stdout.read())
    (left_out,) = (each for each in found["stream"] if "left out" in each["detail"])
    assert (left_out["about"], left_out["level"]) == ("daemon", "advice")
    assert [each for each in found["stream"] if each["level"] == "fault"] == []
    assert (found["verdict"], doctor.returncode) == ("healthy", 0)
