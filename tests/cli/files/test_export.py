"""`tactomo export`: what other programs read of a recording is what was recorded."""

from __future__ import annotations

import csv
import json
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixture_types import Run
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mcap_ros2.decoder import DecoderFactory as Ros2DecoderFactory
from recorded_grasp import FRAMES, PERIOD_NS, SENSOR, START_NS, contacts_of, write_grasp
from small_sensor import SMALL
from tactomo.cli.files.recorded_frames import recorded_frames
from tactomo.recordings.recording import Origin
from tactomo.recordings.recording_writer import RecordingWriter
from tactomo_models import Press, Reconstruction, Reconstructor, SkinSimulator, load_description
from tactomo_models.scans.measurement import Measurement
from tactomo_protocol import Channel
from waiting import wait_until


@pytest.fixture
def grasp(tmp_path: Path) -> Path:
    return write_grasp(tmp_path / "grasp.mcap")


@contextmanager
def files_up_to(size_bytes: int) -> Iterator[None]:
    """No file may be longer, as on a full disk, of whatever program begins in here."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def decoded(path: Path, topic: str) -> list[tuple[int, Any]]:
    """Read a topic by the MCAP and protobuf libraries, and the schemas in the file itself."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        if topic.endswith("/frame"):
            plain = reader.iter_messages(topics=[topic])
            return [(message.log_time, json.loads(message.data)) for _, _, message in plain]
        found = reader.iter_decoded_messages(topics=[topic])
        return [(each.message.log_time, each.decoded_message) for each in found]


def test_contacts_as_a_table(tactomo: Run, grasp: Path) -> None:
    result = tactomo("export", grasp, "contacts.csv", status=0)
    assert result.stdout == f"wrote contacts.csv: contacts, {FRAMES} frames\n"
    rows = rows_of(grasp.with_name("contacts.csv"))
    for number in range(FRAMES):
        at_s = number * PERIOD_NS * 1e-9
        of_frame = [row for row in rows if float(row["time_s"]) == pytest.approx(at_s)]
        expected = contacts_of(number)
        if not expected:
            assert [row["id"] for row in of_frame] == [""]  # nothing pressed, and that is known
            continue
        assert len(of_frame) == len(expected)
        for row, contact in zip(of_frame, expected, strict=True):
            assert int(row["acquired_realtime_ns"]) == START_NS + number * PERIOD_NS
            assert float(row["x_mm"]) == contact.x_mm  # to the last bit
            pressure = row["pressure_kpa"]
            assert (float(pressure) if pressure else None) == contact.pressure_kpa
            assert row["pressure_range"] == contact.pressure_range
            assert row["flags"] == ("misfit_high" if number in (33, 34) else "")


def test_a_file_for_foxglove(tactomo: Run, grasp: Path) -> None:
    tactomo("export", grasp, "fox.mcap", "--layout", "left.json", status=0)
    fox = grasp.with_name("fox.mcap")
    numbers = decoded(fox, f"/{SENSOR}/frame")
    assert [time for time, _ in numbers] == [START_NS + n * PERIOD_NS for n in range(FRAMES)]
    assert [m["contact_count"] for _, m in numbers] == [len(contacts_of(n)) for n in range(FRAMES)]
    assert {round(m["age_ms"], 6) for _, m in numbers} == {7.0}
    scenes = decoded(fox, f"/{SENSOR}/contacts")
    assert [len(scene.entities) for _, scene in scenes] == [m["contact_count"] for _, m in numbers]
    assert len(decoded(fox, f"/{SENSOR}/grid")) == FRAMES - 5
    assert len(decoded(fox, f"/{SENSOR}/sheet")) == 1
    assert decoded(fox, "/tf")[0][1].transforms[0].parent_frame_id == "world"
    assert f"/{SENSOR}/grid" in grasp.with_name("left.json").read_text()


def test_some_seconds_of_it(tactomo: Run, grasp: Path) -> None:
    tactomo("export", grasp, "some.csv", "--from", 1, "--to", 1.5, status=0)
    times = [float(row["time_s"]) for row in rows_of(grasp.with_name("some.csv"))]
    assert (min(times), max(times)) == (1.0, 1.45)


def test_a_wall_clock_that_is_set_does_not_fold_the_times(tactomo: Run, tmp_path: Path) -> None:
    def set_back(number: int) -> dict[str, Any]:
        hour = 3_600_000_000_000 if number >= 30 else 0
        return {"acquired_realtime_ns": START_NS + number * PERIOD_NS - hour}

    write_grasp(tmp_path / "set.mcap", change=set_back)
    tactomo("export", "set.mcap", "set.csv", status=0)
    times = sorted({float(row["time_s"]) for row in rows_of(tmp_path / "set.csv")})
    np.testing.assert_allclose(times, np.arange(FRAMES) * PERIOD_NS * 1e-9)


def test_a_daemon_that_was_restarted_begins_anew(tactomo: Run, tmp_path: Path) -> None:
    """Its computer was, too: the monotonic clock begins at nought, and so do the identities."""

    def restart(number: int) -> dict[str, Any]:
        if number < 45:
            return {}
        return {"session": "again", "acquired_monotonic_ns": (number - 45) * PERIOD_NS}

    write_grasp(tmp_path / "two.mcap", change=restart)
    tactomo("export", "two.mcap", "two.csv", status=0)
    times = sorted({float(row["time_s"]) for row in rows_of(tmp_path / "two.csv")})
    np.testing.assert_allclose(times, np.arange(FRAMES) * PERIOD_NS * 1e-9)
    result = tactomo("plot", "two.mcap", "-o", "two.svg")
    assert "wrote two.svg: 4 contacts" in result.stdout  # 1 and 2, then 1' and 2'


def test_a_recording_cut_before_its_first_frame_has_nothing_to_export(
    tactomo: Run, grasp: Path
) -> None:
    grasp.write_bytes(grasp.read_bytes()[:600])
    result = tactomo("export", grasp, "contacts.csv", status=1)
    assert "no dual scan of paper_square is in it" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "status", "says"),
    [
        (["grasp.mcap", "out.txt"], 2, ".mcap, .csv, or add"),
        (["grasp.mcap", "out.npz"], 2, ".mcap, .csv, or add"),
        (["grasp.mcap", "grasp.mcap", "--force"], 2, "is what is read"),
        (["grasp.mcap", "out.mcap", "--layout", "grasp.mcap", "--force"], 2, "is what is read"),
        (["grasp.mcap", "out.csv", "--from", "3", "--to", "2"], 2, "is not after --from"),
        (["grasp.mcap", "out.csv", "--from", "99"], 1, "no frames"),
        (["grasp.mcap", "nowhere/out.csv"], 1, "cannot write nowhere/out.csv"),
    ],
)
@pytest.mark.usefixtures("grasp")
def test_what_goes_wrong_is_told(
    tactomo: Run, tmp_path: Path, arguments: list[str], status: int, says: str
) -> None:
    recording = (tmp_path / "grasp.mcap").read_bytes()
    result = tactomo("export", *arguments, status=status)
    assert says in result.stderr.replace("\n", " ")
    assert (tmp_path / "grasp.mcap").read_bytes() == recording
    assert sorted(path.name for path in tmp_path.iterdir()) == ["grasp.mcap"]


def test_what_was_there_stays_where_writing_fails(tactomo: Run, grasp: Path) -> None:
    for name in ("contacts.csv", "fox.mcap"):
        grasp.with_name(name).write_text("precious")
        with files_up_to(4096):
            result = tactomo("export", grasp, name, "--force")
        assert result.returncode == 1, name
        assert f"cannot write {name}" in result.stderr
        assert grasp.with_name(name).read_text() == "precious"
    assert len(list(grasp.parent.iterdir())) == 3


def test_an_export_for_foxglove_ends_where_writing_first_fails(grasp: Path) -> None:
    """It went on to the recording's end, with two lines of the writer for each frame."""
    command = [
        sys.executable,
        "-m",
        "tactomo.cli",
        "export",
        str(grasp),
        f"{grasp.parent}/fox.mcap",
    ]
    with files_up_to(0):
        result = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert "fox.mcap: File too large; make room" in result.stderr
    assert result.stderr.count("error logging message") < 10  # of one frame


def test_what_is_there_is_written_over_only_if_one_says_so(tactomo: Run, grasp: Path) -> None:
    for name in ("contacts.csv", "layout.json"):
        grasp.with_name(name).write_text("precious")
    into_csv = ("export", grasp, "contacts.csv")
    with_layout = ("export", grasp, "fox.mcap", "--layout", "layout.json")
    for arguments, name in ((into_csv, "contacts.csv"), (with_layout, "layout.json")):
        result = tactomo(*arguments, status=1)
        assert f"{name} exists already" in result.stderr
        assert "--force" in result.stderr
        assert grasp.with_name(name).read_text() == "precious"
        tactomo(*arguments, "--force", status=0)
        assert grasp.with_name(name).read_text() != "precious"


def test_a_recording_of_two_ports_is_none_of_a_sensor_of_one_channel(
    tactomo: Run, tmp_path: Path
) -> None:
    origin = Origin("left", "paper_square", "", ("/dev/magnitude", "/dev/structure"), "0.1")
    RecordingWriter(tmp_path / "two.mcap", origin).close()
    result = tactomo("export", "two.mcap", "out.csv", "-d", "graded_square", status=1)
    assert "graded_square has one channel, and the recording is of two" in result.stderr
    assert "give another --description" in result.stderr


def bare_recording(tactomo: Run, tmp_path: Path, scans_pressed: int) -> Path:
    """Record a small sheet without maps: at rest for 25 scans, pressed on the right, let go."""
    (tmp_path / "small.toml").write_text(SMALL)
    skin = SkinSimulator(load_description(str(tmp_path / "small.toml")), spacing_m=0.002)
    rest, pressed = skin.voltages(()), skin.voltages([Press(0.01, 0.0, 180.0, 0.008)])
    noise = np.random.default_rng(1)
    scans = {
        str(c): np.array([rest[c]] * 25 + [pressed[c]] * scans_pressed + [rest[c]] * 5)
        for c in Channel
    }
    scans = {n: v + noise.normal(0, 1e-5 * np.abs(v).max(), v.shape) for n, v in scans.items()}
    references = {f"{name}_reference": volts[:20].mean(axis=0) for name, volts in scans.items()}
    arrays: dict[str, Any] = {**scans, **references}
    np.savez(tmp_path / "in.npz", **arrays)
    arguments = ("import", "in.npz", "bare.mcap", "--description", "small.toml", "--rate", 20)
    tactomo(*arguments, "--reference-frames", "0:20", status=0)
    return tmp_path / "bare.mcap"


@pytest.mark.slow
def test_what_holds_no_frames_is_reconstructed_first(tactomo: Run, tmp_path: Path) -> None:
    bare_recording(tactomo, tmp_path, scans_pressed=10)
    tactomo("export", "bare.mcap", "made.csv", "--from", 1, status=0)
    rows = rows_of(tmp_path / "made.csv")
    assert {float(row["time_s"]) >= 1.0 for row in rows} == {True}
    assert {row["age_s"] for row in rows} == {""}  # nobody knows it
    touched = [row for row in rows if row["id"]]
    times = [float(row["time_s"]) for row in touched]
    assert (min(times), max(times)) == pytest.approx((1.25, 1.7), abs=0.02)
    assert float(touched[5]["x_mm"]) == pytest.approx(10.0, abs=2.0)
    tactomo("export", "bare.mcap", "made", "--ros2", "--from", 1, status=0)
    with (tmp_path / "made/made.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[Ros2DecoderFactory()])
        told = list(reader.iter_decoded_messages(topics=["/diagnostics"]))
    assert told
    for each in told:
        keys = {value.key for value in each.decoded_message.status[0].values}
        assert "sequence" in keys
        assert "age_s" not in keys  # nobody knows it here, either
        stamp = each.decoded_message.header.stamp
        assert each.message.log_time == stamp.sec * 1_000_000_000 + stamp.nanosec
    tactomo("plot", "bare.mcap", "-o", "made.png", status=0)
    assert not list(tmp_path.glob(".tactomo*"))


@pytest.mark.slow
def test_a_frame_that_was_made_just_now_is_not_stale(
    tactomo: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slowly(self: Reconstructor, measurement: Measurement) -> Reconstruction:
        time.sleep(0.1)
        return solve(self, measurement)

    solve = Reconstructor.solve
    monkeypatch.setattr(Reconstructor, "solve", slowly)
    with recorded_frames(bare_recording(tactomo, tmp_path, scans_pressed=1), None) as made:
        frames = [moment.frame for moment in made.moments("contacts")]
    assert max(frame.age_s for frame in frames) > 0.5
    assert all(frame.is_known for frame in frames)


@pytest.mark.slow
def test_half_a_reconstruction_is_no_export(tactomo: Run, tmp_path: Path) -> None:
    bare_recording(tactomo, tmp_path, scans_pressed=600)
    command = [sys.executable, "-m", "tactomo.cli", "export", "bare.mcap", "made.csv"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE) as process:
        wait_until(lambda: list(tmp_path.glob(".tactomo*/bare.mcap")) or process.poll() is not None)
        assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 130
    assert not (tmp_path / "made.csv").exists()
    assert not list(tmp_path.glob(".tactomo*"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("export bare.mcap made.csv", "cannot reconstruct bare.mcap"),
        ("replay bare.mcap --speed max --record made.mcap", "made.mcap ended early"),
    ],
)
def test_a_reconstruction_that_the_disk_has_no_room_for_is_no_good_end(
    tactomo: Run, tmp_path: Path, command: str, said: str
) -> None:
    """The frames up to there were exported as if they were all."""
    bare_recording(tactomo, tmp_path, scans_pressed=60)
    with files_up_to(40_000):
        result = tactomo(*command.split(), status=1)
    assert said in result.stderr
    assert "File too large" in result.stderr
    assert "make room" in result.stderr
    assert not (tmp_path / "made.csv").exists()


@pytest.mark.long
def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    """Ten minutes of maps are 0.4 GB as arrays."""

    def most_mb(source: Path, output: str, *more: str) -> float:
        program = (
            "import resource, sys; from tactomo.cli import main\n"
            f"sys.argv = {['tactomo', 'export', *map(str, (source, tmp_path / output)), *more]!r}\n"
            "try: main()\n"
            "finally: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)"
        )
        command = [sys.executable, "-c", program]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return float(done.stdout.splitlines()[-1])

    short = write_grasp(tmp_path / "short.mcap", [n % FRAMES for n in range(1200)])
    long = write_grasp(tmp_path / "long.mcap", [n % FRAMES for n in range(12_000)])
    for output in ("out.csv", "out.mcap"):
        assert most_mb(long, output) < most_mb(short, f"short_{output}") + 60, output
    assert most_mb(long, "long", "--ros2") < most_mb(short, "short", "--ros2") + 60
