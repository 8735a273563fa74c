"""What is found in the scans of skins that are well, and of each kind that is not."""

from __future__ import annotations

import numpy as np
import pytest
from faulty_skin import BAD_LEADS, rewired, shorted, touches
from hypothesis import given
from hypothesis import strategies as st
from noisy_skin import rms
from tactomo_models import Artifact, DataError, Press, SensorDescription, SkinSimulator
from tactomo_models.arrays import FloatArray
from tactomo_models.health.diagnosis import Diagnosis, diagnose
from tactomo_models.health.findings import Finding, Level
from tactomo_models.sensor.named_pattern import NamedPattern, fitting_patterns
from tactomo_models.sensor.pattern import scan_pairs
from tactomo_protocol import Channel

SCANS = 60
PERIOD_S = 0.05
LEAD = 6


class Patient:
    """A simulated skin: its voltages at rest, and what is found in its scans."""

    def __init__(
        self, description: SensorDescription, simulator: SkinSimulator, artifact: Artifact
    ) -> None:
        self.description = description
        self.simulator = simulator
        self._even = artifact.bare

    def rest(self, *presses: Press, simulator: SkinSimulator | None = None) -> FloatArray:
        return (simulator or self.simulator).voltages(presses)[Channel.STRUCTURE]

    def scans(self, volts: FloatArray, noise: float = 1e-3, count: int = SCANS) -> FloatArray:
        rng = np.random.default_rng(3)
        return volts + noise * rms(self.rest()) * rng.standard_normal((count, len(volts)))

    def examine(self, scans: FloatArray, *, has_model: bool = True) -> Diagnosis:
        return diagnose(
            self.description,
            scans,
            times_s=np.arange(len(scans)) * np.float64(PERIOD_S),
            even=self._even if has_model else None,
            contrast=self.description.contrast(Channel.STRUCTURE),
        )


@pytest.fixture
def patient(paper: SensorDescription, simulator: SkinSimulator, artifact: Artifact) -> Patient:
    return Patient(paper, simulator, artifact)


def about(diagnosis: Diagnosis, what: str) -> Finding:
    return next(finding for finding in diagnosis.findings if finding.about == what)


def ill(diagnosis: Diagnosis) -> dict[int, str]:
    return {n: state for n, state in enumerate(diagnosis.electrodes) if state != "good"}


@pytest.mark.parametrize("has_model", [True, False])
def test_a_converter_that_reads_zeros_is_broken(patient: Patient, has_model: bool) -> None:
    found = patient.examine(np.zeros((SCANS, len(patient.rest()))), has_model=has_model)
    assert found.level == Level.BROKEN
    assert set(found.electrodes) == {"dead"}


@pytest.mark.parametrize("noise", [1e-3, 1e-2])
@pytest.mark.parametrize("has_model", [True, False])
def test_a_healthy_skin_is_healthy(patient: Patient, noise: float, has_model: bool) -> None:
    found = patient.examine(patient.scans(patient.rest(), noise), has_model=has_model)
    assert found.level in (Level.OK, Level.ADVICE)
    assert not ill(found)
    snr = about(found, "snr").figures["snr_db"]
    assert snr == pytest.approx(-20 * np.log10(noise), abs=0.5)


@pytest.mark.parametrize("kind", BAD_LEADS)
def test_a_bad_lead_is_named(patient: Patient, kind: str) -> None:
    state = "dead" if kind in ("open, reads 0 V", "silent") else "misread"
    broken = BAD_LEADS[kind](patient.description, patient.rest(), LEAD)
    found = patient.examine(patient.scans(broken))
    assert found.level == Level.FAULT
    assert ill(found) == {LEAD: state}
    finding = about(found, f"{state}_electrodes")
    assert f"electrode {LEAD}" in finding.detail
    assert finding.next_step


def test_a_noisy_lead_is_loose(patient: Patient) -> None:
    noise = np.where(touches(patient.description, LEAD), 10.0, 1.0)
    scans = patient.rest() + noise * (patient.scans(patient.rest()) - patient.rest())
    assert ill(patient.examine(scans)) == {LEAD: "loose"}


def test_a_lead_that_opens_now_and_then_is_loose_and_not_the_whole_device(patient: Patient) -> None:
    rest = patient.rest()
    scans = patient.scans(rest)
    scans[[7, 20, 41]] += BAD_LEADS["open, reads 0 V"](patient.description, rest, LEAD) - rest
    found = patient.examine(scans)
    assert ill(found) == {LEAD: "loose"}
    assert found.level == Level.FAULT
    assert about(found, "snr").level == Level.OK


def test_a_channel_that_repeats_itself_bit_for_bit_is_told(patient: Patient) -> None:
    """A frozen converter, or a source without noise: nobody can tell."""
    found = about(patient.examine(np.tile(patient.scans(patient.rest())[0], (20, 1))), "snr")
    assert found.level == Level.ADVICE
    assert found.detail == "there is no noise at all"
    assert "repeat one scan" in found.next_step


@pytest.mark.parametrize("pair", [(6, 7), (2, 13)])
def test_two_leads_that_changed_places_are_named(patient: Patient, pair: tuple[int, int]) -> None:
    order = list(range(16))
    order[pair[0]], order[pair[1]] = order[pair[1]], order[pair[0]]
    volts = patient.rest(simulator=rewired(patient.simulator, order))
    found = patient.examine(patient.scans(volts))
    assert ill(found) == dict.fromkeys(pair, "swapped")
    assert f"{pair[0]} with {pair[1]}" in about(found, "swapped_electrodes").detail


def test_a_turned_plug_is_told(patient: Patient) -> None:
    volts = patient.rest(simulator=rewired(patient.simulator, [*range(1, 16), 0]))
    found = patient.examine(patient.scans(volts))
    assert not ill(found)
    assert "on by 1 of 16" in about(found, "model").detail


@pytest.mark.slow
def test_a_short_is_blamed_on_one_of_its_two(patient: Patient) -> None:
    volts = patient.rest(simulator=shorted(patient.simulator, 5, 6))
    found = patient.examine(patient.scans(volts))
    assert found.level == Level.FAULT
    assert ill(found)
    assert set(ill(found)) <= {5, 6}


@pytest.mark.parametrize(
    ("noise", "level"), [(10**-1.5, Level.FAULT), (0.3, Level.BROKEN)], ids=["30 dB", "10 dB"]
)
def test_noise(patient: Patient, noise: float, level: Level) -> None:
    found = patient.examine(patient.scans(patient.rest(), noise))
    assert about(found, "snr").level == level
    assert not ill(found)


def test_clipping(patient: Patient) -> None:
    scans = np.maximum(patient.scans(patient.rest()), -1.7 * rms(patient.rest()))
    found = about(patient.examine(scans), "saturation")
    assert (found.level, found.figures["clipped_percent"]) == (Level.FAULT, 100.0)


@pytest.mark.parametrize(
    ("percent", "level"), [(0.1, Level.OK), (2.0, Level.ADVICE), (-8.0, Level.FAULT)]
)
def test_drift(patient: Patient, percent: float, level: Level) -> None:
    minutes = PERIOD_S * np.arange(SCANS)[:, None] / 60
    found = patient.examine(patient.scans(patient.rest()) * (1 + percent / 100 * minutes))
    drift = about(found, "drift")
    assert drift.level == level
    measured, sigma = (drift.figures[k] for k in ("percent_per_min", "sigma_percent_per_min"))
    assert isinstance(measured, float)
    assert isinstance(sigma, float)
    assert measured == pytest.approx(percent, abs=5 * sigma)


def test_the_stillest_scans_count_where_something_presses(patient: Patient) -> None:
    pressed = patient.rest(Press(0.01, 0.02, 180.0, 0.02))
    scans = np.concatenate([patient.scans(pressed), patient.scans(patient.rest(), count=40)])
    scans[:60] = patient.rest() + np.linspace(0, 1, 60)[:, None] * (scans[:60] - patient.rest())
    found = patient.examine(scans)
    assert found.level == Level.ADVICE
    first, end = about(found, "scans").figures["examined"]  # type: ignore[misc]
    assert 60 <= first < end <= 100
    assert about(found, "snr").figures["snr_db"] == pytest.approx(60, abs=1)


def test_scans_of_many_things_say_nothing_about_noise(patient: Patient) -> None:
    scans = np.outer([1, 5, 2, 2, 9, 3, 7, 4], patient.rest())
    assert about(patient.examine(scans), "snr").level == Level.UNKNOWN


def test_one_scan_is_enough_for_reciprocity_and_none_is_not(patient: Patient) -> None:
    found = patient.examine(patient.rest()[None])
    assert found.level == Level.OK
    assert about(found, "snr").level == Level.UNKNOWN
    with pytest.raises(DataError, match="every voltage is a number"):
        patient.examine(np.full((3, 208), np.nan))
    with pytest.raises(DataError, match="do not fit"):
        patient.examine(np.ones((3, 200)))


@given(electrodes=st.integers(8, 24), drive=st.integers(1, 4), measure=st.integers(1, 4))
def test_a_pattern_is_read_off_its_zeros(electrodes: int, drive: int, measure: int) -> None:
    pairs = scan_pairs(electrodes, drive, measure)
    full = np.zeros((2, electrodes, electrodes))
    full[:, pairs.drive[:, 0], pairs.measure[:, 0]] = 1 + np.arange(len(pairs.drive))
    scans = full.reshape(2, -1)
    found = fitting_patterns(scans)
    if (drive, measure) == (1, 1) or electrodes >= 13 or found:
        assert found == [NamedPattern(electrodes, drive, measure)]
