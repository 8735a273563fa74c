"""The command line's surface: help, usage errors, and that it starts quickly."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import pytest
from tactomo.cli import app
from tactomo.cli.app import DEFAULT_CONTROL, DEFAULT_STREAM, DEFAULT_TWIN_CONTROL, ORDER, Method
from tactomo.config import DaemonConfig
from tactomo_client import messages
from tactomo_models import METHODS
from typer.main import get_command
from typer.testing import CliRunner

Run = Callable[..., Any]

TABLES = {"baseline", "curve", "recording"}
"""Keys of the configuration that hold others, which have flags only where one is often wanted."""


@pytest.mark.parametrize(
    "command",
    [
        *ORDER,
        *("models build", "models draw", "models list"),
        *("evaluate scenes", "evaluate moving", "evaluate tanks", "evaluate skin"),
        "evaluate stability",
    ],
)
def test_every_command_explains_itself(command: str) -> None:
    result = CliRunner().invoke(app, [*command.split(), "--help"], prog_name="tactomo")
    assert result.exit_code == 0
    assert f"Usage: tactomo {command}" in result.output
    if command not in ("models", "models list", "evaluate"):
        assert "Examples" in result.output


def test_nothing_heavy_is_imported_to_show_the_help() -> None:
    heavy = {"numpy", "scipy", "zmq", "pydantic", "aiohttp", "serial", "skfem", "matplotlib"}
    program = f"import sys, tactomo.cli; print(sorted({heavy!r} & set(sys.modules)))"
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert result.stdout.strip() == "[]", result.stderr


def test_without_a_command_it_shows_the_help(tactomo: Run) -> None:
    result = tactomo()
    assert result.returncode == 2
    assert "tactomo demo" in result.stdout + result.stderr


def test_version(tactomo: Run) -> None:
    result = tactomo("--version")
    assert result.returncode == 0
    assert result.stdout.startswith("tactomo 0.")


@pytest.mark.parametrize(
    "arguments",
    [
        ["dance"],
        ["twin", "--ports", "3"],
        ["daemon", "--tier", "best"],
        ["replay"],
        ["record", "stop", "here.mcap"],
        ["record", "start", "--seconds", "3"],
        ["poke", "press", "x_mm"],
        ["import", "in.npz", "out.mcap", "--reference-frames", "20"],
    ],
)
def test_wrong_usage_exits_with_2(tactomo: Run, arguments: list[str]) -> None:
    result = tactomo(*arguments)
    assert result.returncode == 2
    assert result.stdout == ""


def test_the_default_addresses_are_the_clients() -> None:
    assert messages.DEFAULT_STREAM == DEFAULT_STREAM
    assert messages.DEFAULT_CONTROL == DEFAULT_CONTROL
    assert messages.DEFAULT_TWIN_CONTROL == DEFAULT_TWIN_CONTROL


def test_the_methods_are_the_models() -> None:
    assert get_args(Method) == METHODS
    root = Path(__file__).parents[2]
    page = (root / "clients/viewer/tactomo_viewer/page/index.html").read_text("utf-8")
    assert tuple(re.findall(r"<option>(.*?)</option>", page)) == METHODS
    example = (root / "deploy/daemon.example.toml").read_text("utf-8")
    assert all(f'"{method}"' in example for method in METHODS)
    for command in ("reconstruct", "daemon", "tier"):
        shown = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "240"})
        assert all(method in shown.output for method in METHODS)
        if command == "reconstruct":
            assert "noise figure" in " ".join(shown.output.split()), "the rule is stated"


def test_every_key_of_the_configuration_has_a_flag_with_its_default() -> None:
    daemon = get_command(app).commands["daemon"]  # type: ignore[attr-defined]
    flags = {option.opts[0].lstrip("-"): option for option in daemon.params}
    renamed = {"name": "sensor", "ports": "port", "device_ids": "device-id"}
    for key, field in DaemonConfig.model_fields.items():
        if key in TABLES:
            continue
        flag = flags[renamed.get(key, key.replace("_", "-"))]
        # A flag that is not given must not win over the file, so defaults stand in the help.
        assert not flag.default
        if field.default not in (None, False, ()) and not field.is_required():
            shown = f"{field.default:g}" if isinstance(field.default, float) else field.default
            assert f"[{shown}" in flag.help


@pytest.mark.parametrize(
    ("arguments", "status", "says"),
    [
        (["--version"], 0, ""),
        (["info", "nosuchsensor"], 1, "tactomo: cannot read the sensor description nosuchsensor"),
        (["info"], 2, "Missing argument"),
    ],
)
def test_the_exit_status_of_a_process(arguments: list[str], status: int, says: str) -> None:
    command = [sys.executable, "-m", "tactomo.cli", *arguments]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == status
    assert says in result.stderr
    assert "Traceback" not in result.stderr
