"""Networks at run time: what is refused and why, and what the shipped ones are good for."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from base64 import b64decode
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from model_fixtures import Tared
from noisy_skin import Skin
from tactomo_models import (
    ArtifactError,
    Flag,
    Press,
    Reconstructor,
    SensorDescription,
    SkinSimulator,
)
from tactomo_models.methods.trained_networks import (
    NONE_TRAINED,
    FusionNetwork,
    Network,
    SensorNetworks,
    find_network,
    load_network,
    own_path,
)
from variants import variant

Rewrite = Callable[[bytes], bytes]

ONE = Press(0.02, -0.03, 180.0)
THREE = (Press(-0.04, 0.03, 180.0), Press(0.03, 0.035, 160.0), ONE)


@pytest.fixture
def shipped(paper: SensorDescription) -> Path:
    found = find_network(paper, "network")
    assert found is not None, "the paper's sensor comes with networks"
    return found


HELD_BY_TWO = """
from tactomo.memory import resident_bytes
from tactomo_models import load_description
from tactomo_models.methods.trained_networks import load_network
paper, networks = load_description("paper_square"), []
for _ in range(3):
    print(resident_bytes())
    networks.append(load_network(paper, "network"))
"""


@pytest.mark.slow
def test_networks_of_one_file_hold_its_weights_once() -> None:
    # In a process of its own: what earlier tests have freed would be taken first.
    out = subprocess.check_output([sys.executable, "-c", HELD_BY_TWO])
    first, second = np.diff([int(held) for held in out.split()])
    assert second < 2e6 < first  # its weights are 11 MB


def test_a_network_of_another_sensor_is_refused(shipped: Path, small: SensorDescription) -> None:
    with pytest.raises(ArtifactError, match=r"trained for sensor 'paper_square'.*not for 'small'"):
        Network(shipped, small, "network")


@pytest.mark.parametrize(
    ("model", "said"),
    [  # y = x + w with w in a file named ../secret.bin, and y = Evil(x) of the domain my.ops
        (
            "CAk6dgoOCgF4CgF3EgF5IgNBZGQSAWcqPwgEEAFCAXdqGQoIbG9jYXRpb24SDS4uL3NlY3JldC5iaW5qCwoG"
            "b2Zmc2V0EgEwagwKBmxlbmd0aBICMTZwAVoPCgF4EgoKCAgBEgQKAggEYg8KAXkSCgoICAESBAoCCARCBAoA"
            "EBE=",
            "[Ee]xternal",
        ),
        (
            "CAk6OwoUCgF4EgF5IgRFdmlsOgZteS5vcHMSAWdaDwoBeBIKCggIARIECgIIBGIPCgF5EgoKCAgBEgQKAggE"
            "QgQKABARQgoKBm15Lm9wcxAB",
            "Evil",
        ),
    ],
)
def test_a_network_reads_no_other_file_and_runs_no_code_of_its_own(
    paper: SensorDescription,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    model: str,
    said: str,
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    (tmp_path / "secret.bin").write_bytes(bytes(16))
    (here / "hostile.onnx").write_bytes(b64decode(model))
    with pytest.raises(ArtifactError, match=said):
        load_network(paper, "network", here / "hostile.onnx")


def test_a_network_of_another_kind_is_refused(shipped: Path, paper: SensorDescription) -> None:
    with pytest.raises(ArtifactError, match="is a network, not a cnn-single"):
        Network(shipped, paper, "cnn-single")


def test_a_network_of_a_channel_that_the_sensor_lacks_is_refused(
    shipped: Path, paper: SensorDescription
) -> None:
    """The hash is of sheet and electrodes alone: that of the sensor with one sheet is the same."""
    for channel in ("magnitude", "structure"):
        one_sheet = paper.model_copy(update={channel: None})
        with pytest.raises(ArtifactError, match="takes the channels magnitude structure"):
            Network(shipped, one_sheet, "network")


@pytest.mark.parametrize("content", [0.5, 0.99, b"", b"not a network", b"\x08\x08"])
def test_a_truncated_network_and_other_files_are_refused(
    shipped: Path, paper: SensorDescription, tmp_path: Path, content: float | bytes
) -> None:
    whole, broken = shipped.read_bytes(), tmp_path / "broken.onnx"
    cut = whole[: int(content * len(whole))] if isinstance(content, float) else content
    broken.write_bytes(cut)
    with pytest.raises(ArtifactError, match=r"broken\.onnx"):
        Network(broken, paper, "network")


@pytest.mark.parametrize(
    ("note", "as_long"),
    [
        ("scale", lambda old: b"x" * len(old)),
        ("bases", lambda old: b"!" * len(old)),
        ("bases", lambda old: b"A" * len(old)),
        ("bases", lambda old: old[: len(old) // 2] + b"=" * (len(old) - len(old) // 2)),
    ],
)
def test_a_network_with_damaged_notes_is_refused(
    shipped: Path, paper: SensorDescription, tmp_path: Path, note: str, as_long: Rewrite
) -> None:
    whole = shipped.read_bytes()
    old = load_network(paper, "network").notes[note].encode()
    at = whole.index(old, whole.index(note.encode()))
    path = tmp_path / "damaged.onnx"
    path.write_bytes(whole[:at] + as_long(old) + whole[at + len(old) :])
    with pytest.raises(ArtifactError, match="damaged"):
        FusionNetwork(load_network(paper, "network", path=path))


def test_networks_of_a_description_as_it_was_are_said_to_be(
    paper: SensorDescription,
) -> None:
    moved = variant(paper, electrodes={"pitch_m": 0.035})
    with pytest.raises(ArtifactError, match=r"trained before .* changed .*: train anew"):
        load_network(moved, "network")
    assert "was trained before" in SensorNetworks(moved).missing
    renamed = moved.model_copy(update={"name": "other"})
    assert SensorNetworks(renamed).missing == NONE_TRAINED


def test_missing_networks_are_said_to_be_missing(
    paper: SensorDescription, small: SensorDescription, tmp_path: Path
) -> None:
    with pytest.raises(ArtifactError, match=r"there is no network at .*name another file"):
        Network(tmp_path / "nowhere.onnx", paper, "network")
    with pytest.raises(ArtifactError, match="tactomo models train"):
        load_network(small, "network")


def test_methods_without_their_network_are_refused_at_once(small: SensorDescription) -> None:
    for method in ("network", "cnn-single", "cnn-multimodal"):
        with pytest.raises(ArtifactError, match="there is no"):
            Reconstructor(small, method=method)


def test_a_users_own_network_goes_before_the_shipped_one(
    shipped: Path, paper: SensorDescription, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path))
    assert find_network(paper, "network") == shipped
    shutil.copy(shipped, own_path(paper, "network"))
    assert find_network(paper, "network") == own_path(paper, "network")


@pytest.mark.slow
def test_auto_does_without_a_network_that_is_damaged(
    paper: SensorDescription,
    tared: Tared,
    skin: Skin,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path))
    own_path(paper, "network").write_bytes(b"damaged")
    frame = tared(budget_s=1.0).reconstruct(**skin.scan(ONE))
    assert frame.tier == "fit"
    assert "no network: " in frame.reason
    assert len(frame.contacts) == 1


@pytest.mark.parametrize(("method", "tier"), [("network", "network"), ("auto", "fit")])
def test_contacts_are_found_where_they_press(
    tared: Tared, skin: Skin, method: str, tier: str
) -> None:
    frame = tared(method=method, budget_s=1.0).reconstruct(**skin.scan(*THREE))
    assert frame.tier == tier
    assert 0 <= frame.confidence <= 1 or method == "auto"
    assert len(frame.contacts) == 3
    for press in THREE:
        nearest = min(frame.contacts, key=lambda c: np.hypot(c.x_m - press.x_m, c.y_m - press.y_m))
        assert np.hypot(nearest.x_m - press.x_m, nearest.y_m - press.y_m) < 0.003
        assert nearest.pressure_kpa == pytest.approx(press.pressure_kpa, abs=25)


@pytest.mark.parametrize("method", ["network", "tikhonov", "levelset"])
def test_what_does_not_tell_how_a_pressure_falls_is_unsure_of_its_peak(
    tared: Tared, skin: Skin, method: str
) -> None:
    balls = [
        replace(press, pressure_kpa=1.4 * press.pressure_kpa, profile="dome") for press in THREE
    ]
    frame = tared(method=method, budget_s=1.0).reconstruct(**skin.scan(*balls))
    assert frame.contacts
    for contact in frame.contacts:
        ball = min(balls, key=lambda b: np.hypot(contact.x_m - b.x_m, contact.y_m - b.y_m))
        assert not abs(contact.peak_kpa - ball.pressure_kpa) > 3 * contact.peak_sigma_kpa
        assert not contact.max_kpa < ball.pressure_kpa


def test_a_missing_structure_scan_leaves_a_map_and_a_missing_magnitude_scan_a_shape(
    tared: Tared, skin: Skin
) -> None:
    reconstructor = tared(method="network")
    scans = skin.scan(ONE)
    without = reconstructor.reconstruct(scans["magnitude"], None)
    assert without.map is not None
    assert without.structure is None
    assert Flag.STRUCTURE_MISSING in without.flags
    assert without.map.max() > 0.03
    without = reconstructor.reconstruct(None, scans["structure"])
    assert without.map is None
    assert without.structure is not None
    assert len(without.contacts) == 1
    assert np.isnan(without.contacts[0].magnitude)


def test_runs_do_not_depend_on_what_ran_before(shipped: Path, paper: SensorDescription) -> None:
    network = FusionNetwork(Network(shipped, paper, "network"))
    rng = np.random.default_rng(0)
    certainty = {"magnitude": np.full(208, 1e4), "structure": np.full(208, 1e4)}
    frames = [{name: 0.01 * rng.standard_normal(208) for name in certainty} for _ in range(3)]
    first = [network.image(frame, certainty) for frame in frames]  # type: ignore[arg-type]
    again = [network.image(frame, certainty) for frame in reversed(frames)]  # type: ignore[arg-type]
    for one, other in zip(first, reversed(again), strict=True):
        np.testing.assert_array_equal(one.map, other.map)
        assert one.confidence == other.confidence


def test_a_dead_electrode_costs_little(tared: Tared, skin: Skin, paper: SensorDescription) -> None:
    """Its voltages are filled in from the others: the map stays, as it would not from zeros."""
    reconstructor = tared(method="network")
    whole = reconstructor.reconstruct(**skin.scan(*THREE))
    scans = skin.scan(*THREE)
    ends = np.hstack([paper.pairs.drive, paper.pairs.measure])
    for scan in scans.values():
        scan[(ends == 5).any(axis=1)] = np.nan
    broken = reconstructor.reconstruct(**scans)
    assert whole.map is not None
    assert broken.map is not None
    assert np.corrcoef(whole.map.ravel(), broken.map.ravel())[0, 1] > 0.8
    assert Flag.INVALID_VOLTAGE in broken.flags or Flag.ELECTRODE_FAULT in broken.flags


def test_the_reference_may_change_between_frames(tared: Tared, simulator: SkinSimulator) -> None:
    """The filter follows the noise that each tare has seen."""
    quiet, noisy = Skin(simulator, 3e-4), Skin(simulator, 1e-2)
    reconstructor = tared(method="network")
    shown = []
    for skin in (quiet, noisy, quiet):
        reconstructor.set_reference(skin.reference())
        shown.append(reconstructor.reconstruct(**skin.scan(ONE)))
    assert all(len(frame.contacts) == 1 for frame in shown)


@pytest.mark.slow
def test_nothing_is_reported_to_the_maker_of_the_runtime(tmp_path: Path) -> None:
    """One that reports keeps a number of the computer in its user's home, from its import on."""
    home = {**os.environ, "HOME": str(tmp_path)}
    home.pop("XDG_CACHE_HOME", None)
    subprocess.run(
        [sys.executable, "-c", "import tactomo_models.methods.trained_networks"],
        env=home,
        check=True,
    )
    assert not list(tmp_path.rglob("*onnxruntime*"))
