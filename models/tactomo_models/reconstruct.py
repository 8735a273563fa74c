"""From two scans to a map and contacts: the tiers, and the warm start between frames.

A scene is modelled no further than it needs. Nothing pressed: a chi-square test, and no solve.
Something pressed: a network proposes contacts where the sensor has one, outlines or a level set are
fitted to the structure channel, their areas take one magnitude each from the other channel, and a
second network redraws them for the data to choose. Each frame starts from the last one's estimate,
so that a still scene costs a comparison and no solve.

The outcome depends on the sequence of frames alone, never on the clock: the compute budget is
counted in modelled work, so that a recording reconstructs exactly as the live stream did.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactomo_models.areas import AreaFinder, Areas
from tactomo_models.artifact import Artifact, load_or_build_artifact
from tactomo_models.changes import WRONG_WAY, Changes, MeasuredChannel, missing, towards_pressing
from tactomo_models.contacts import Contact, Tracker, contacts_of, map_of, pressure_map
from tactomo_models.description import Modality, SensorDescription
from tactomo_models.drawing import Drawer, Drawing
from tactomo_models.following import Freedom, ShapeFollower
from tactomo_models.forward import ForwardModel
from tactomo_models.magnitudes import Magnitudes, bare_tangent, linear_magnitudes
from tactomo_models.network import NONE_TRAINED, NetworkImage, SensorNetworks
from tactomo_models.objects import ObjectFollower
from tactomo_models.outlines import Outlines, ellipses_of
from tactomo_models.paper_level_set import PaperLevelSet
from tactomo_models.plausibility import Flag, Wiring
from tactomo_models.pressure import PressureCurve, described_curve
from tactomo_models.redrawing import Redrawer, SecondOpinion
from tactomo_models.reference import Reference
from tactomo_models.shape_fit import Shape
from tactomo_models.tier import LINEAR, NETWORKS_OF, PAPER_NETWORKS, Tier, check_tier

FloatArray = NDArray[np.float64]
Image = NDArray[np.float32]

DEFAULT_BUDGET_S = 0.05
BAD_MISFIT = 2.0  # the data are not explained: what is shown may be wrong
SWAPPED = 2.0  # times the structure channel's signal that the magnitude channel's never reaches
MUCH_MORE = 5.0  # ratio of the channels' contrasts (logarithms) for that
LINEAR_PART = 0.5  # of the misfit of nothing, that areas cut out of a linear image may leave
MOST_HELD = 10  # frames without a structure scan that the last shape stands in for: half a second
LOW_CONFIDENCE = 0.8  # expected correlation below which a map is better not trusted
SURE_CONFIDENCE = 0.9  # ... from which one is, although the physics cannot explain the data
SURE_SHARE = 0.85  # of the second opinion, from which contacts are its own: outlines know theirs
UNSURE_MISFIT = 1.5  # of both channels together
UNSURE_MAGNITUDE = 0.5  # uncertainty of all magnitudes together, share of themselves


LEFT_OUT: Final = Flag.ELECTRODE_FAULT | Flag.INVALID_VOLTAGE  # what is known to be missing
FREEDOM: Final = {Tier.FIT: Freedom.OUTLINES, Tier.LEVELSET: Freedom.LEVEL_SET}  # else as needed


@dataclass(frozen=True)
class Reconstruction:
    """One frame.

    Attributes:
        map: (nodes_y, nodes_x) |relative conductivity change| of the magnitude channel; None
            where it cannot be computed.
        pressure_kpa: (nodes_y, nodes_x); None where it cannot be computed. 0 where nothing
            touches, NaN in contacts whose pressure is not known.
        structure: (nodes_y, nodes_x) 0 bare to 1 pressed; None where it cannot be computed. For
            a sensor whose objects conduct `either_way`, -1 where one conducts worse.
        contacts: pressed areas.
        tier: what made this frame.
        reason: why that tier.
        misfit: root mean square of the noise-weighted residual; about 1 where all is explained.
            Of a quiet frame, `Changes.signal`.
        flags: what stands in the way of trusting it.
        stage_s: seconds spent in each stage.
        confidence: expected correlation of the map with the truth, 0 to 1, as a network judges
            it; NaN where none did.
    """

    map: Image | None
    pressure_kpa: Image | None
    structure: Image | None
    contacts: tuple[Contact, ...]
    tier: Tier
    reason: str
    misfit: float
    flags: Flag = field(default_factory=lambda: Flag(0))
    stage_s: dict[str, float] = field(default_factory=dict)
    confidence: float = float("nan")


@dataclass(frozen=True)
class Look:
    """What a frame's scans say against the reference, before anything is made of it.

    Attributes:
        data: the changes of each channel that has any.
        flags: what stands in the way of trusting them.
        standing: those of them that say what was left out at the tare, and is ever since: these
            scans have nothing to add.
    """

    data: dict[Modality, Changes]
    flags: Flag
    standing: Flag

    @property
    def is_quiet(self) -> bool:
        """Whether there is something to see, and nothing presses."""
        return bool(self.data) and all(taken.quiet for taken in self.data.values())


class Reconstructor:
    """Turns dual scans into maps and contacts; keeps the warm start between them.

    Args:
        description: the sensor.
        artifact: what is precomputed for it; read or built if None.
        tier: the most that is done; `Tier.AUTO` does what the scene needs.
        budget_s: compute time a frame may take, on a machine of the 2.5 GHz class.
        redraw: whether the refining network has the last word on what the physics has found.
        regularisation: factor on what a rule chooses for the linear methods.
        curve: turns magnitudes into pressures; the description's own table if None.

    Raises:
        ArtifactError: the artifact or the tier's network cannot be used.

    Attributes:
        curve: the one in force; it may be set at any time.

    Not thread-safe: one thread owns it.
    """

    def __init__(
        self,
        description: SensorDescription,
        artifact: Artifact | None = None,
        *,
        tier: Tier = Tier.AUTO,
        budget_s: float | None = None,
        redraw: bool = True,
        regularisation: float = 1.0,
        curve: PressureCurve | None = None,
    ) -> None:
        self.description = description
        self.curve = curve or described_curve(description)
        self._tier = tier
        self.budget_s = budget_s
        self._redraw = redraw
        self._regularisation = regularisation * description.instrument.regularisation
        if redraw:
            check_tier(description, tier)
        self._artifact = artifact or load_or_build_artifact(description)
        self._forward = ForwardModel(description, self._artifact.bare)
        self._wiring = Wiring(description)
        self._areas = AreaFinder(self._forward)
        self._jacobian_by_node = np.ascontiguousarray(self._artifact.jacobian.T)
        self._follower = self._make_follower()
        self._drawer: Drawer | None = None
        if self._follower is not None:
            self._drawer = Drawer(self._forward, self._areas, self._follower.fit)
        self._reference: Reference | None = None
        self._channels: dict[Modality, MeasuredChannel] = {}
        self._tracker = Tracker()
        self._shape_tier = Tier.QUIET  # what made the last shape
        self._frames_held = 0  # since the last structure scan
        self._stage_s: dict[str, float] = {}
        self._left_out: list[str] = []
        self._networks = SensorNetworks(description)
        self._structure_answers_more = len(description.modalities) == 2 and bool(
            np.log(description.contrast("structure"))
            > MUCH_MORE * np.log(description.contrast("magnitude"))
        )
        self._make_ready()

    def _make_follower(self) -> ShapeFollower | ObjectFollower | None:
        structure = self.description.structure
        if structure is None:
            return None
        if structure.either_way:
            return ObjectFollower(self._forward, structure.saturated_ratio, self._object_image)
        return ShapeFollower(self._forward, structure.saturated_ratio)

    def set_reference(self, reference: Reference) -> None:
        """Measure changes against this unpressed scan from now on.

        Forgets the warm start, unless it is the last reference, drifted.

        Raises:
            DataError: a channel has another number of voltages than the sensor.
        """
        drift = {"magnitude": reference.magnitude_drift, "structure": reference.structure_drift}
        if self._reference is None or not reference.is_followed_from(self._reference):
            self._tare(reference)
        self._reference = reference
        for name, channel in self._channels.items():
            channel.follow(drift[name])

    def _tare(self, reference: Reference) -> None:
        volts = {"magnitude": reference.magnitude, "structure": reference.structure}
        noise = {"magnitude": reference.magnitude_noise, "structure": reference.structure_noise}
        self._channels = {
            name: MeasuredChannel(
                self.description,
                self._artifact,
                self._forward,
                self._wiring,
                name,
                scan,
                noise[name],
                reference.scans,
                self._regularisation,
            )
            for name in self.description.modalities
            if (scan := volts[name]) is not None
        }
        self._make_ready()
        self.reset()

    @property
    def artifact(self) -> Artifact:
        """What is precomputed for the sensor."""
        return self._artifact

    @property
    def tier(self) -> Tier:
        """The most that is done; `Tier.AUTO` does what the scene needs."""
        return self._tier

    @tier.setter
    def tier(self, tier: Tier) -> None:
        self._tier = tier
        self._make_ready()

    @property
    def _unusable_network(self) -> str:
        """Why `auto` has to do without a network that is there; empty where it need not."""
        if self.tier is not Tier.AUTO or NONE_TRAINED in self._networks.missing:
            return ""
        return f"no network: {self._networks.missing}" if self._networks.missing else ""

    def _make_ready(self) -> None:
        """Make what the tier takes now, and not when something presses."""
        _ = self._proposes
        if self.tier in LINEAR:
            for channel in self._channels.values():
                channel.matrix(self.tier)

    def reset(self) -> None:
        """Forget the warm start and which contacts were which."""
        self._tracker.clear()
        self.forget_shape()

    def forget_shape(self) -> None:
        """Forget the warm start; contacts keep their identities."""
        if self._follower and self._drawer:
            self._follower.forget()
            self._drawer.forget()
        if "_redrawer" in self.__dict__:
            self._redrawer.forget()

    def reconstruct(
        self,
        magnitude: FloatArray | None,
        structure: FloatArray | None,
        *,
        saturated: Collection[Modality] = (),
    ) -> Reconstruction:
        """Reconstruct one frame.

        Args:
            magnitude: (M,) volts; None if that scan is missing.
            structure: (M,) volts; None if that scan is missing.
            saturated: channels whose device says that its converter clipped this scan.

        Raises:
            DataError: a scan has another number of voltages than the sensor.
        """
        return self.image(self.look(magnitude, structure, saturated=saturated))

    def look(
        self,
        magnitude: FloatArray | None,
        structure: FloatArray | None,
        *,
        saturated: Collection[Modality] = (),
    ) -> Look:
        """The first half of `reconstruct`, which costs little: what has changed."""
        self._stage_s = {}
        self._left_out = [self._unusable_network] if self._unusable_network else []
        flags = own = Flag(0)
        data: dict[Modality, Changes] = {}
        with self._timed("data"):
            for name, scan in (("magnitude", magnitude), ("structure", structure)):
                if name in self.description.modalities:
                    found = self._take(name, scan, data, saturated=name in saturated)
                    flags, own = flags | found[0], own | found[1]
            if self._swapped(data):
                flags |= Flag.CHANNELS_SWAPPED
        return Look(data, flags, flags & LEFT_OUT & ~own)

    def usable(self, name: Modality) -> NDArray[np.bool_]:
        """Voltages (M,) of a channel that the tare has found nothing wrong with."""
        return self._channels[name].usable

    def image(self, look: Look) -> Reconstruction:
        """The second half of `reconstruct`: what follows from the last `look`."""
        made = self._by_tier(look.data, look.flags)
        reason = "; ".join([made.reason, *self._left_out])
        return replace(made, reason=reason, stage_s=self._stage_s)

    def _swapped(self, data: dict[Modality, Changes]) -> bool:
        """Tell whether the magnitude channel answers more than the structure channel.

        The structure channel's contrast is far the larger, so that no pressing does that.
        """
        if len(data) < 2 or data["magnitude"].quiet or not self._structure_answers_more:
            return False
        return data["magnitude"].signal > SWAPPED * data["structure"].signal

    def _take(
        self,
        name: Modality,
        scan: FloatArray | None,
        data: dict[Modality, Changes],
        *,
        saturated: bool,
    ) -> tuple[Flag, Flag]:
        """Put a channel's relative changes into `data`, or say by a flag why it has none.

        Returns the flags, and those that the scan itself raises.
        """
        if scan is None:
            return missing(name), missing(name)
        channel = self._channels.get(name)
        if channel is None:
            return (missing(name) | Flag.NO_REFERENCE,) * 2
        taken = channel.take(scan, saturated=saturated)
        if taken.electrodes:
            self._left_out.append(_named(name, taken.electrodes))
        if taken.changes is not None:
            data[name] = taken.changes
        return taken.flags, taken.own_flags

    def _by_tier(self, data: dict[Modality, Changes], flags: Flag) -> Reconstruction:
        if not data:
            return Reconstruction(
                None, None, None, (), Tier.QUIET, "no usable scan", float("nan"), flags
            )
        if all(d.quiet for d in data.values()):
            self._tracker.update(np.zeros((0, 2)))
            self.forget_shape()
            return self._quiet(data, flags)
        if self.tier in LINEAR:
            return self._linear(data, flags, self.tier, "as requested")
        if self.tier is Tier.NETWORK:
            return self._by_network(data, flags, "as requested")
        if self.tier in PAPER_NETWORKS:
            needed = self._networks.paper(NETWORKS_OF[self.tier][0]).modalities
            if not data.keys() >= set(needed):
                why = "a channel that the network needs is missing"
                return self._linear(data, flags, Tier.TIKHONOV, why)
            return self._by_paper_network(data, flags)
        if "structure" not in data and (held := self._held(data, flags)):
            return held
        if "structure" not in data:
            why = "the structure channel is missing" if self._follower else "no structure channel"
            if self._proposes:  # the network fills in what is missing as best it can
                return self._by_network(data, flags, why)
            return self._linear(data, flags, Tier.TIKHONOV, why)
        return self._by_shape(data, flags)

    def _quiet(self, data: dict[Modality, Changes], flags: Flag) -> Reconstruction:
        blank = np.zeros((self.description.map.nodes_y, self.description.map.nodes_x), np.float32)
        magnitude = blank if "magnitude" in data else None
        # The measure that told quiet; where it is blunt, changes are held against noise alone, too.
        misfit = max(d.signal for d in data.values())
        if flags & (Flag.NOISE_HIGH | Flag.STRUCTURE_MISSING):
            misfit = max(d.misfit for d in data.values())
            if misfit > BAD_MISFIT:
                flags |= Flag.MISFIT_HIGH
        return Reconstruction(
            map=magnitude,
            pressure_kpa=magnitude,
            structure=blank if "structure" in data else None,
            contacts=(),
            tier=Tier.QUIET,
            reason="no change above the noise",
            misfit=misfit,
            flags=flags,
        )

    def _linear(
        self, data: dict[Modality, Changes], flags: Flag, method: Tier, reason: str
    ) -> Reconstruction:
        """Linear images of both channels; areas above half of the clearest one's peak."""
        self.forget_shape()
        with self._timed(method):
            images = {
                name: self._channels[name].image(d.change, method) for name, d in data.items()
            }
            maps = {name: self._areas.on_map(image) for name, image in images.items()}
        with self._timed("contacts"):
            shown = images.get("structure", images.get("magnitude"))
            assert shown is not None
            peak = max(float(np.abs(shown).max()), 1e-12)
            # The rest of the image is blur: a contact there would be as large as the sheet.
            inside = np.where(np.abs(shown) > 0.5 * peak, 1.0, 0.0)
            areas = self._areas.find(self._areas.on_map(inside), inside)
            fitted = self._linear_magnitudes(areas, data)
            contacts = self._contacts(areas, fitted)
        # Its outlines are a guess, so all that can be asked is that they explain most.
        left = LINEAR_PART * data["magnitude"].misfit if "magnitude" in data else 0.0
        if self._magnitude_unexplained(data, fitted, max(BAD_MISFIT, left)):
            flags |= Flag.MISFIT_HIGH
        return Reconstruction(
            map=maps["magnitude"].astype(np.float32) if "magnitude" in data else None,
            pressure_kpa=None,  # a linear image spreads and pales: no pressure follows from it
            structure=(maps["structure"] / peak).astype(np.float32)
            if "structure" in data
            else None,
            contacts=contacts,
            tier=method,
            reason=reason,
            misfit=fitted.misfit if fitted else float("nan"),
            flags=flags,
        )

    def _object_image(self, change: FloatArray) -> FloatArray:
        return self._channels["structure"].image(change, Tier.NOSER).astype(np.float64)

    def _linear_magnitudes(self, areas: Areas, data: dict[Modality, Changes]) -> Magnitudes | None:
        """Magnitudes of a linear method: no forward solve, the bare sheet's Jacobian says all."""
        if "magnitude" not in data or not len(areas):
            return None
        tangent = bare_tangent(self._jacobian_by_node, areas)
        taken = data["magnitude"]
        return linear_magnitudes(tangent, taken.change, taken.weight, taken.spread)

    def _by_network(
        self, data: dict[Modality, Changes], flags: Flag, reason: str
    ) -> Reconstruction:
        """Our network's images; its shapes' areas carry what its map shows in them."""
        self.forget_shape()
        with self._timed("network"):
            image = self._network_image(data)
        return self._imaged(image, data, flags, Tier.NETWORK, reason)

    def _network_image(self, data: dict[Modality, Changes]) -> NetworkImage:
        return self._networks.fusion.image(*towards_pressing(self.description, data))

    def network_inputs(self, magnitude: FloatArray, structure: FloatArray) -> FloatArray:
        """What our network is given of a frame, (K,); the arguments are `reconstruct`'s."""
        return self._networks.fusion.filtered(
            *towards_pressing(self.description, self._taken(magnitude, structure))
        )

    def _taken(self, magnitude: FloatArray, structure: FloatArray) -> dict[Modality, Changes]:
        data: dict[Modality, Changes] = {}
        self._take("magnitude", magnitude, data, saturated=False)
        self._take("structure", structure, data, saturated=False)
        return data

    def _by_paper_network(self, data: dict[Modality, Changes], flags: Flag) -> Reconstruction:
        """The paper's network; areas are where its map exceeds half of its peak."""
        self.forget_shape()
        network = self._networks.paper(NETWORKS_OF[self.tier][0])
        with self._timed("images"):
            images = self._preliminary_images(data, network.modalities)
        with self._timed("network"):
            image = network.image(images)
        return self._imaged(image, data, flags, self.tier, "as requested")

    def _preliminary_images(
        self, data: dict[Modality, Changes], modalities: Collection[Modality]
    ) -> dict[Modality, FloatArray]:
        """What the paper's networks are given: see `network.preprocessed`; 0 without a scan."""
        blank = np.zeros((self.description.map.nodes_y, self.description.map.nodes_x))
        images = dict.fromkeys(modalities, blank)
        if "magnitude" in data and "magnitude" in modalities:
            # The artifact's matrix, whose regularisation is fixed, as the paper's is: what a
            # network was trained on must not depend on the noise.
            signed = self.description.sign("magnitude") * data["magnitude"].change
            images["magnitude"] = self._areas.on_map(self._artifact.tikhonov @ signed)
        if "structure" in data and "structure" in modalities:
            images["structure"] = self._areas.on_map(self._paper_shape(data["structure"]).coverage)
        return images

    def preliminary_images(
        self, magnitude: FloatArray, structure: FloatArray
    ) -> dict[Modality, FloatArray]:
        """Images (nodes_y, nodes_x) that the paper's networks are given for a frame.

        Args:
            magnitude: (M,) volts.
            structure: (M,) volts.
        """
        data = self._taken(magnitude, structure)
        return self._preliminary_images(data, self.description.modalities)

    def _imaged(
        self,
        image: NetworkImage,
        data: dict[Modality, Changes],
        flags: Flag,
        tier: Tier,
        reason: str,
    ) -> Reconstruction:
        """A frame whose images a network made."""
        with self._timed("contacts"):
            pressed = image.structure if "structure" in data else None
            if pressed is None:  # the paper's show magnitudes alone
                pressed = image.map / max(float(image.map.max()), 1e-12)
            areas = self._areas.find(pressed, self._areas.on_nodes(pressed))
            peak = np.maximum(areas.on_map.sum(axis=(1, 2)), 1e-12)
            size = (image.map * (areas.on_map > 0)).sum(axis=(1, 2)) / peak
            known = 1.0 if "magnitude" in data else np.nan
            sigma = np.full(len(areas), image.magnitude_sigma)
            contacts = self._contacts_of(areas, known * size, known * sigma)
        if image.confidence < LOW_CONFIDENCE:
            flags |= Flag.LOW_CONFIDENCE
        return Reconstruction(
            map=image.map if "magnitude" in data else None,
            pressure_kpa=pressure_map(areas, contacts) if "magnitude" in data else None,
            structure=image.structure if "structure" in data else None,
            contacts=contacts,
            tier=tier,
            reason=reason,
            misfit=float("nan"),
            flags=flags,
            confidence=image.confidence,
        )

    def _by_shape(self, data: dict[Modality, Changes], flags: Flag) -> Reconstruction:
        """Shapes on the structure channel, and a magnitude for each of their areas."""
        self._frames_held = 0
        with self._timed("shape"):
            shape, how = self._shape_of(data, self.budget_s or DEFAULT_BUDGET_S)
        solves = 3 if shape.converged else 1
        assert self._drawer is not None
        with self._timed("contacts"):
            own = self._drawer.draw(shape, data, solves)
        self._shape_tier = self._tier_of(shape)
        second = self._second_opinion(own, data, solves)
        shown = second.drawing if second is not None and second.share > SURE_SHARE else own
        if not shape.converged:
            flags |= Flag.NOT_CONVERGED
        if self._unexplained(shape, shown, data, second is not None):
            flags |= Flag.MISFIT_HIGH
            if second is not None:
                return self._network_instead(shape, data, flags)
        with self._timed("contacts"):
            contacts = self._contacts(shown.areas, shown.fitted)
        if second is not None:
            vague = not data["magnitude"].quiet and _unsure(shown)
            if vague or second.confidence < LOW_CONFIDENCE:
                flags |= Flag.LOW_CONFIDENCE
        magnitude, pressure = None, None
        if "magnitude" in data:
            magnitude = own.map(self.description.sign("magnitude"))
            pressure = pressure_map(shown.areas, contacts)
        if second is not None and magnitude is not None:
            other = second.drawing.map(self.description.sign("magnitude"))
            magnitude += second.share * (other - magnitude)
        return Reconstruction(
            map=None if magnitude is None else magnitude.astype(np.float32),
            pressure_kpa=pressure,
            structure=shown.pressed.astype(np.float32),
            contacts=contacts,
            tier=self._shape_tier if second is None else Tier.HYBRID,
            reason=how,
            misfit=shape.misfit,
            flags=flags,
            confidence=float("nan") if second is None else second.confidence,
        )

    def _unexplained(
        self, shape: Shape, shown: Drawing, data: dict[Modality, Changes], strict: bool
    ) -> bool:
        """Tell whether the data say that something else presses.

        With a network to turn to, it is asked sooner.
        """
        if shape.misfit > BAD_MISFIT:
            return True
        if self._magnitude_unexplained(data, shown.fitted, BAD_MISFIT):
            return True
        other = shown.fitted.misfit if shown.fitted else 0.0
        return strict and bool(np.hypot(shape.misfit, other) > np.sqrt(2) * UNSURE_MISFIT)

    def _network_instead(
        self, shape: Shape, data: dict[Modality, Changes], flags: Flag
    ) -> Reconstruction:
        """Our network's frame where no shape with even pressures explains the data.

        It has learnt soft rims and contacts between two scans, too; where it is sure, so are we.
        """
        with self._timed("network"):
            image = self._network_image(data)
        if image.confidence >= SURE_CONFIDENCE:
            flags &= ~Flag.MISFIT_HIGH
        made = self._imaged(image, data, flags, Tier.NETWORK, "no even presses explain the data")
        return replace(made, misfit=shape.misfit)

    def _second_opinion(
        self, own: Drawing, data: dict[Modality, Changes], solves: int
    ) -> SecondOpinion | None:
        if not (self._redraw and self._proposes) or own.fitted is None:
            return None
        with self._timed("network"):
            return self._redrawer.redraw(own, data, solves)

    @cached_property
    def _redrawer(self) -> Redrawer:
        return Redrawer(self.description, self._forward, self._areas, self._networks.refiner)

    def _held(self, data: dict[Modality, Changes], flags: Flag) -> Reconstruction | None:
        """Bridge a lost structure scan with the last shape, as long as it explains the other."""
        self._frames_held += 1
        if self._drawer is None or not self._drawer.has_drawn or self._frames_held > MOST_HELD:
            return None
        with self._timed("contacts"):
            shown = self._drawer.draw_again(data)
            fitted = shown.fitted
            if fitted is None or self._magnitude_unexplained(data, fitted, BAD_MISFIT):
                return None
            contacts = self._contacts(shown.areas, fitted)
        return Reconstruction(
            map=map_of(shown.areas, np.array([c.magnitude for c in contacts])),
            pressure_kpa=pressure_map(shown.areas, contacts),
            structure=None,
            contacts=contacts,
            tier=self._shape_tier,
            reason="the last shape: the structure scan is missing",
            misfit=fitted.misfit,
            flags=flags,
        )

    def _shape_of(self, data: dict[Modality, Changes], budget_s: float) -> tuple[Shape, str]:
        assert self._follower is not None
        structure = data["structure"]
        change, weight, spread = structure.change, structure.weight, structure.spread
        between = structure.between
        if self.tier is Tier.PLS_PAPER:
            self.forget_shape()  # it starts cold, always
            return self._paper_shape(structure), "as requested"
        if isinstance(self._follower, ObjectFollower):
            return self._follower.follow(change, weight, budget_s)
        freedom = FREEDOM.get(self.tier, Freedom.AS_NEEDED)
        propose = (lambda: self._proposed(data)) if self._proposes else None
        return self._follower.follow(change, weight, spread, between, budget_s, freedom, propose)

    def _proposed(self, data: dict[Modality, Changes]) -> FloatArray:
        """Ellipses that the network's shape suggests, to be refined and judged by the physics."""
        with self._timed("network"):
            pressed = self._network_image(data).structure
        assert pressed is not None
        areas = self._areas.find(pressed, self._areas.on_nodes(pressed))
        return ellipses_of(areas.on_map, *self._areas.map_places)

    @property
    def _proposes(self) -> bool:
        """Whether networks help the physics."""
        return self.tier is Tier.HYBRID or (self.tier is Tier.AUTO and not self._networks.missing)

    def _paper_shape(self, structure: Changes) -> Shape:
        image = np.maximum(self._channels["structure"].image(structure.change, Tier.TIKHONOV), 0.0)
        return self._paper.fit(structure.change, structure.weight, image)

    def _tier_of(self, shape: Shape) -> Tier:
        if self.tier is Tier.PLS_PAPER:
            return Tier.PLS_PAPER
        return Tier.FIT if isinstance(shape.family, Outlines) else Tier.LEVELSET

    @cached_property
    def _paper(self) -> PaperLevelSet:
        """Made when it is first asked for."""
        assert self.description.structure is not None
        ratio = self.description.structure.saturated_ratio
        return PaperLevelSet(self._forward, self._jacobian_by_node, ratio)

    def _magnitude_unexplained(
        self, data: dict[Modality, Changes], fitted: Magnitudes | None, bad_misfit: float
    ) -> bool:
        """Tell whether the contacts shown leave the magnitude channel's changes unexplained.

        They do where there is a change and no area for it, and where an area's conductivity goes
        the way that no pressure takes it: what is shown for that is a magnitude of 0.
        """
        if "magnitude" not in data:
            return False
        if fitted is None:
            return data["magnitude"].misfit > bad_misfit
        wrong_way = self.description.sign("magnitude") * fitted.change < -WRONG_WAY * fitted.sigma
        return fitted.misfit > bad_misfit or bool(wrong_way.any())

    def _contacts(self, areas: Areas, fitted: Magnitudes | None) -> tuple[Contact, ...]:
        unknown = np.full(len(areas), np.nan)
        size, sigma = unknown, unknown
        if fitted is not None:
            sign, sigma = self.description.sign("magnitude"), fitted.sigma
            size = np.maximum(sign * fitted.change, 0.0)
        return self._contacts_of(areas, size, sigma)

    def _contacts_of(
        self, areas: Areas, size: FloatArray, sigma: FloatArray
    ) -> tuple[Contact, ...]:
        ids = self._tracker.update(areas.centres_m)
        return contacts_of(areas, ids, size, sigma, self.curve)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self._stage_s[stage] = self._stage_s.get(stage, 0.0) + time.perf_counter() - start


def _unsure(drawing: Drawing) -> bool:
    """Tell whether the magnitudes are hardly known."""
    assert drawing.fitted is not None
    weights, fitted = drawing.areas.areas_m2, drawing.fitted
    known, unknown = weights @ fitted.change**2, weights @ fitted.sigma**2
    return bool(unknown > UNSURE_MAGNITUDE**2 * known)


def _named(name: Modality, electrodes: list[int]) -> str:
    """Say in words which electrodes are left out; they are counted from 0."""
    word = "electrode" if len(electrodes) == 1 else "electrodes"
    return f"{name} {word} {', '.join(map(str, electrodes))} left out"
