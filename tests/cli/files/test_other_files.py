"""Files that people have: MATLAB's, text and .eit go through `reconstruct` as .npz does."""

from __future__ import annotations

import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from fixture_types import Run
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import savemat
from scipy.sparse import csc_array
from tactomo.errors import TactomoError
from tactomo.recordings.imported_scans import read_scans
from tactomo_models import DataError, DescriptionError, Press, SkinSimulator, load_description
from tactomo_models.archive import read_arrays
from tactomo_models.arrays import FloatArray
from tactomo_models.sensor.named_pattern import NamedPattern, fitting_patterns

WHERE = Press(0.05, 0.02, 150.0, 0.02)
FRAMES = 4
ROWS = np.arange(416.0).reshape(2, 208) + 1


@cache
def tank(pattern: str = "16:adjacent") -> tuple[FloatArray, FloatArray]:
    """Scans of an empty tank (FRAMES, M), and with an object at (50, 20) mm, with some noise."""
    named = NamedPattern.of_name(pattern)
    skin = SkinSimulator(named.applied(load_description("tank_disc")))
    noise = np.random.default_rng(0)
    scans = []
    for presses in ([], [WHERE]):
        [volts] = skin.voltages(presses).values()
        scans.append(volts + 1e-4 * np.abs(volts).mean() * noise.normal(size=(FRAMES, len(volts))))
    order = np.argsort(named.order)
    return scans[0][:, order], scans[1][:, order]


def located(tactomo: Run, folder: Path, *arguments: Any) -> str:
    """Reconstruct, see that the object is where it is, and return what was said."""
    result = tactomo(
        *("reconstruct", arguments[0], folder / "maps.npz", "-d", "tank_disc", "--force"),
        *("--method", "tikhonov", *arguments[1:]),
        status=0,
    )
    maps = read_arrays(folder / "maps.npz")
    assert not maps["flags"].any()
    last = maps["contact_frame"] == maps["contact_frame"].max()
    place = maps["contact_x_mm"][last], maps["contact_y_mm"][last]
    assert np.hypot(place[0] - 50, place[1] - 20).min() < 10
    return str(result.stderr)


def text(rows: FloatArray, delimiter: str = ",", comma: bool = False) -> str:
    lines = [delimiter.join(f"{v:.9g}" for v in row) for row in rows]
    return "\n".join(line.replace(".", ",") if comma else line for line in lines) + "\n"


def test_matlab_arrays(tactomo: Run, tmp_path: Path) -> None:
    """Frames in columns, as of EIDORS, or in rows, in structs or not; and the names of .npz."""
    rest, there = tank()
    savemat(tmp_path / "a.mat", {"vh": rest.mean(0)[:, None], "vi": there.T, "note": "text"})
    savemat(tmp_path / "b.mat", {"vh": {"meas": rest[0][:, None]}})
    savemat(tmp_path / "c.mat", {"data": {"meas": there.T, "name": "full"}})
    times = np.arange(FRAMES)[:, None]
    savemat(tmp_path / "d.mat", {"structure": there, "structure_reference": rest[:1], "t": times})
    located(tactomo, tmp_path, tmp_path / "a.mat")
    located(tactomo, tmp_path, tmp_path / "c.mat", "--reference", tmp_path / "b.mat")
    located(tactomo, tmp_path, tmp_path / "d.mat")


def save_hdf5(path: Path, arrays: dict[str, Any]) -> None:
    """Save as MATLAB does with -v7.3: axes reversed, complex fields, cells of references."""

    def put(group: h5py.Group, name: str, value: Any) -> Any:
        if isinstance(value, dict):
            made = group.create_group(name)
            for field, each in value.items():
                put(made, field, each)
            kind = "struct"
        elif isinstance(value, list):
            held = group.file.require_group("#refs#")
            links = [[put(held, f"{name}{i}", each).ref] for i, each in enumerate(value)]
            made, kind = group.create_dataset(name, data=links, dtype=h5py.ref_dtype), "cell"
        elif isinstance(value, str):
            codes = np.array([[ord(letter)] for letter in value], np.uint16)
            made, kind = group.create_dataset(name, data=codes), "char"
        elif hasattr(value, "tocsc"):
            made, kind = group.create_group(name), "double"
            made.attrs["MATLAB_sparse"] = np.uint64(value.shape[0])
            for field, part in (("data", value.data), ("ir", value.indices), ("jc", value.indptr)):
                made.create_dataset(field, data=part)
        else:
            turned = np.ascontiguousarray(value.T)
            if turned.dtype.kind == "c":
                turned = turned.view([("real", "f8"), ("imag", "f8")])
            made = group.create_dataset(name, data=turned, chunks=turned.shape, compression=3)
            kind = "double"
        made.attrs["MATLAB_class"] = np.bytes_(kind)
        return made

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in arrays.items():
            put(file, name, value)
    header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 .".ljust(124) + b"\0\2IM"
    with path.open("r+b") as whole:
        whole.write(header)


@pytest.mark.slow
def test_matlab_arrays_of_version_7_3(tactomo: Run, tmp_path: Path) -> None:
    rest, there = tank()
    save_hdf5(tmp_path / "a.mat", {"vh": [rest], "vi": {"meas": there.T}, "note": 208 * "x"})
    save_hdf5(tmp_path / "b.mat", {"several": [rest, there], "vi": [{"meas": there * 1j}]})
    located(tactomo, tmp_path, tmp_path / "a.mat")
    read = read_arrays(tmp_path / "a.mat")
    assert list(read) == ["vh", "vi.meas"]
    np.testing.assert_array_equal(read["vi.meas"], there.T)
    read = read_arrays(tmp_path / "b.mat")
    assert list(read) == ["vi.meas"]
    np.testing.assert_array_equal(read["vi.meas"], there * 1j)
    sparse = csc_array(np.where(rest > 0, rest, 0))
    save_hdf5(tmp_path / "d.mat", {"s": {"f": [sparse, there]}})
    with h5py.File(tmp_path / "d.mat", "r+") as file:  # a field of an array of structs
        del file["s/f"].attrs["MATLAB_class"]
    read = read_arrays(tmp_path / "d.mat")
    np.testing.assert_array_equal(read["s(1).f"], sparse.toarray())
    np.testing.assert_array_equal(read["s(2).f"], there)
    cells = np.empty((2, 1), object)
    cells[:, 0] = rest, there
    savemat(tmp_path / "c.mat", {"vh": cells[:1], "several": cells})
    np.testing.assert_array_equal(read_arrays(tmp_path / "c.mat")["vh"], rest)
    assert list(read_arrays(tmp_path / "c.mat")) == ["vh"]


def test_matlab_arrays_of_version_7_3_without_h5py(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_hdf5(tmp_path / "in.mat", {"vh": np.ones((1, 208))})
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(DataError, match=r"pip install 'tactomo\[matlab\]', or in MATLAB: x = load"):
        read_arrays(tmp_path / "in.mat")


def test_a_sign_of_their_own(tactomo: Run, tmp_path: Path) -> None:
    rest, there = tank()
    (tmp_path / "in.csv").write_text(text(-np.vstack([rest, there])))
    said = located(tactomo, tmp_path, tmp_path / "in.csv", "--reference-frames", "0:4")
    assert "turned round" in said
    [channel] = load_description("tank_disc").channels
    arrays = {channel: -there, f"{channel}_reference": -rest}
    np.savez(tmp_path / "in.npz", **arrays)  # type: ignore[arg-type]
    assert "turned round" in located(tactomo, tmp_path, tmp_path / "in.npz")


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".csv", ".txt", ".tsv", ".dat"])
@pytest.mark.parametrize("columns", [False, True])
def test_text(tactomo: Run, tmp_path: Path, ending: str, columns: bool) -> None:
    rows = np.vstack(tank())
    delimiter = {".csv": ", ", ".txt": " ", ".tsv": "\t", ".dat": ";"}[ending]
    said = "# made by hand\nvolts of one tank\n\n" + text(rows.T if columns else rows, delimiter)
    (tmp_path / f"in{ending}").write_text(said)
    located(tactomo, tmp_path, tmp_path / f"in{ending}", "--reference-frames", f"0:{FRAMES}")


def test_a_decimal_comma_and_times(tactomo: Run, tmp_path: Path) -> None:
    rest, there = tank()
    rows = np.column_stack([0.5 * np.arange(2 * FRAMES), np.vstack([rest, there])])
    (tmp_path / "in.csv").write_text(text(rows, ";", comma=True))
    located(tactomo, tmp_path, tmp_path / "in.csv", "--reference-frames", "0:1")
    scans = read_scans(tmp_path / "in.csv", load_description("tank_disc"), None)
    np.testing.assert_allclose(scans.times(None), rows[:, 0])
    [volts] = scans.volts.values()
    np.testing.assert_allclose(volts[:FRAMES], rest, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("pattern", ["32:adjacent", "16:opposite:adjacent", "16:adjacent:rotated"])
def test_another_pattern_is_proposed_and_then_read(
    tactomo: Run, tmp_path: Path, pattern: str
) -> None:
    rest, there = tank(pattern)
    (tmp_path / "rest.csv").write_text(text(rest))
    (tmp_path / "there.csv").write_text(text(there))
    files = tmp_path / "there.csv", "--reference", tmp_path / "rest.csv"
    if rest.shape[1] != 208:  # as many as the description's are taken as its
        refused = tactomo(
            "reconstruct", files[0], tmp_path / "maps.npz", "-d", "tank_disc", status=1
        )
        assert f"{rest.shape[1]} numbers a frame, which fit {pattern}" in refused.stderr
        assert f"--pattern {pattern}" in refused.stderr
    located(tactomo, tmp_path, *files, "--pattern", pattern)
    assert fitting_patterns(rest)[0] == NamedPattern.of_name(pattern)


def test_every_drive_by_every_pair_is_read_and_named(tactomo: Run, tmp_path: Path) -> None:
    """Whatever stands where a pair touches a driven electrode; zeros tell the pattern."""
    pairs = load_description("tank_disc").pairs
    rest, there = (np.zeros((FRAMES, 256)) for _ in range(2))
    for full, kept in zip((rest, there), tank(), strict=True):
        full[:, pairs.drive[:, 0] * 16 + pairs.measure[:, 0]] = kept
    assert list(map(str, fitting_patterns(there))) == ["16:adjacent"]
    savemat(tmp_path / "in.mat", {"rest": rest, "full": there, "note": "text"})
    located(tactomo, tmp_path, tmp_path / "in.mat")


def test_no_pattern_is_made_up() -> None:
    noise = np.random.default_rng(0).normal(size=(3, 928))
    assert fitting_patterns(noise) == []
    assert fitting_patterns(noise[:, :207]) == []
    assert [str(p) for p in fitting_patterns(noise[:, :192])] == ["16:opposite:adjacent"]


@pytest.mark.parametrize("degrees", [pytest.param(50, marks=pytest.mark.slow), -100])
def test_volts_out_of_phase_are_turned_as_the_reference_is(
    tactomo: Run, tmp_path: Path, degrees: float
) -> None:
    rest, there = (volts * np.exp(1j * np.radians(degrees)) for volts in tank())
    savemat(tmp_path / "rest.mat", {"vh": rest})
    savemat(tmp_path / "there.mat", {"vi": there})
    said = located(
        *(tactomo, tmp_path, tmp_path / "there.mat", "--reference", tmp_path / "rest.mat")
    )
    assert "turned by" in said
    angles = np.random.default_rng(0).uniform(0, 2 * np.pi, 208)
    savemat(tmp_path / "in.mat", {"vi": there * np.exp(1j * angles)})
    result = tactomo(
        "import", tmp_path / "in.mat", "out.mcap", "-d", "tank_disc", "--rate", "1", status=1
    )
    assert "out of phase with the current" in result.stderr


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.mat", b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(600), "damaged, or no .mat"),
        ("a.mat", b"MATLAB 5.0 MAT-file".ljust(140), "damaged, or no .mat"),
        ("a.csv", b"x,y\nvolts\n", "no line of numbers"),
        ("a.csv", b"1,2\n3\n", "line 2: 1 numbers, and 2 in the lines before"),
        ("a.csv", b"\xff\xfe1\x00", "is not text"),
        ("a.txt", b"1 2 3\n", "no scans of 208 voltages, as of tank_disc; save one frame"),
        ("a.xyz", b"1 2 3", "read are .npz, .mat"),
    ],
)
def test_what_is_wrong_is_named(
    tactomo: Run, tmp_path: Path, name: str, content: bytes, told: str
) -> None:
    (tmp_path / name).write_bytes(content)
    result = tactomo(
        "reconstruct", tmp_path / name, tmp_path / "o.npz", "-d", "tank_disc", status=1
    )
    assert told in result.stderr


def test_what_cannot_be_told_apart_is_asked_for(tactomo: Run, tmp_path: Path) -> None:
    rest, there = tank()
    savemat(tmp_path / "in.mat", {"a": rest, "b": there})
    asked = "reconstruct", tmp_path / "in.mat", tmp_path / "o.npz", "-d", "tank_disc"
    assert "several arrays of scans; name one of them by --array" in tactomo(*asked).stderr
    assert "give --reference-frames" in tactomo(*asked, "--array", "b").stderr
    assert "no numbers called 'c'" in tactomo(*asked, "--array", "c").stderr
    assert "is no pattern; give" in tactomo(*asked, "--pattern", "16:far").stderr


OFFSETS = st.sampled_from(["adjacent", "opposite", "far", ""]) | st.integers(-1, 40).map(str)


@given(
    st.builds(
        lambda count, offsets, rotated: ":".join([str(count), *offsets, *rotated]),
        st.integers(0, 70),
        st.lists(OFFSETS, max_size=3),
        st.sampled_from([[], ["rotated"]]),
    )
)
def test_any_pattern_is_applied_or_refused_by_name(name: str) -> None:
    with suppress(DataError, DescriptionError):
        named = NamedPattern.of_name(name)
        sensor = named.applied(load_description("tank_disc"))
        assert NamedPattern.of_name(str(named)) == named
        assert sorted(named.order) == list(range(sensor.measurements))
        assert sensor.electrodes.length_m * sensor.electrode_count == pytest.approx(0.008 * 16)


TAKES_FILES = settings(deadline=None, suppress_health_check=list(HealthCheck))


@TAKES_FILES
@given(data=st.data())
def test_any_text_becomes_scans_or_a_named_error(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("any") / "in.csv"
    path.write_text(text(ROWS))
    read_damaged(path, data)


@pytest.mark.slow
@pytest.mark.parametrize("version", ["5", "7.3"])
@settings(TAKES_FILES, max_examples=8)  # a program of its own reads each
@given(data=st.data())
def test_any_matlab_file_becomes_scans_or_a_named_error(
    tmp_path_factory: pytest.TempPathFactory, version: str, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("any") / "in.mat"
    if version == "5":
        savemat(path, {"vh": ROWS[:1], "vi": {"meas": ROWS}}, do_compression=True)
    else:
        save_hdf5(path, {"vh": [ROWS[:1]], "vi": {"meas": ROWS}})
    read_damaged(path, data)


def read_damaged(path: Path, data: st.DataObject) -> None:
    whole = bytearray(path.read_bytes())
    for place, byte in data.draw(
        st.lists(st.tuples(st.integers(0, len(whole) - 1), st.integers(0, 255)), max_size=8)
    ):
        whole[place] = byte
    path.write_bytes(data.draw(st.sampled_from([bytes(whole), bytes(whole[: len(whole) // 2])])))
    with suppress(TactomoError, DataError):
        scans = read_scans(path, load_description("tank_disc"), None)
        assert all(volts.shape[1] == 208 for volts in scans.volts.values())
