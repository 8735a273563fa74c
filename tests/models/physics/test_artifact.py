"""Built artifacts: kept and read back whole, and refused where they do not belong."""

from __future__ import annotations

import os
import pickle
import resource
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tactomo_models import (
    Artifact,
    ArtifactError,
    SensorDescription,
    build_artifact,
    default_path,
    load_artifact,
    load_or_build_artifact,
    save_artifact,
)
from tactomo_models.physics.artifact import TYPICAL_CHANGE, nominal_noise
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.tikhonov import even_scale, tikhonov_matrix


@pytest.fixture(scope="module")
def built(small: SensorDescription) -> Artifact:
    return build_artifact(small)


@pytest.fixture
def file(built: Artifact, tmp_path: Path) -> Path:
    """The artifact, kept in a new folder."""
    path = tmp_path / "new folder" / "small.npz"
    save_artifact(built, path)
    return path


def test_an_artifact_comes_back_as_it_was(
    file: Path, built: Artifact, small: SensorDescription
) -> None:
    read = load_artifact(file, small)
    assert str(file) in Path("/proc/self/maps").read_text()  # what is large stays in the file
    assert read.regularisation == built.regularisation
    for name in ("jacobian", "tikhonov"):
        np.testing.assert_array_equal(getattr(read, name), getattr(built, name))
    every = np.arange(len(built.bare.support))
    np.testing.assert_array_equal(
        read.bare.green.between(every, every), built.bare.green.between(every, every)
    )
    assert (read.bare.map_weights != built.bare.map_weights).nnz == 0
    assert [entry.name for entry in file.parent.iterdir()] == ["small.npz"]


def test_an_artifact_of_another_sensor_is_refused(file: Path, paper: SensorDescription) -> None:
    with pytest.raises(ArtifactError, match=r"built for.*'small'.*'paper_square'.*models build"):
        load_artifact(file, paper)


@pytest.mark.parametrize(
    "damage", ["cut", "empty", "text", "pickle", "one array", "other arrays", "future", "a folder"]
)
def test_a_damaged_or_foreign_file_is_refused(
    file: Path, small: SensorDescription, damage: str
) -> None:
    whole = file.read_bytes()
    if damage == "other arrays":
        np.savez(file, a=np.zeros(3))
    elif damage == "one array":
        with file.open("wb") as opened:
            np.save(opened, np.zeros(3))
    elif damage == "a folder":
        file.unlink()
        file.mkdir()
    elif damage == "future":
        with np.load(file) as stored:
            np.savez(file, **{**dict(stored), "format": np.array(99)})
    else:
        content = {"cut": whole[: len(whole) // 2], "empty": b"", "text": b"not an artifact"}
        file.write_bytes(content.get(damage, pickle.dumps({"sha256": small.sha256})))
    with pytest.raises(ArtifactError, match="tactomo models build"):
        load_artifact(file, small)


def test_a_header_that_says_fewer_numbers_is_refused(file: Path, small: SensorDescription) -> None:
    """The checksum is beyond what such a header has one read."""
    content = bytearray(file.read_bytes())
    digit = content.index(b"'shape': (", content.index(b"greens.npy")) + len(b"'shape': (")
    content[digit] -= 1
    file.write_bytes(content)
    with pytest.raises(ArtifactError, match="tactomo models build"):
        load_artifact(file, small)


def test_the_same_numbers_compressed_are_refused(file: Path, small: SensorDescription) -> None:
    """The large array is used where it lies in the file: there it would be other numbers."""
    with np.load(file) as stored:
        np.savez_compressed(file, **dict(stored))
    with pytest.raises(ArtifactError, match="compressed"):
        load_artifact(file, small)


@pytest.mark.parametrize("name", ["triangles", "points", "jacobian", "greens"])
def test_other_numbers_than_were_built_are_told_and_built_anew(
    built: Artifact, small: SensorDescription, name: str
) -> None:
    file = default_path(small)
    save_artifact(built, file)
    with np.load(file) as stored:
        arrays = dict(stored)
    np.savez(file, **{**arrays, name: 5 * arrays[name]})
    told: list[str] = []
    again = load_or_build_artifact(small, progress=told.append)
    assert "not those that were built" in told[0]
    assert "built anew" in told[0]
    np.testing.assert_array_equal(again.bare.points, built.bare.points)
    np.testing.assert_array_equal(again.bare.triangles, built.bare.triangles)
    load_artifact(file, small)


@given(st.data())
def test_a_flipped_bit_is_refused_or_harmless(
    built: Artifact,
    small: SensorDescription,
    tmp_path_factory: pytest.TempPathFactory,
    data: st.DataObject,
) -> None:
    """No other exception, and never other numbers: headers and directory are tried most."""
    file = tmp_path_factory.mktemp("flip") / "small.npz"
    save_artifact(built, file)
    content = bytearray(file.read_bytes())
    last = len(content) - 1
    ends = st.one_of(st.integers(0, 300), st.integers(last - 1500, last))
    at = data.draw(st.one_of(ends, st.integers(0, last)))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    file.write_bytes(content)
    try:
        read = load_artifact(file, small)
    except ArtifactError:
        return
    finally:
        file.unlink()
    np.testing.assert_array_equal(read.jacobian, built.jacobian)
    every = np.arange(len(built.bare.support))
    np.testing.assert_array_equal(
        read.bare.green.between(every, every), built.bare.green.between(every, every)
    )


def test_a_disk_that_fills_up_leaves_nothing_under_the_name(
    built: Artifact, small: SensorDescription, tmp_path: Path
) -> None:
    folder = tmp_path / "full"
    folder.mkdir()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for is_there in (False, True):
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
        try:
            with pytest.raises(ArtifactError, match=r"cannot write .*small\.npz.*free some space"):
                save_artifact(built, folder / "small.npz")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert len(list(folder.iterdir())) == is_there
        save_artifact(built, folder / "small.npz")
    assert load_artifact(folder / "small.npz", small).sensor == "small"


@pytest.mark.usefixtures("own_cache")
def test_a_missing_one_is_built_and_kept(small: SensorDescription) -> None:
    steps: list[str] = []
    load_or_build_artifact(small, progress=steps.append)
    assert steps
    assert default_path(small).exists()
    steps.clear()
    load_or_build_artifact(small, progress=steps.append)
    assert not steps


@pytest.mark.usefixtures("own_cache")
@pytest.mark.timeout(60)
def test_a_pipe_in_the_caches_place_is_not_waited_for(small: SensorDescription) -> None:
    default_path(small).parent.mkdir(parents=True, exist_ok=True)
    os.mkfifo(default_path(small))
    told: list[str] = []
    assert load_or_build_artifact(small, progress=told.append).sensor == "small"
    assert "no regular file" in told[0]


def test_a_cache_that_cannot_be_written_does_not_stop_anybody(
    small: SensorDescription, built: Artifact, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("a file where a folder should be")
    monkeypatch.setenv("CACHE_DIRECTORY", str(blocked))
    assert load_or_build_artifact(small).sensor == "small"
    with pytest.raises(ArtifactError, match="cannot write"):
        save_artifact(built, blocked / "asked_for.npz")


def test_tikhonov_is_equation_4_on_whitened_data(built: Artifact, small: SensorDescription) -> None:
    """L is the identity on functions: at nodes, the areas that they stand for."""
    J, weight = built.jacobian, built.regularisation
    forward = ForwardModel(small, built.bare)
    noise = nominal_noise(forward.bare_voltages)
    whitened = J / noise[:, None]
    areas = forward.node_areas_m2 / forward.node_areas_m2.mean()
    by_nodes = np.linalg.solve(whitened.T @ whitened + weight * np.diag(areas), whitened.T / noise)
    np.testing.assert_allclose(
        built.tikhonov, by_nodes, rtol=1e-5, atol=1e-9 * np.abs(by_nodes).max()
    )
    prior_scale = even_scale(forward.node_areas_m2)
    np.testing.assert_array_equal(built.tikhonov, tikhonov_matrix(J, noise, weight, prior_scale))


def test_lambda_is_that_of_changes_of_a_typical_size(
    built: Artifact, small: SensorDescription
) -> None:
    """Bayes: with L of unit mean square, one over the expected change squared."""
    prior_scale = even_scale(ForwardModel(small, built.bare).node_areas_m2)
    assert built.regularisation == pytest.approx(np.mean(prior_scale**2) / TYPICAL_CHANGE**2)
