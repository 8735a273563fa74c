"""The protocol of a reconstruction method: prepared at the tare, then asked frame by frame.

A method of one's own is a class with these two functions. This one is complete:

    class Brightest:
        def prepare(self, skin: Skin) -> None:
            self.skin = skin

        def solve(
            self, measurement: Measurement, previous: Estimate | None, budget_s: float
        ) -> Estimate:
            change = measurement.changes[Channel.MAGNITUDE].change
            image = np.abs(self.skin.artifact.tikhonov @ change)
            return Estimate(map=self.skin.areas.on_map(image))

`tactomo reconstruct IN.npz OUT.npz --method my_module:Brightest` runs it; see `registry`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray, Image
from tactomo_models.methods.trained_networks import SensorNetworks
from tactomo_models.physics.artifact import Artifact, load_or_build_artifact
from tactomo_models.physics.forward import ForwardModel
from tactomo_models.physics.node_mesh import NodeMesh
from tactomo_models.scans.measurement import Measurement
from tactomo_models.scans.plausibility import Flag
from tactomo_models.scans.reference import Reference
from tactomo_models.scans.tare import Sensor, Tare
from tactomo_models.scene.areas import AreaFinder, Areas
from tactomo_models.scene.field_account import FieldAccount
from tactomo_models.sensor.description import SensorDescription


@dataclass(frozen=True)
class Skin:
    """What a method is prepared with: one sensor, as it was at the tare.

    Attributes:
        description: the sensor.
        artifact: what is precomputed for it: the bare sheet's Jacobian, Tikhonov's matrix, ...
        forward: the model of its sheet.
        areas: finds pressed areas in an image, and takes images from nodes to the map.
        networks: trained for this sensor.
        tare: what is known of it since then; of no channel before the first one.
        regularisation: factor on the linear methods' regularisation parameter.
    """

    description: SensorDescription
    artifact: Artifact
    forward: ForwardModel
    areas: AreaFinder
    networks: SensorNetworks
    tare: Tare
    regularisation: float = 1.0

    @property
    def magnitude_sign(self) -> float:
        """Of the magnitude channel's change under pressure; 1 where there is no such channel."""
        has_magnitude = Channel.MAGNITUDE in self.description.channels
        return self.description.sign(Channel.MAGNITUDE) if has_magnitude else 1.0

    @cached_property
    def mesh(self) -> NodeMesh:
        """The nodes of the Jacobian's columns: places, triangles, areas, electrodes."""
        return NodeMesh.of(self.forward)

    @classmethod
    def of(cls, description: SensorDescription, artifact: Artifact | None = None) -> Skin:
        """A sensor before its first tare; its artifact is read or built if None."""
        artifact = artifact or load_or_build_artifact(description)
        forward = ForwardModel(description, artifact.bare)
        finder, networks = AreaFinder(forward), SensorNetworks(description)
        untared = Tare.take(Sensor(description, artifact, forward), Reference(None, None))
        return cls(description, artifact, forward, finder, networks, untared)


@dataclass(frozen=True)
class Estimate:
    """What a method makes of a measurement; a map or a structure suffices.

    Attributes:
        map: (nodes_y, nodes_x) |relative conductivity change| of the magnitude channel; None
            where it is not computed.
        structure: (nodes_y, nodes_x) 0 bare to 1 pressed, -1 where an object conducts worse;
            None where it is not computed.
        areas: K pressed areas; where None, they are found in the structure above one half, or
            else in the map above half of its peak.
        magnitudes: (K,) |relative conductivity change| of each area, NaN where unknown; where
            None, the map's mean in each area.
        magnitude_sigmas: (K,) their standard uncertainties, or one for all; where NaN, pressures
            are unknown, too.
        account: what a fitted pressure field says of the same areas; None where none was fitted.
        has_drifted: whether a drift of the sheets explains what no contact does.
        tells_pressure: whether a pressure map follows from the areas' magnitudes.
        misfit: root mean square of the noise-weighted residual; NaN where it is not known.
        confidence: expected correlation of the map with the truth, 0 to 1; NaN where not known.
        flags: what stands in the way of trusting the estimate, beside the measurement's flags.
        made_by: what made the estimate, in a word, for the frame's `tier`; the method's name if
            empty.
        reason: why, in words.
        companions: of each companion that was looked at, whether it agrees with the sheets.
        carried: what the method wants to find in `previous` at the next frame; nobody else reads
            it.
        lasting: what it wants to find there instead after frames in which nothing pressed; None
            where it starts cold.
    """

    map: FloatArray | Image | None = None
    structure: FloatArray | Image | None = None
    areas: Areas | None = None
    magnitudes: FloatArray | None = None
    magnitude_sigmas: FloatArray | float = float("nan")
    account: FieldAccount | None = None
    has_drifted: bool = False
    tells_pressure: bool = True
    misfit: float = float("nan")
    confidence: float = float("nan")
    flags: Flag = field(default_factory=lambda: Flag(0))
    made_by: str = ""
    reason: str = "as requested"
    companions: Mapping[str, bool] = field(default_factory=dict)
    carried: object = None
    lasting: object = None


class UnsolvableError(Exception):
    """Raised by a method that makes nothing of a measurement; says why.

    The frame is then `tikhonov`'s.
    """


class Method(Protocol):
    """Turns a frame's measurement into an estimate.

    An instance belongs to one reconstructor and is made without arguments. It may keep what it
    likes between frames, as long as the outcome depends on the sequence of frames alone, never on
    the clock. A class may name the channels that it cannot do without as `needs`, and have a
    static method `check(description)` that raises `ArtifactError` where the sensor lacks anything
    else. One that solves presses on each sheet as it is sets `uses_sheets` to True.
    """

    def prepare(self, skin: Skin) -> None:
        """Make what frames will need, at each tare: it may take as long as it must."""

    def solve(
        self, measurement: Measurement, previous: Estimate | None, budget_s: float
    ) -> Estimate:
        """Estimate what presses.

        Args:
            measurement: of at least one channel, in which something presses.
            previous: this method's estimate of the frame before; None where there is none to go
                on from: start cold.
            budget_s: compute time to spend, by a model of the work (`field_fit.Budget`).

        Raises:
            UnsolvableError: the measurement lacks what the method needs.
        """
        ...
