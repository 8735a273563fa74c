"""The daemon's configuration: a TOML file, and options that override it.

Every key has a default but `ports`. Errors name the file, the key, its value and what is allowed.
deploy/daemon.example.toml says what each key means (`tactomo service example` prints it), and
deploy/examples/robot.toml has several skins in one file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Field,
    ValidationError,
    model_validator,
)
from pydantic_core import ErrorDetails
from tactomo_client import DEFAULT_CONTROL, DEFAULT_STREAM, MessageError
from tactomo_client.messages import check_sensor_name
from tactomo_models.calibration.calibration_file import data_folder
from tactomo_models.drift.baseline import TIME_CONSTANT_S
from tactomo_models.errors import MethodError, explain
from tactomo_models.methods.registry import find_method
from tactomo_models.toml_file import read_toml

from tactomo.endpoint import (
    check_endpoint,
    check_metrics_address,
    is_local,
    needs_keys,
    next_address,
)
from tactomo.errors import ConfigError, os_errors_as
from tactomo.log import LogFormat, LogLevel
from tactomo.protocols import NATIVE, find_protocol

MAX_PORTS = 2

_Model = TypeVar("_Model", bound=BaseModel)


def _found_by(find: Callable[[str], object]) -> AfterValidator:
    """Refuse a name that leads to nothing, with the reason."""

    def check(name: str) -> str:
        try:
            find(name)
        except (MessageError, MethodError, ConfigError) as error:
            raise ValueError(str(error)) from error
        return name

    return AfterValidator(check)


def _path(path: Any) -> Any:
    if path == "" or "\0" in str(path):
        raise ValueError("give the path of a file or folder, which is not empty and has no NUL")
    return path


FilePath = Annotated[Path, BeforeValidator(_path)]
Endpoint = Annotated[str, AfterValidator(check_endpoint)]
MethodName = Annotated[str, _found_by(find_method)]
ProtocolName = Annotated[str, _found_by(find_protocol)]
DeviceId = Annotated[str, Field(min_length=1, max_length=64)]
MetricsAddress = Annotated[str, AfterValidator(check_metrics_address)]
BudgetMs = Annotated[float, Field(ge=0.01, le=10_000)]


class Curve(BaseModel, extra="forbid", frozen=True):
    """Keys for addresses beyond this computer; `tactomo keys` makes and manages both."""

    secret: FilePath
    clients: FilePath


class RecordingConfig(BaseModel, extra="forbid", frozen=True, allow_inf_nan=False):
    """Where recordings go, how they are cut into files, and which of those are kept."""

    file: FilePath | None = None
    at_start: bool = False
    maps: bool = False
    folder: FilePath | None = None
    rotate_mb: Annotated[float, Field(ge=0.01, le=100_000)] = 256.0
    rotate_minutes: Annotated[float, Field(ge=0.01, le=1440)] = 60.0
    keep_gb: Annotated[float, Field(ge=0)] = 10.0
    keep_days: Annotated[float, Field(ge=0)] = 0.0
    reserve_mb: Annotated[float, Field(ge=0)] = 200.0
    sync_s: Annotated[float, Field(ge=0, le=3600)] = 5.0

    @model_validator(mode="after")
    def _agree(self) -> Self:
        if self.file is not None and self.at_start:
            raise ValueError("file and at_start: give one of them")
        if self.keep_gb and self.keep_gb * 1e3 < 4 * self.rotate_mb:
            raise ValueError("keep_gb has no room for four files of rotate_mb each")
        return self

    @property
    def folder_path(self) -> Path:
        """The folder; by default the service's own or the user's."""
        return (self.folder or data_folder() / "recordings").absolute()


class BaselineConfig(BaseModel, extra="forbid", frozen=True, allow_inf_nan=False):
    """Whether and how fast the reference follows a skin's drift while nothing presses."""

    track: bool = True
    time_constant_s: Annotated[float, Field(ge=5, le=3600)] = TIME_CONSTANT_S


class DaemonConfig(BaseModel, extra="forbid", frozen=True, allow_inf_nan=False):
    """What one daemon serves: one sensor, read over one port or two."""

    name: Annotated[str, _found_by(check_sensor_name)] = "skin"
    description: Annotated[str, BeforeValidator(_path)] = "paper_square"
    calibration: FilePath | None = None
    ports: Annotated[tuple[str, ...], Field(min_length=1, max_length=MAX_PORTS)]
    device_ids: tuple[DeviceId, ...] = ()
    wait_for_ports: bool = False
    protocol: ProtocolName = NATIVE
    baud: Annotated[int, Field(ge=1200, le=12_000_000)] | None = None
    stream: Endpoint = DEFAULT_STREAM
    control: Endpoint = DEFAULT_CONTROL
    curve: Curve | None = None
    method: MethodName = "auto"
    budget_ms: BudgetMs | None = None
    tare_scans: Annotated[int, Field(ge=2, le=10_000)] = 20
    sync_wait_ms: Annotated[float, Field(ge=0, le=1000)] = 30.0
    lossless: bool = False
    baseline: BaselineConfig = BaselineConfig()
    recording: RecordingConfig = RecordingConfig()
    metrics: MetricsAddress | None = None
    exit_at_end: bool = False
    log_level: LogLevel = "info"
    log_format: LogFormat = "auto"

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if len(set(self.ports)) != len(self.ports):
            raise ValueError("ports: the two ports are the same one")
        if self.protocol != NATIVE and len(self.ports) > 1:
            raise ValueError(f"ports: a device of protocol {self.protocol} has one port; give one")
        if self.stream == self.control and not self.stream.endswith(":0"):
            raise ValueError("stream and control have the same address")
        for key in ("stream", "control"):
            if self.curve is None and not is_local(getattr(self, key)):
                error = needs_keys(getattr(self, key))
                raise ValueError(f"{key} = {error.cause}; {error.next_step}")
        return self


class Robot(BaseModel):
    """Several skins of one computer, as their file has them: each in a table ``[skins.NAME]``."""

    skins: Annotated[dict[str, dict[str, Any]], Field(min_length=1)]


def load_config(path: str | Path | None = None, **overrides: Any) -> DaemonConfig:
    """Read a configuration file, None for defaults alone, and apply options to it.

    An override wins over the file; None means "not given". A key of a table is written with a dot:
    ``recording.file``. Raises ConfigError where the file cannot be read or is not TOML, or a key is
    unknown, missing or out of range.
    """
    given = {key: value for key, value in overrides.items() if value is not None}
    values = {} if path is None else _read_toml(Path(path))
    return _checked(DaemonConfig, values, given, path)


def load_skins(path: Path | None, **overrides: Any) -> tuple[DaemonConfig, ...] | DaemonConfig:
    """Read a file that may describe several skins, and apply options to each.

    A key outside the tables ``[skins.NAME]`` is every skin's. A skin without addresses gets the
    default ones, the n-th skin ``20 n`` TCP ports further. Where `name` is overridden, that skin
    alone is meant.

    Raises ConfigError as `load_config` does, or where two skins share what each needs for itself.
    """
    values = {} if path is None else _read_toml(path)
    if path is None or "skins" not in values:
        return load_config(path, **overrides)
    given = {key: value for key, value in overrides.items() if value is not None}
    robot = _checked(Robot, values, {}, path)
    common = {key: value for key, value in values.items() if key not in Robot.model_fields}
    only = given.pop("name", None)
    if only not in (None, *robot.skins):
        known = ", ".join(robot.skins)
        raise ConfigError(f"{path} has no skin {only!r}", f"use one of: {known}")
    skins = [
        _checked(
            DaemonConfig,
            {
                "stream": next_address(DEFAULT_STREAM, number),
                "control": next_address(DEFAULT_CONTROL, number),
                **_merged(common, table),
                "name": name,
            },
            given,
            f"{path}, [skins.{name}]",
        )
        for number, (name, table) in enumerate(robot.skins.items())
        if only in (None, name)
    ]
    if only is not None:
        return skins[0]
    _check_apart(path, skins)
    return tuple(skins)


def _merged(common: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of all skins with one skin's in their places, tables key by key."""
    tables = {
        key: {**common[key], **value}
        for key, value in own.items()
        if isinstance(value, dict) and isinstance(common.get(key), dict)
    }
    return {**common, **own, **tables}


def _check_apart(path: Path, skins: Sequence[DaemonConfig]) -> None:
    owners: dict[str, str] = {}
    for skin in skins:
        for own in (*skin.ports, skin.stream, skin.control, skin.metrics, skin.recording.file):
            if own is None or str(own).endswith(":0"):
                continue
            if str(own) in owners:
                raise ConfigError(
                    f"{path}: {owners[str(own)]} and {skin.name} both have {str(own)!r}",
                    f"give each its own, below [skins.{skin.name}]",
                )
            owners[str(own)] = skin.name


def _checked(
    model: type[_Model],
    values: Mapping[str, Any],
    given: Mapping[str, Any],
    source: str | Path | None,
) -> _Model:
    try:
        return model.model_validate(_override(values, given))
    except ValidationError as error:
        issues = [f"{_source(item, source, given)}: {explain(item)}" for item in error.errors()]
        raise ConfigError("\n".join(issues), _known_keys(error.errors())) from error


def _known_keys(items: Sequence[ErrorDetails]) -> str:
    """Return the keys that there are where one is unknown or missing; both ways to give ports."""
    if [(item["type"], item["loc"]) for item in items] == [("missing", ("ports",))]:
        return (
            "give --port /dev/ttyACM0, twice for two boards (`tactomo ports` shows those that are "
            'there), or a configuration file with ports = ["/dev/ttyACM0"]'
        )
    tables: dict[str, type[BaseModel]] = {
        "baseline": BaselineConfig,
        "recording": RecordingConfig,
        "curve": Curve,
    }
    for item in items:
        if item["type"] in ("extra_forbidden", "missing"):
            name = str(item["loc"][0]) if len(item["loc"]) > 1 else ""
            return f"known keys: {', '.join(tables.get(name, DaemonConfig).model_fields)}"
    return "`tactomo service example` shows every key"


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        with os_errors_as(ConfigError, f"cannot read {path}", "give the path of a TOML file"):
            return read_toml(path)
    except ValueError as error:
        raise ConfigError(
            f"{path} is not valid TOML: {error}", "compare it with `tactomo service example`"
        ) from error


def _override(values: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the file's values with those of the options in their places."""
    merged = dict(values)
    for path, value in given.items():
        table, _, key = path.rpartition(".")
        if not table:
            merged[key] = value
        elif isinstance(merged.setdefault(table, {}), dict):  # else the table is an error
            merged[table] = {**merged[table], key: value}
    return merged


def _source(item: ErrorDetails, path: str | Path | None, given: Mapping[str, Any]) -> str:
    loc = [str(part) for part in item["loc"]]
    is_given = any(".".join(loc[:depth]) in given for depth in (1, 2))
    return "command line" if path is None or is_given else str(path)
