"""Trained networks at run time: ONNX Runtime on one thread, no PyTorch.

A network's file carries what it was made for: the sensor's hash, the basis of its prefilter, its
scale. One that does not belong to the sensor at hand is refused with the reason.
"""

from __future__ import annotations

import io
import os
import zlib
from base64 import b64decode
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, Final
from weakref import WeakValueDictionary
from zipfile import BadZipFile

import numpy as np
from tactomo_protocol import Channel

from tactomo_models.arrays import FloatArray, Image
from tactomo_models.errors import ArtifactError
from tactomo_models.foreign_file import open_regular
from tactomo_models.methods.prefilter import BANDS, Prefilter, prefilter
from tactomo_models.physics.artifact import cache_folder
from tactomo_models.sensor.description import SensorDescription

# From 1.31 on it would report to its maker from every computer, by a thread that its import starts.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"
import onnxruntime as ort

FORMAT = 1
CHANNELS_KEY = "modalities"  # as the files of this format have it
SHIPPED = Path(str(files("tactomo_models.methods"))) / "networks"
NONE_TRAINED = "none is trained for this sensor"
FUSION: Final = "network"
"""Our kind of network. One of any other kind makes a map of an image of each channel."""


def outputs_of(kind: str) -> tuple[str, ...]:
    """Names of a network's outputs."""
    return ("map", Channel.STRUCTURE, "confidence") if kind == FUSION else ("map",)


@dataclass(frozen=True)
class NetworkImage:
    """What a network makes of a frame.

    Attributes:
        map: (nodes_y, nodes_x) |relative conductivity change| of the magnitude channel.
        structure: (nodes_y, nodes_x) 0 bare to 1 pressed.
        confidence: expected correlation of the map with the truth, 0 to 1.
        magnitude_sigma: standard uncertainty of a contact's magnitude.
    """

    map: Image
    structure: Image
    confidence: float
    magnitude_sigma: float


class Network:
    """A network in a file, bound to its buffers: a run allocates nothing but what it returns.

    Args:
        path: the .onnx file.
        description: the sensor.
        kind: what the network is to be.

    Raises:
        ArtifactError: it is missing, damaged, of another kind, sensor or format.
    """

    def __init__(self, path: Path, description: SensorDescription, kind: str) -> None:
        self.path = path
        self._session = _open(path)
        self.notes = _checked(self._session, path, description, kind)
        self._nodes = (description.map.nodes_y, description.map.nodes_x)
        shapes = {"map": self._nodes, Channel.STRUCTURE: self._nodes, "confidence": ()}
        inputs = self._input_shapes(description, kind)
        _check_shapes(path, "input", self._session.get_inputs(), inputs)
        outputs = {name: shapes[name] for name in outputs_of(kind)}
        _check_shapes(path, "output", self._session.get_outputs(), outputs)
        self._inputs = {name: np.zeros((1, *shape), np.float32) for name, shape in inputs.items()}
        self._outputs = {name: np.zeros((1, *shape), np.float32) for name, shape in outputs.items()}
        self._binding = self._session.io_binding()
        for name, array in self._inputs.items():
            self._binding.bind_input(name, "cpu", 0, np.float32, array.shape, array.ctypes.data)
        for name, array in self._outputs.items():
            self._binding.bind_output(name, "cpu", 0, np.float32, array.shape, array.ctypes.data)

    def _input_shapes(
        self, description: SensorDescription, kind: str
    ) -> dict[str, tuple[int, ...]]:
        if kind == FUSION:
            return {"data": (len(self.channels) * (description.measurements // 2 + BANDS),)}
        return dict.fromkeys(self.channels, self._nodes)

    @cached_property
    def channels(self) -> tuple[Channel, ...]:
        """Channels that the network is given."""
        names: tuple[Channel, ...] = (Channel.MAGNITUDE, Channel.STRUCTURE)
        return tuple(name for name in names if name in self.notes[CHANNELS_KEY].split())

    def run(self, inputs: Mapping[str, Any]) -> dict[str, Image]:
        """Run on inputs of the network's own shapes, without the first axis.

        Returns:
            Its outputs, likewise; they are overwritten by the next run.
        """
        for name, array in self._inputs.items():
            array[0] = inputs[name]
        self._session.run_with_iobinding(self._binding)
        return {name: array[0] for name, array in self._outputs.items()}


class FusionNetwork:
    """Our network and its prefilters, for one sensor.

    Args:
        network: of the kind `FUSION`.

    Raises:
        ArtifactError: what it notes on itself is damaged.
    """

    def __init__(self, network: Network) -> None:
        magnitude_error = 0.1  # of the range: two in three of our network's err by no more
        self._network = network
        try:
            self._sigma = magnitude_error * float(network.notes["scale"])
            #: (M, K) of each channel's prefilter
            self.bases = _bases_of(network)
        except (KeyError, ValueError, EOFError, OSError, BadZipFile, zlib.error) as error:
            raise ArtifactError(
                f"{network.path}: what it notes on itself is damaged; copy or train it anew"
            ) from error
        self._filters: dict[Channel, tuple[bytes, Prefilter]] = {}
        self._mute = {
            name: prefilter(basis, np.zeros(len(basis))) for name, basis in self.bases.items()
        }

    def image(
        self,
        changes: Mapping[Channel, FloatArray],
        precision: Mapping[Channel, FloatArray],
    ) -> NetworkImage:
        """Reconstruct a frame.

        Args:
            changes: (M,) relative voltage changes, in the direction of pressing, of each channel
                that has a scan.
            precision: (M,) inverse variance of each by noise; 0 where there is no voltage.
        """
        faint = 0.05  # share pressed below which nothing is: a solve goes by the area that is not 0
        made = self._network.run({"data": self._filtered(changes, precision)})
        structure = made[Channel.STRUCTURE].copy()
        structure[structure < faint] = 0.0
        return NetworkImage(made["map"].copy(), structure, float(made["confidence"]), self._sigma)

    def _filtered(
        self, changes: Mapping[Channel, FloatArray], precision: Mapping[Channel, FloatArray]
    ) -> FloatArray:
        """What the network is given of a frame's voltages, (K,); the arguments are `image`'s."""
        parts: list[FloatArray] = []
        for name in self._network.channels:
            if name in changes:
                used = self._filter(name, precision[name])
                parts += [used.matrix @ changes[name], used.known]
            else:
                used = self._mute[name]
                parts += [np.zeros(len(used.matrix)), used.known]
        return np.concatenate(parts)

    def _filter(self, name: Channel, precision: FloatArray) -> Prefilter:
        """Made anew when the noise changes: at a tare, or when a lead breaks."""
        key = precision.tobytes()
        if name not in self._filters or self._filters[name][0] != key:
            self._filters[name] = (key, prefilter(self.bases[name], precision))
        return self._filters[name][1]


def _bases_of(network: Network) -> dict[Channel, FloatArray]:
    """Bases (M, K) of the prefilters that a network's notes on itself have, by channel.

    Raises:
        KeyError: there are none of a channel.
        ValueError, EOFError, OSError, BadZipFile, zlib.error: they are damaged.
    """
    kept = np.load(io.BytesIO(b64decode(network.notes["bases"])), allow_pickle=False)
    bases = {name: kept[name].astype(np.float64) for name in network.channels}
    if any(basis.ndim != 2 or not np.isfinite(basis).all() for basis in bases.values()):
        raise ValueError("bases are (M, K), and finite")
    return bases


class SensorNetworks:
    """Our network of one sensor, loaded when it is first asked for.

    Args:
        description: the sensor.
    """

    def __init__(self, description: SensorDescription) -> None:
        self._description = description

    @cached_property
    def fusion(self) -> FusionNetwork:
        """The network and its prefilters.

        Raises:
            ArtifactError: there is none, or it cannot be used.
        """
        return FusionNetwork(load_network(self._description, FUSION))

    @cached_property
    def missing(self) -> str:
        """Why the physics has to do without a network; empty where it need not."""
        if len(self._description.channels) < 2:
            return f"{NONE_TRAINED}: it has a single channel"
        if find_network(self._description, FUSION) is None:
            return outgrown(self._description, FUSION) or NONE_TRAINED
        try:
            _ = self.fusion
        except ArtifactError as error:
            return str(error)
        return ""


def find_network(description: SensorDescription, kind: str, shipped: Path = SHIPPED) -> Path | None:
    """File of a sensor's network: the user's own, or one in `shipped`; None if there is none."""
    own = own_path(description, kind)
    return next((path for path in (own, shipped / own.name) if path.exists()), None)


def outgrown(description: SensorDescription, kind: str, shipped: Path = SHIPPED) -> str:
    """Tell that there are networks, of what the description said before; empty where none are."""
    pattern = f"{description.name}-{'?' * 12}-{kind}.onnx"
    old = [path for folder in (cache_folder(), shipped) for path in folder.glob(pattern)]
    if not old:
        return ""
    return (
        f"{old[0].name} was trained before the sheet, electrodes, pattern or map of "
        f"{description.name!r} changed (now {description.sha256[:12]}): train anew, or change them "
        "back"
    )


def own_path(description: SensorDescription, kind: str) -> Path:
    """Where a network that a user has trained is looked for."""
    return cache_folder() / f"{description.name}-{description.sha256[:12]}-{kind}.onnx"


def need_network(description: SensorDescription, kind: str, shipped: Path = SHIPPED) -> Path:
    """File of a sensor's network, as `find_network` has it, not yet opened.

    Raises ArtifactError where there is none.
    """
    found = find_network(description, kind, shipped)
    if found is None and len(description.channels) < 2:
        raise ArtifactError(
            f"there is no {kind} for sensor {description.name!r}, and there can be none: networks "
            "need both channels; use auto, or another method"
        )
    if found is None:
        raise ArtifactError(
            outgrown(description, kind, shipped)
            or f"there is no {kind} for sensor {description.name!r} ({description.sha256[:12]}); "
            "train one: tactomo models simulate, then tactomo models train"
        )
    return found


def load_network(
    description: SensorDescription,
    kind: str,
    path: Path | None = None,
    shipped: Path = SHIPPED,
) -> Network:
    """Load a sensor's network.

    Args:
        description: the sensor.
        kind: which network.
        path: its file; the user's own or the shipped one if None.
        shipped: the folder of those that come with tactomo.

    Raises:
        ArtifactError: there is none, or it cannot be used.
    """
    found = path or need_network(description, kind, shipped)
    return Network(found, description, kind)


# By file and its time: weights are in memory once, what differs are each network's buffers.
_sessions: WeakValueDictionary[tuple[Path, int], ort.InferenceSession] = WeakValueDictionary()


def _open(path: Path) -> ort.InferenceSession:
    newest_opset = 21  # that the oldest ONNX Runtime we support runs
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 3
    try:
        open_regular(path).close()  # for an error of the system's; from bytes, a session keeps them
        version = path, path.stat().st_mtime_ns
        if (session := _sessions.get(version)) is None:
            session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
            _sessions[version] = session
        return session
    except FileNotFoundError as error:
        raise ArtifactError(f"there is no network at {path}; name another file") from error
    except OSError as error:
        raise ArtifactError(f"cannot read {path}: {error.strerror}") from error
    except Exception as error:  # ONNX Runtime's own classes derive from nothing narrower
        reason = str(error).splitlines()[0][:200]
        raise ArtifactError(
            f"{path} is no network that ONNX Runtime {ort.__version__} can run: {reason}; export "
            f"it anew, with opset {newest_opset} or older"
        ) from error


def _checked(
    session: ort.InferenceSession, path: Path, description: SensorDescription, kind: str
) -> dict[str, str]:
    """The file's notes on itself, which must be of this sensor and kind."""
    meta: dict[str, str] = session.get_modelmeta().custom_metadata_map
    again = "train one with `tactomo models train`"
    if not {"format", "kind", "sensor", "sha256", CHANNELS_KEY, "scale"} <= meta.keys():
        raise ArtifactError(f"{path} is an ONNX file, but no network of tactomo; {again}")
    if meta["format"] != str(FORMAT):
        raise ArtifactError(
            f"{path} has format {meta['format']}, this version reads {FORMAT}; {again}"
        )
    if meta["kind"] != kind:
        raise ArtifactError(f"{path} is a {meta['kind']}, not a {kind}; name another file")
    if meta["sha256"] != description.sha256:
        raise ArtifactError(
            f"{path} was trained for sensor {meta['sensor']!r} ({meta['sha256'][:12]}), not for "
            f"{description.name!r} ({description.sha256[:12]}); {again}"
        )
    if not set(meta[CHANNELS_KEY].split()) <= set(description.channels):
        raise ArtifactError(
            f"{path} takes the channels {meta[CHANNELS_KEY]}, and sensor {description.name!r} has "
            f"{' '.join(description.channels)} alone; use auto, or another method"
        )
    return meta


def _check_shapes(
    path: Path, what: str, there: list[Any], expected: Mapping[str, tuple[int, ...]]
) -> None:
    shapes = {node.name: tuple(node.shape) for node in there}
    wanted = {name: (1, *shape) for name, shape in expected.items()}
    if shapes != wanted:
        raise ArtifactError(
            f"{path} has {what}s {shapes}, this sensor needs {wanted}; export it anew"
        )
    types = {node.type for node in there}
    if types != {"tensor(float)"}:
        raise ArtifactError(
            f"{path} has {what}s of type {', '.join(sorted(types))}, not tensor(float); export it "
            "anew"
        )
