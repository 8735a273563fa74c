"""The whole twin: skin, firmware, lines and control socket, and the two threads they need.

One thread keeps time: it answers the host and the control socket and sends what is due. A second
one computes voltages, because a forward solve must not make a hello or an acknowledgement late.
They share nothing but futures: the timing thread submits a list of presses and is woken when the
voltages are there.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from pydantic import TypeAdapter, ValidationError
from tactomo_client.messages import DEFAULT_TWIN_CONTROL
from tactomo_models import Press, SensorDescription, SkinSimulator
from tactomo_models.simulation.skin_drift import DriftingSkin, SkinDrift
from tactomo_protocol import Channel, CompanionReading, SampleFormat
from threadpoolctl import threadpool_limits

from tactomo.config import Endpoint
from tactomo.endpoint import is_local
from tactomo.errors import CommandError, ConfigError
from tactomo.plain import counted
from tactomo.protocols import NATIVE, emulator_of, find_protocol, protocol_named
from tactomo.protocols.interface import TWIN_ID, hello_of
from tactomo.stream.commands import Nothing, explained
from tactomo.twin.control import (
    COMMANDS,
    ControlSocket,
    GarbageArguments,
    MuteArguments,
    NoiseArguments,
    PlayArguments,
    PortArguments,
    PressArguments,
    ReleaseArguments,
)
from tactomo.twin.firmware import (
    RATE_HZ_MAX,
    RATE_HZ_MIN,
    Converter,
    Firmware,
    Port,
    SimulatedCompanion,
    Voltages,
)
from tactomo.twin.foreign import Emulator, ForeignFirmware
from tactomo.twin.line import SerialLine
from tactomo.twin.scene import Indenter, Scene, SkinDriftSettings
from tactomo.worker import Wakeup

# How often a line that nobody has open is looked at; its hang-up cannot be waited on.
HANGUP_CHECK_S = 0.02
RATE_HZ = 20.0
# Room above the largest unloaded voltage before the converter clips.
HEADROOM = 8.0
# Noise of the converter where none is given, as a share of the largest unloaded voltage: 60 dB
# below the root mean square of all of them on the paper's sensor, as a good EIT device has it.
NOISE_SHARE = 2.5e-4
# Of a sheet as one buys it: standard deviation of its conductivity, a ratio.
UNEVENNESS = 0.03
# Contact impedances of pressed-on electrodes differ; the daemon's model must live with that.
IMPEDANCE_SPREAD = 0.1


def make_skin(
    description: SensorDescription, unevenness: float = UNEVENNESS, seed: int = 0
) -> SkinSimulator:
    """Return the forward model of a skin as real ones are: not quite even, electrodes neither."""
    return SkinSimulator(
        description, unevenness=unevenness, impedance_spread=IMPEDANCE_SPREAD, seed=seed
    )


@dataclass(frozen=True)
class TwinConfig:
    """How the twin is set up."""

    description: SensorDescription  #: the sensor that it simulates
    ports: int = 1  #: 1 for one line that carries every channel, 2 for a line for each
    rate_hz: float = RATE_HZ  #: scans a second, at first; the host may change it
    noise_v: float | None = None  #: noise in volts rms; None for a usual converter's
    #: how the skin itself drifts; the scene's if that says so
    skin_drift: SkinDrift = field(default_factory=SkinDrift)
    unevenness: float = UNEVENNESS  #: standard deviation of the sheet's conductivity, a ratio
    seed: int = 0  #: equal seeds give equal noise, drift and unevenness
    #: a scripted scene; it starts with the first scan that a host can receive
    scene: Scene | None = None
    protocol: str = NATIVE  #: what the device speaks; foreign ones have one port and one channel
    control: str = DEFAULT_TWIN_CONTROL  #: address of the control socket; port 0 takes a free one
    link_folder: Path | None = None  #: where to keep links with stable names to the lines

    def __post_init__(self) -> None:
        try:
            TypeAdapter(Endpoint).validate_python(self.control)
        except ValidationError as error:
            raise ConfigError(f"control = {self.control!r}", explained(error)) from error
        if not is_local(self.control):
            raise ConfigError(
                f"control = {self.control!r} can be reached from other computers, and anybody "
                "there could press the twin",
                "use tcp://127.0.0.1:PORT or ipc://PATH",
            )
        protocol = find_protocol(self.protocol).name
        protocol_named(protocol, self.description)  # or says why it cannot carry the sensor
        channels = len(self.description.channels)
        if self.ports not in (1, 2) or self.ports > channels:
            raise ConfigError(
                f"{self.description.name} has {counted(channels, 'channel')}, "
                f"so not {self.ports} ports",
                "give 1 port, or 2 for a sensor of two channels",
            )
        if protocol != NATIVE:
            emulator_of(protocol)
        companion = next(iter(self.description.companion), None)
        if self.protocol != NATIVE and companion is not None:
            raise ConfigError(
                f"{self.description.name} has a companion, {companion}, and the twin's device of "
                f"protocol {self.protocol} sends no readings",
                f"leave [companion] out, or give the protocol {NATIVE}",
            )
        if not RATE_HZ_MIN <= self.rate_hz <= RATE_HZ_MAX:
            raise ConfigError(
                f"a rate of {self.rate_hz:g} Hz is out of range",
                f"give {RATE_HZ_MIN:g} to {RATE_HZ_MAX:g} scans a second",
            )
        if self.noise_v is not None and not 0.0 <= self.noise_v < float("inf"):
            raise ConfigError(
                f"noise of {self.noise_v:g} V is out of range", "give 0 V or more, in volts rms"
            )


class Twin:
    """A simulated sensor; its lines and its control socket are there from construction on.

    Its skin is by default made of the description, which takes seconds. Raises AddressError or
    TactomoError where the control socket or the links cannot be had.
    """

    def __init__(self, config: TwinConfig, skin: SkinSimulator | None = None) -> None:
        self.config = config
        self._script = config.scene
        self._started_s: float | None = None  # when the script was started, by the device's clock
        self._live: dict[str, Indenter] = {}  # what clients press, by id
        with contextlib.ExitStack() as undo:
            # What may be taken comes first: nobody likes to wait for a mesh to be told that.
            self._control = ControlSocket(
                config.control, {command: getattr(self, f"_{command}") for command in COMMANDS}
            )
            undo.callback(self._control.close)
            ports = []
            for line, channels in _wiring(config).items():
                ports.append(Port(SerialLine(line, config.link_folder), channels))
                undo.callback(ports[-1].line.close)
            self._skin = skin or make_skin(config.description, config.unevenness, config.seed)
            self._drifting = DriftingSkin(self._skin, config.skin_drift, config.seed)
            undo.pop_all()
        sensor = config.description
        self._companions = {
            name: SimulatedCompanion(index, sensor.companion[name], config.seed)
            for index, name in sensor.companion_indices.items()
        }
        self._converter = self._make_converter()
        self._powered_s = time.monotonic()
        self._firmware = self._make_firmware(ports)
        self._wakeup = Wakeup()
        self._solver = ThreadPoolExecutor(max_workers=1, thread_name_prefix="twin-skin")
        self._thread = threading.Thread(target=self._run, name="twin-firmware")
        self._stopping = threading.Event()
        self._ended = threading.Event()
        self._failure: BaseException | None = None

    @property
    def ports(self) -> tuple[str, ...]:
        """What the host opens: one path a line, magnitude first."""
        return tuple(port.line.path for port in self._firmware.ports)

    @property
    def control(self) -> str:
        """Address of the control socket."""
        return self._control.address

    def start(self) -> None:
        """Power up."""
        self._thread.start()

    def stop(self) -> None:
        """Power down, close the lines and the control socket; may be called twice."""
        self._stopping.set()
        self._wakeup.set()
        if self._thread.ident is None:  # never started: the closing falls to us
            self._thread.start()
        self._thread.join()
        self.wait()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the twin has stopped and tell whether it has; raise, once, what failed."""
        # Not a join: one that Ctrl-C interrupts takes the thread for ended (Python 3.11, 3.12).
        ended = self._ended.wait(timeout_s)
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
        return ended

    def _run(self) -> None:
        try:
            with threadpool_limits(limits=1):  # the daemon needs the other cores
                while not self._stopping.is_set():
                    self._rest()
                    self._control.answer()
                    self._firmware.step()
        except BaseException as error:  # handed to whoever waits for this thread
            self._failure = error
        finally:
            self._solver.shutdown(cancel_futures=True)
            for port in self._firmware.ports:
                port.line.close()
            self._control.close()
            self._wakeup.close()
            self._ended.set()

    def _rest(self) -> None:
        """Wait until something is due, or the host, a client or the solver has something."""
        poller = zmq.Poller()
        poller.register(self._control.socket, zmq.POLLIN)
        poller.register(self._wakeup.reader, zmq.POLLIN)
        timeout_s = self._firmware.due_in_s()
        for port in self._firmware.ports:
            if port.line.is_open:
                poller.register(port.line.fileno(), zmq.POLLIN)
            else:
                timeout_s = min(timeout_s, HANGUP_CHECK_S)
        poller.poll(math.ceil(timeout_s * 1e3))
        self._wakeup.drain()

    def _clock(self) -> float:
        return time.monotonic() - self._powered_s

    def _sample(self, time_s: float) -> Future[Voltages]:
        """Start computing the voltages of the skin as it is at device time `time_s`."""
        # A daemon that attaches later takes its reference from an unloaded skin, then sees all.
        if self._started_s is None and any(p.line.is_open for p in self._firmware.ports):
            self._play_at(time_s)
        presses = self._presses_at(time_s)
        future: Future[Voltages] = self._solver.submit(self._drifting.voltages, presses, time_s)
        future.add_done_callback(lambda _: self._wakeup.set())
        return future

    def _presses_at(self, time_s: float) -> list[Press]:
        return [indenter.press() for indenter in self._indenters_at(time_s).values()]

    def _indenters_at(self, time_s: float) -> dict[str, Indenter]:
        """Return what presses the skin, by id; live presses go before the script's."""
        if self._script is None or self._started_s is None:
            return dict(self._live)
        return self._script.presses_at(max(0.0, time_s - self._started_s)) | self._live

    def _read_companions(self, time_s: float, counter: int) -> list[CompanionReading]:
        if not self._companions:
            return []
        forces_n = self._skin.forces_n(self._presses_at(time_s))
        return [one.read(forces_n[k], time_s, counter) for k, one in self._companions.items()]

    def _play_at(self, time_s: float) -> None:
        """Start the scripted scene; it may say how the skin drifts."""
        self._started_s, script = time_s, self._script
        if script is not None and script.drift is not None:
            self._drifting.drift = script.drift.skin_drift()

    def _make_firmware(self, ports: list[Port]) -> Firmware:
        config, device = self.config, self.config.description.name
        is_foreign = config.protocol != NATIVE
        protocol = find_protocol(config.protocol).name
        hello = hello_of(
            config.description,
            config.description.channels,
            f"{TWIN_ID}{f'{protocol}-' if is_foreign else ''}{device}"[:64],
            f"tactomo-twin {version('tactomo')}",
            config.rate_hz,
            SampleFormat.INT32,
            self._converter.volts_per_count,
        )
        behind = (self._sample, self._converter, self._clock)
        if is_foreign:
            emulator: Emulator = emulator_of(protocol)(config.description, config.rate_hz)
            return ForeignFirmware(emulator, hello, ports[0], *behind)
        return Firmware(hello, ports, *behind, self._read_companions)

    def _make_converter(self) -> Converter:
        unloaded = self._skin.voltages([])
        largest_v = max(float(np.max(np.abs(volts))) for volts in unloaded.values())
        noise_v = self.config.noise_v
        return Converter(
            full_scale_v=HEADROOM * largest_v,
            noise_v=NOISE_SHARE * largest_v if noise_v is None else noise_v,
            seed=self.config.seed,
        )

    def _status(self, _: Nothing) -> dict[str, Any]:
        firmware = self._firmware
        return {
            "device_id": firmware.hello.device_id,
            "sensor": self.config.description.name,
            "rate_hz": firmware.rate_hz,
            "counter": firmware.counter,
            "late_scans": firmware.late,
            "noise_v": self._converter.noise_v,
            "volts_per_count": self._converter.volts_per_count,
            "uptime_s": self._clock(),
            "ports": [_describe_port(port) for port in firmware.ports],
        }

    def _scene(self, _: Nothing) -> dict[str, Any]:
        presses = self._indenters_at(self._clock())
        return {
            "presses": [
                {"id": name, **indenter.model_dump(exclude={"id"})}
                for name, indenter in presses.items()
            ]
        }

    def _press(self, arguments: PressArguments) -> None:
        self._check_touches(arguments)
        self._live[arguments.id] = arguments

    def _check_touches(self, arguments: PressArguments) -> None:
        """Refuse a press that lies off the sheet altogether: a slip, and nothing would tell."""
        press, sensor = arguments.press(), self.config.description
        reach_m = max(press.radius_m, press.radius_y_m or 0.0)
        if not sensor.on_sheet(np.array(press.x_m), np.array(press.y_m), -reach_m):
            shape = {"disc": "round, ", "polygon": "a polygon of "}.get(sensor.sheet.shape, "")
            raise CommandError(
                f"x_mm = {arguments.x_mm:g}, y_mm = {arguments.y_mm:g} is off the sheet",
                f"{sensor.name} is {shape}{1e3 * sensor.width_m:g} x "
                f"{1e3 * sensor.height_m:g} mm, and 0, 0 is its middle",
                name="bad_argument",
            )

    def _release(self, arguments: ReleaseArguments) -> dict[str, Any]:
        return {"released": self._live.pop(arguments.id, None) is not None}

    def _clear(self, _: Nothing) -> None:
        self._live.clear()

    def _play(self, arguments: PlayArguments) -> dict[str, Any]:
        self._script = arguments.scene or self._script
        if self._script is None:
            raise CommandError("the twin has no scripted scene", "give one as `scene`")
        self._play_at(self._clock())
        return {"length_s": self._script.length_s}

    def _noise(self, arguments: NoiseArguments) -> None:
        self._converter.noise_v = arguments.noise_v

    def _drift(self, arguments: SkinDriftSettings) -> None:
        self._drifting.drift = arguments.skin_drift(self._drifting.drift)

    def _mute(self, arguments: MuteArguments) -> None:
        channels = self.config.description.channels
        if arguments.channel not in channels:
            raise CommandError(
                f"this skin has no {arguments.channel} channel",
                f"give {' or '.join(channels)}",
                name="bad_argument",
            )
        self._firmware.mute(Channel(arguments.channel), arguments.seconds)

    def _garbage(self, arguments: GarbageArguments) -> None:
        for port in self._some_ports(arguments.port):
            self._firmware.babble(port, arguments.count)

    def _unplug(self, arguments: PortArguments) -> None:
        for port in self._some_ports(arguments.port):
            port.line.unplug()

    def _replug(self, arguments: PortArguments) -> dict[str, Any]:
        for port in self._some_ports(arguments.port):
            port.line.plug()
        return {"ports": list(self.ports)}

    def _some_ports(self, number: int | None) -> Sequence[Port]:
        ports = self._firmware.ports
        if number is None:
            return ports
        if number >= len(ports):
            raise CommandError(f"there is no port {number}", f"the last one is {len(ports) - 1}")
        return [ports[number]]


def _wiring(config: TwinConfig) -> dict[str, tuple[Channel, ...]]:
    channels = config.description.channels
    return {"skin": channels} if config.ports == 1 else {c: (c,) for c in channels}


def _describe_port(port: Port) -> dict[str, Any]:
    line = port.line
    return {
        "name": line.name,
        "path": line.path,
        "channels": list(port.channels),
        "plugged": line.is_plugged,
        "open": line.is_open,
        "streaming": port.is_streaming,
        "sent": line.sent,
        "dropped": line.dropped,
        "unheard": line.unheard,
    }
