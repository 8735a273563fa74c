"""Random scenes with known truth, to tune on and to report.

A scene is drawn from its seed: how many contacts, where, of what shape, size and pressure; the
true contrast of the structure channel; which way the magnitude channel changes; two uneven
sheets. Simulating it takes about half a second and is kept in the user's cache; noise is added
afterwards, so that one simulation serves every signal-to-noise ratio.

Tuning seeds and reporting seeds are two sets: the set's name is part of every seed, so that no
scene is in both, whatever its number.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.spatial.distance import cdist
from tactomo_models.arrays import FloatArray
from tactomo_models.errors import DataError
from tactomo_models.physics.mesh import SheetMesh
from tactomo_models.scans.reference import Reference
from tactomo_models.scene.press import Press, Profile, Shape
from tactomo_models.sensor.description import SensorDescription
from tactomo_protocol import Channel

from tactomo_lab.scenes.cache import cached
from tactomo_lab.scenes.simulation import (
    IMPEDANCE_DEVIATION,
    UNEVENNESS,
    Truth,
    UnevenSkin,
    Volts,
    fine_mesh,
    truth_of,
    with_contrast,
    with_opposite_magnitude,
)

SeedSet = Literal["tuning", "reporting"]
SnrOf = Literal["voltage", "change"]
SceneShape = Literal["ellipse", "rectangle", "ring", "mixed"]

SIMULATION = 4  # raise it when `simulation` changes: what it stored before is not read
CONTACTS = (1, 2, 3, 4, 5, 6)
GAP_M = 0.009  # least distance of two outlines
HALF_AXIS_M = (0.007, 0.020)  # of every indenter, both axes
RING_HALF_AXIS_M = 0.012  # least of a ring: its hole is half as wide
MAX_ASPECT = 2.0
PRESSURE_KPA = (145.0, 200.0)
CONTRAST = (10.0, 100.0)
REFERENCE_SCANS = 20  # as a tare takes
SCENE_SHAPES: tuple[SceneShape, ...] = ("ellipse", "rectangle", "ring", "mixed")
SHAPES: tuple[Shape, ...] = ("ellipse", "rectangle", "ring")
BOTH_CHANNELS: tuple[Channel, ...] = (Channel.MAGNITUDE, Channel.STRUCTURE)


@dataclass(frozen=True)
class Layout:
    """What a seed stands for."""

    seed_set: SeedSet  # which of the two sets of seeds
    number: int  # of the scene, among those of its set with as many contacts
    presses: tuple[Press, ...]  # what presses
    shape: SceneShape  # of all indenters, or "mixed"
    contrast: float  # true ratio of the structure channel's conductivities
    # whether the magnitude channel's conductivity goes against the description's sign under
    # pressure; the reconstructor is told
    opposite: bool

    def seed(self, purpose: str) -> np.random.SeedSequence:
        """Seed of one of the scene's random draws."""
        return seed_of(self.seed_set, purpose, len(self.presses), self.number)

    def __str__(self) -> str:
        return f"{self.seed_set} {len(self.presses)}/{self.number}"


@dataclass(frozen=True)
class EvaluationScene:
    """One dual scan with its reference and the truth behind it."""

    layout: Layout  # what the seed stands for
    # the sensor as the reconstructor is told: the true sign of the magnitude channel, but the
    # nominal contrast of the structure channel
    description: SensorDescription
    snr_db: float  # signal-to-noise ratio, and `snr_of` what; see `noise_std`
    snr_of: SnrOf
    reference: Reference  # the mean of noisy unpressed scans, as at a tare
    magnitude: FloatArray  # (M,) volts
    structure: FloatArray | None  # (M,) volts; None of a sensor without that channel

    @cached_property
    def truth(self) -> Truth:
        """What a perfect reconstruction would show."""
        return truth_of(self.description, self.layout.presses)


def scenes(
    description: SensorDescription,  # the sensor; needs both channels
    # "tuning" for whoever chooses a constant by what comes out, "reporting" for figures that are
    # published
    seed_set: SeedSet,
    count: int,  # scenes of each number of contacts
    *,
    contacts: Iterable[int] = CONTACTS,  # how many contacts
    snr_db: float = 40.0,  # signal-to-noise ratio in decibels
    snr_of: SnrOf = "change",  # what the noise is measured by; see `noise_std`
) -> Iterator[EvaluationScene]:
    """Scenes of a seed set, `count` of each number of contacts; the same ones every time.

    Raises DataError where the sensor has a single channel, or no room for that many contacts.
    """
    require_both_channels(description)
    simulation = Simulation(description)
    for contact_count in contacts:
        for number in range(count):
            layout = draw_layout(description, seed_set, contact_count, number)
            yield measure(simulation.voltages(layout), layout, description, snr_db, snr_of)


def require_both_channels(description: SensorDescription) -> None:
    """Refuse a sensor that has a single channel, by a DataError."""
    if len(description.channels) < 2:
        raise DataError(
            f"sensor {description.name!r} has one channel; scenes need a magnitude and a "
            "structure channel: choose another description"
        )


def seed_of(seed_set: str, purpose: str, *numbers: int) -> np.random.SeedSequence:
    """Seed of one random draw; no number in one set leads to what another set or purpose has."""
    name = hashlib.sha256(f"{seed_set} {purpose}".encode()).digest()
    return np.random.SeedSequence([int.from_bytes(name), *numbers])


def draw_layout(
    description: SensorDescription, seed_set: SeedSet, contacts: int, number: int
) -> Layout:
    """Draw what presses and on what.

    Outlines lie inside the sensing area, up to its edge, and at least `GAP_M` apart: an indenter
    that finds no room is drawn anew, so that many contacts are smaller ones on average.

    Raises DataError where there is no room for so many.
    """
    rng = np.random.default_rng(seed_of(seed_set, "layout", contacts, number))
    shape = SCENE_SHAPES[rng.integers(4 if contacts > 1 else 3)]
    contrast = float(np.exp(rng.uniform(*np.log(CONTRAST))))
    opposite = bool(rng.integers(2))
    for _ in range(200):
        presses = _draw_presses(description, contacts, shape, rng)
        if presses is not None:
            return Layout(seed_set, number, presses, shape, contrast, opposite)
    raise DataError(f"no room for {contacts} contacts on {description.name!r}: ask for fewer")


def _draw_presses(
    description: SensorDescription, contacts: int, shape: SceneShape, rng: np.random.Generator
) -> tuple[Press, ...] | None:
    """Place one indenter after the other; None where one finds no room."""
    placed: list[Press] = []
    frame_m = description.sheet.frame_width_m
    for _ in range(contacts):
        for _ in range(30):
            press = _draw_press(description, shape, rng)
            x, y = outline_of(press)
            inside = description.on_sheet(x, y, frame_m).all()
            if inside and all(gap_m(press, other) >= GAP_M for other in placed):
                placed.append(press)
                break
        else:
            return None
    return tuple(placed)


def _draw_press(
    description: SensorDescription, shape: SceneShape, rng: np.random.Generator
) -> Press:
    own: Shape = SHAPES[rng.integers(3)] if shape == "mixed" else shape
    return draw_indenter(description, rng, own)


def draw_indenter(
    description: SensorDescription,
    rng: np.random.Generator,
    shape: Shape,
    *,
    profile: Profile = "flat",
    pressure_kpa: tuple[float, float] = PRESSURE_KPA,  # of its peak
    scale: float = 1.0,  # on `HALF_AXIS_M`
) -> Press:
    """Draw an indenter of a shape anywhere on the sheet, turned any way."""
    least, most = HALF_AXIS_M
    least = RING_HALF_AXIS_M if shape == "ring" else least
    long = rng.uniform(least, most)
    return Press(
        x_m=rng.uniform(-0.5, 0.5) * description.width_m,
        y_m=rng.uniform(-0.5, 0.5) * description.height_m,
        pressure_kpa=rng.uniform(*pressure_kpa),
        radius_m=scale * long,
        radius_y_m=scale * rng.uniform(max(least, long / MAX_ASPECT), long),
        angle_rad=rng.uniform(0, np.pi),
        shape=shape,
        profile=profile,
    )


def outline_of(press: Press) -> FloatArray:
    """Points (2, n) along an indenter's outer outline, metres."""
    a, b = press.radius_m, press.radius_y_m or press.radius_m
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    u, v = np.cos(angle), np.sin(angle)
    if press.shape == "rectangle":
        longest = np.maximum(np.abs(u), np.abs(v))
        u, v = u / longest, v / longest
    cos, sin = np.cos(press.angle_rad), np.sin(press.angle_rad)
    x, y = cos * a * u - sin * b * v, sin * a * u + cos * b * v
    return np.stack([press.x_m + x, press.y_m + y])


def gap_m(one: Press, other: Press) -> float:
    """Distance of two indenters' outer outlines; 0 where they meet or one lies in the other."""
    first, second = outline_of(one), outline_of(other)
    if _covers(one, second) or _covers(other, first):
        return 0.0
    return float(cdist(first.T, second.T).min())


def _covers(press: Press, points: FloatArray) -> bool:
    filled = replace(press, shape="ellipse") if press.shape == "ring" else press
    return bool((filled.coverage(points[0], points[1], edge_m=1e-6) > 0.5).any())


class Simulation:
    """Simulates scenes, or reads what an earlier run simulated.

    Args:
        description: the sensor; needs both channels.
        even: whether sheets and electrodes are as even as the model's, instead of each scene's
            own.
    """

    def __init__(self, description: SensorDescription, *, even: bool = False) -> None:
        self._description = description
        self._even = even

    @cached_property
    def _mesh(self) -> SheetMesh:
        return fine_mesh(self._description)

    def voltages(self, layout: Layout) -> SimulatedVolts:
        """Noise-free voltages of a scene."""
        what = f"{SIMULATION} {layout!r} {self._description.model_dump_json()}"
        what += " even" if self._even else ""
        return kept_volts(what, lambda: self._simulate(layout))

    def _simulate(self, layout: Layout) -> SimulatedVolts:
        sensor = with_contrast(self._description, layout.contrast)
        if layout.opposite:
            sensor = with_opposite_magnitude(sensor)
        unevenness, deviation = (0.0, 0.0) if self._even else (UNEVENNESS, IMPEDANCE_DEVIATION)
        skin = UnevenSkin(
            sensor,
            self._mesh,
            layout.seed("sheet"),
            unevenness=unevenness,
            impedance_deviation=deviation,
        )
        return SimulatedVolts(skin.voltages([]), skin.voltages(layout.presses))


@dataclass(frozen=True)
class SimulatedVolts:
    """Noise-free volts of a sensor's channels: (M,) at rest and (M,) or (T, M) pressed."""

    rest: Volts
    pressed: Volts


def kept_volts(what: str, simulate: Callable[[], SimulatedVolts]) -> SimulatedVolts:
    """Voltages of a sensor's channels from an earlier call, or simulated and kept."""

    def make() -> dict[str, FloatArray]:
        volts = simulate()
        rest = {f"{name}_rest": scan for name, scan in volts.rest.items()}
        return rest | {f"{name}_pressed": scans for name, scans in volts.pressed.items()}

    arrays = cached(what, make)
    channels = [name for name in BOTH_CHANNELS if f"{name}_rest" in arrays]
    return SimulatedVolts(
        rest={name: arrays[f"{name}_rest"] for name in channels},
        pressed={name: arrays[f"{name}_pressed"] for name in channels},
    )


def noise_std(volts: SimulatedVolts, name: Channel, snr_db: float, snr_of: SnrOf) -> float:
    """Standard deviation in volts of the noise on every voltage of a channel.

    It is the same on each, as a converter's is. A ratio of 20 dB is a tenth, in amplitude, of

    - "change": the root mean square of the channel's voltage changes, as the paper has it, which
      adds noise to data that are changes.
    - "voltage": the root mean square of the channel's voltages at rest, as a converter's data
      sheet has it. Changes are some 5 to 30 % of that in the structure channel and 0.2 to 4 % in
      the magnitude channel, so that the same number of decibels is far more noise.
    """
    signal = volts.rest[name]
    if snr_of == "change":
        signal = volts.pressed[name] - signal
    return float(np.sqrt(np.mean(signal**2)) * 10 ** (-snr_db / 20))


def measure(
    volts: SimulatedVolts,
    layout: Layout,
    description: SensorDescription,
    snr_db: float,
    snr_of: SnrOf,
) -> EvaluationScene:
    """Add noise to a scene: to its scan and to the `REFERENCE_SCANS` that its reference averages.

    The draws of a scene are the same at every signal-to-noise ratio, scaled.
    """
    rng = np.random.default_rng(layout.seed("noise"))
    scans, rest = {}, {}
    for name in BOTH_CHANNELS:
        std = noise_std(volts, name, snr_db, snr_of)
        draws = std * rng.standard_normal((1 + REFERENCE_SCANS, len(volts.rest[name])))
        scans[name] = volts.pressed[name] + draws[0]
        rest[name] = volts.rest[name] + draws[1:]
    return EvaluationScene(
        layout=layout,
        description=with_opposite_magnitude(description) if layout.opposite else description,
        snr_db=snr_db,
        snr_of=snr_of,
        reference=Reference.from_scans(rest[Channel.MAGNITUDE], rest[Channel.STRUCTURE]),
        magnitude=scans[Channel.MAGNITUDE],
        structure=scans[Channel.STRUCTURE],
    )
