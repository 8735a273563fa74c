"""`import`: scans of other programs become a recording in the sensor's own order."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixture_types import Run
from numpy.typing import NDArray
from tactomo.recordings.recording import Recording, open_recording
from tactomo_models import load_description
from tactomo_models.arrays import FloatArray
from tactomo_protocol import Channel, CompanionReading, Decoder, Scan

ELECTRODES = 16


def scans(recording: Recording) -> list[tuple[float, Scan]]:
    """Every scan of a recording with its time in seconds since the first."""
    decoder, found = Decoder(), []
    for clock_ns, data in recording.chunks(0):
        found += [(clock_ns, p) for p in decoder.feed(data) if isinstance(p, Scan)]
    return [((clock_ns - found[0][0]) * 1e-9, scan) for clock_ns, scan in found]


def potentials(frames: int, seed: int = 0) -> FloatArray:
    """Volts of every electrode against ground for every injection, (T, 16, 16)."""
    return np.random.default_rng(seed).normal(size=(frames, ELECTRODES, ELECTRODES))


def expected(volts: FloatArray) -> FloatArray:
    """The 208 differences by their definition, independent of the code's pair tables."""
    rows = []
    for k in range(ELECTRODES):
        for m in range(ELECTRODES):
            touched = {k, (k + 1) % ELECTRODES} & {m, (m + 1) % ELECTRODES}
            if not touched:
                rows.append(volts[:, k, m] - volts[:, k, (m + 1) % ELECTRODES])
    return np.array(rows).T


INJECTION = np.array([(k + 1, (k + 1) % ELECTRODES + 1) for k in range(ELECTRODES)])


def test_single_ended_volts_become_differences_in_order(tactomo: Run, tmp_path: Path) -> None:
    volts = potentials(5)
    times = 1.7e9 + np.array([0.0, 0.05, 0.1, 0.3, 0.35])
    complex_volts = volts * (1 + 0.1j)
    np.savez(tmp_path / "in.npz", t=times, injection=INJECTION, volts=complex_volts)
    result = tactomo(
        *(
            "import",
            "in.npz",
            "out.mcap",
            "--description",
            "tank_disc",
            "--reference-frames",
            "0:2",
        ),
        status=0,
    )
    assert "10% is quadrature" in result.stdout
    recording = open_recording(tmp_path / "out.mcap")
    read = scans(recording)
    assert [time_s for time_s, _ in read] == pytest.approx(times - times[0], abs=1e-6)
    assert [scan.counter for _, scan in read] == [0, 1, 2, 3, 4]
    assert {scan.channel for _, scan in read} == {Channel.STRUCTURE}
    got = np.array([scan.samples for _, scan in read])
    assert np.allclose(got, expected(volts), rtol=1e-6, atol=1e-6)
    reference = recording.first_reference()
    assert reference is not None
    assert reference.structure == pytest.approx(expected(volts)[:2].mean(axis=0))
    assert reference.magnitude is None
    assert recording.summary.origin.description == "tank_disc"
    assert recording.summary.origin.description_sha256 == load_description("tank_disc").sha256


def test_a_reversed_and_shuffled_injection_is_put_right(tactomo: Run, tmp_path: Path) -> None:
    volts = potentials(3)
    shuffled = np.random.default_rng(1).permutation(ELECTRODES)
    injection, turned = INJECTION[shuffled], volts[:, shuffled]
    injection[::2], turned[:, ::2] = injection[::2, ::-1].copy(), -turned[:, ::2]
    np.savez(tmp_path / "in.npz", injection=injection, volts=turned)
    tactomo("import", "in.npz", "out.mcap", "--description", "tank_disc", "--rate", "10", status=0)
    read = scans(open_recording(tmp_path / "out.mcap"))
    got = np.array([scan.samples for _, scan in read])
    assert np.allclose(got, expected(volts), rtol=1e-6, atol=1e-6)
    assert [time_s for time_s, _ in read] == pytest.approx([0.0, 0.1, 0.2], abs=1e-6)


def test_a_converters_counts_are_taken_as_they_are(tactomo: Run, tmp_path: Path) -> None:
    """Also unsigned ones, whose differences may be below zero."""
    counts = np.random.default_rng(2).integers(0, 1 << 16, (2, ELECTRODES, ELECTRODES), np.uint16)
    np.savez(tmp_path / "in.npz", injection=INJECTION, volts=counts)
    tactomo("import", "in.npz", "out.mcap", "--description", "tank_disc", "--rate", "10", status=0)
    got = np.array([scan.samples for _, scan in scans(open_recording(tmp_path / "out.mcap"))])
    assert np.array_equal(got, expected(counts.astype(float)))


def test_the_batch_layout_keeps_channels_reference_and_gaps(tactomo: Run, tmp_path: Path) -> None:
    arrays: dict[str, Any] = {
        "magnitude": potentials(4).reshape(4, -1)[:, :208],
        "structure": potentials(4, 1).reshape(4, -1)[:, :208],
        "magnitude_reference": np.full(208, 0.5),
        "structure_reference": np.full(208, 0.25),
    }
    arrays["structure"][2] = np.nan  # that scan did not arrive
    np.savez(tmp_path / "in.npz", **arrays)
    tactomo("import", "in.npz", "out.mcap", "--rate", "20", "--sensor", "left_forearm", status=0)
    recording = open_recording(tmp_path / "out.mcap")
    read = [scan for _, scan in scans(recording)]
    assert [(s.counter, s.channel.name[0]) for s in read] == [
        *((0, "M"), (0, "S"), (1, "M"), (1, "S"), (2, "M"), (3, "M"), (3, "S"))
    ]
    assert read[3].samples == pytest.approx(arrays["structure"][1], rel=1e-6)
    reference = recording.first_reference()
    assert reference is not None
    assert (reference.magnitude[0], reference.structure[0]) == (0.5, 0.25)  # type: ignore[index]
    assert recording.summary.origin.sensor == "left_forearm"


def test_readings_of_companions_are_kept(tactomo: Run, tmp_path: Path) -> None:
    tactomo("models", "copy", "graded_square", "cell.toml", status=0)
    cells = "[companion.cell]\nindex = 7\ngain_n_per_unit = 2.0\nnoise_n = 0.1\n"
    with (tmp_path / "cell.toml").open("a") as file:
        file.write(cells)
    volts = np.random.default_rng(0).normal(size=(4, 208))
    readings = np.array([1.0, 2.0, np.nan, 4.0])
    arrays = {"magnitude": volts, "magnitude_reference": volts[0], "companion_cell": readings}
    np.savez(tmp_path / "in.npz", **arrays, companion_cell_reference=0.5)
    options = ("-d", "cell.toml", "--rate", "20")
    tactomo("import", "in.npz", "out.mcap", *options, status=0)
    recording, decoder = open_recording(tmp_path / "out.mcap"), Decoder()
    packets = [p for _, data in recording.chunks(0) for p in decoder.feed(data)]
    kept = [p for p in packets if isinstance(p, CompanionReading)]
    assert [(p.index, p.device_us, p.value) for p in kept] == [
        *((7, 0, 1.0), (7, 50_000, 2.0), (7, 150_000, 4.0))
    ]
    reference = recording.first_reference()
    assert reference is not None
    assert tuple(reference.companions or ()) == (("cell", 0.5),)
    tactomo("import", "in.npz", "again.mcap", *options, "--reference-frames", "0:2", status=0)
    reference = open_recording(tmp_path / "again.mcap").first_reference()
    assert reference is not None
    assert tuple(reference.companions or ()) == (("cell", 1.5),)


@pytest.mark.parametrize(
    ("arrays", "options", "says"),
    [
        ({"magnitude": np.zeros((4, 207))}, ["--rate", "1"], "real numbers of shape T x 208"),
        ({"magnitude": np.zeros((4, 208))}, [], "give --rate"),
        ({"magnitude": np.zeros((4, 208))}, ["--rate", "1e308"], "are no device's"),
        (
            {"magnitude": np.zeros((4, 208)), "structure": np.zeros((3, 208))},
            ["--rate", "1"],
            "differ in length",
        ),
        ({"magnitude": np.zeros((4, 208)), "t": [0, 2, 1, 3]}, [], "t does not rise"),
        ({"magnitude": np.zeros((4, 208)), "t": [0, 1, 2, 1e13]}, [], "t holds what is out of"),
        (
            {"structure": np.zeros((4, 208)), "magnitude": np.array(["a"])},
            ["--rate", "1", "--description", "tank_disc"],
            "a channel that tank_disc does not have",
        ),
        (
            {"injection": INJECTION, "volts": potentials(2)[:0]},
            ["--rate", "1", "--description", "tank_disc"],
            "volts is float64 (0, 16, 16)",
        ),
        (
            {"magnitude": np.zeros((4, 208))},
            ["--rate", "1", "--description", "tank_disc"],
            "a channel that tank_disc does not have",
        ),
        ({"injection": INJECTION, "volts": potentials(2)}, ["--rate", "1"], "give --channel"),
        (
            {"injection": INJECTION[:15], "volts": potentials(2)[:, :15]},
            ["--rate", "1", "--description", "tank_disc"],
            "no injection (15, 0)",
        ),
        (
            {"injection": INJECTION, "volts": potentials(2)[:, :, :12]},
            ["--rate", "1", "--description", "tank_disc"],
            "(T, 16, 16)",
        ),
        (
            {"injection": INJECTION, "volts": potentials(2) + 1j * potentials(2, 1)},
            ["--rate", "1", "--description", "tank_disc"],
            "out of phase with the current",
        ),
        (
            {"injection": INJECTION, "volts": potentials(2)},
            ["--rate", "1", "--description", "tank_disc", "--reference-frames", "5:9"],
            "the reference frames are none of the 2 scans",
        ),
    ],
)
def test_what_cannot_be_imported_is_refused(
    tactomo: Run, tmp_path: Path, arrays: dict[str, Any], options: list[str], says: str
) -> None:
    np.savez(tmp_path / "in.npz", **arrays)
    result = tactomo("import", "in.npz", "out.mcap", *options, status=1)
    assert says in result.stderr
    assert not (tmp_path / "out.mcap").exists()


def eit_text(volts: NDArray[np.complex128], date: str, first: int = 1) -> str:
    """A frame as Sciospec's program saves it, of all channels up to the last that was measured."""
    header = [18, 2, "setup_00001", date, "10000.0", "10000.0", 0, 1, "0.001", "20.0"]
    channels = ",".join(str(first + n) for n in range(ELECTRODES))
    independent = "MeasurementChannelsIndependentFromInjectionPattern: 1"
    lines = [*map(str, header), *[""] * 6, f"MeasurementChannels: {channels}", independent]
    for pair, row in zip(INJECTION + first - 1, volts, strict=True):
        lines.append(f"{pair[0]} {pair[1]}")
        every = np.concatenate([np.full(first - 1, 7.0), row])
        lines.append("\t".join(f"{v.real:.9E}\t{v.imag:.9E}" for v in every))
    return "\n".join(lines) + "\n"


def save_eit(folder: Path, volts: FloatArray) -> list[Path]:
    """Frames a twentieth of a second apart, with names that are not in the order of time."""
    folder.mkdir()
    paths = [folder / f"frame_{len(volts) - number}.eit" for number in range(len(volts))]
    for number, path in enumerate(paths):
        date = f"2024.01.31. 12:30:05.{50 * number:03d}"
        path.write_text(eit_text(volts[number] * (1 + 0.1j), date))
    return paths


@pytest.mark.parametrize("how", ["folder", "list"])
def test_sciospecs_files_are_read_in_the_order_of_their_dates(
    tactomo: Run, tmp_path: Path, how: str
) -> None:
    volts = potentials(4)
    paths = save_eit(tmp_path / "scan", volts)
    given = [tmp_path / "scan"] if how == "folder" else paths
    tactomo("import", *given, "out.mcap", "--description", "tank_disc", status=0)
    read = scans(open_recording(tmp_path / "out.mcap"))
    assert [time_s for time_s, _ in read] == pytest.approx([0, 0.05, 0.1, 0.15], abs=1e-6)
    got = np.array([scan.samples for _, scan in read])
    assert np.allclose(got, expected(volts), rtol=1e-6, atol=1e-6)


def test_channels_that_were_not_measured_are_left_out(tactomo: Run, tmp_path: Path) -> None:
    """Electrodes on the instrument's channels 17 to 32, and columns of 1 to 32."""
    volts = potentials(1)
    text = eit_text(volts[0] * (1 + 0j), "2024.01.31. 12:30:05.000", 17)
    (tmp_path / "a.eit").write_text(text)
    tactomo("import", "a.eit", "out.mcap", "-d", "tank_disc", "--rate", "1", status=0)
    [(_, scan)] = scans(open_recording(tmp_path / "out.mcap"))
    assert np.allclose(scan.samples, expected(volts)[0], rtol=1e-6, atol=1e-6)
    (tmp_path / "b.eit").write_text(text.replace("\n17 18\n", "\n3 18\n"))
    told = tactomo("import", "b.eit", "out2.mcap", "-d", "tank_disc", "--rate", "1").stderr
    assert "b.eit, line 17: channel 3 is injected at, not measured" in told
    (tmp_path / "c.eit").write_text(text.replace("Channels: 17,", "Channels: 77,"))
    told = tactomo("import", "c.eit", "out3.mcap", "-d", "tank_disc", "--rate", "1").stderr
    assert "c.eit, line 17: 16 channels, and 32 were saved" in told


@pytest.mark.parametrize(
    ("line", "text", "says"),
    [
        (1, "12", "line 1: 12, not 9 or 11 or 18 header lines; is it a Sciospec file"),
        (1, "eit", "line 1: the number of header lines is no number"),
        (4, "2024.01.31. 12:30:05.5e999", "line 4: it is no date such as"),
        (8, "3", "line 8: 3 frequencies; save one"),
        (19, "1 1", "line 19: 1 1 is no injection"),
        (20, "0.1\t0.2\t0.3", "line 20: 3 numbers, not pairs"),
        (24, "0.1\tx", "line 24: a value is not a number"),
        (19, None, "line 19: no injection; it was cut off"),
    ],
)
def test_a_line_that_is_wrong_is_named(
    tactomo: Run, tmp_path: Path, line: int, text: str | None, says: str
) -> None:
    [path] = save_eit(tmp_path / "scan", potentials(1))
    lines = path.read_text().splitlines()
    lines[line - 1 :] = [] if text is None else [text, *lines[line:]]
    path.write_text("\n".join(lines))
    result = tactomo("import", path, "out.mcap", "--description", "tank_disc", status=1)
    assert f"{path}, {says}" in result.stderr
    assert not (tmp_path / "out.mcap").exists()


def test_sciospecs_files_must_belong_together(tactomo: Run, tmp_path: Path) -> None:
    first, second = save_eit(tmp_path / "scan", potentials(2))
    second.write_text(second.read_text().replace("\n1 2\n", "\n1 3\n"))
    result = tactomo("import", first, second, "out.mcap", "--description", "tank_disc")
    assert "different injections" in result.stderr
    (tmp_path / "empty").mkdir()
    assert "holds no .eit file" in tactomo("import", "empty", "out.mcap").stderr
    assert "cannot read none.eit" in tactomo("import", "none.eit", "out.mcap").stderr


def test_an_existing_recording_is_not_overwritten(tactomo: Run, tmp_path: Path) -> None:
    np.savez(tmp_path / "in.npz", magnitude=np.ones((4, 208)))
    (tmp_path / "out.mcap").write_text("precious")
    result = tactomo("import", "in.npz", "out.mcap", "--rate", "1", status=1)
    assert "exists already" in result.stderr
    assert (tmp_path / "out.mcap").read_text() == "precious"
