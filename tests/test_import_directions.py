"""Who may import whom: distributions, the folders in each, and no circle of modules.

Every import statement counts: those inside functions and those for the type checker alone, too.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "tactomo_protocol": ROOT / "firmware_protocol/python/tactomo_protocol",
    "tactomo_client": ROOT / "clients/python/tactomo_client",
    "tactomo_models": ROOT / "models/tactomo_models",
    "tactomo_viewer": ROOT / "clients/viewer/tactomo_viewer",
    "tactomo_foxglove": ROOT / "clients/foxglove/tactomo_foxglove",
    "tactomo_ros2": ROOT / "clients/ros2/tactomo_ros2",
    "lerobot_camera_tactomo": ROOT / "clients/lerobot/lerobot_camera_tactomo",
    "tactomo": ROOT / "daemon/tactomo",
    "tactomo_lab": ROOT / "models/tactomo_lab",
}
# The packages of ours that each may import.
ALLOWED: dict[str, set[str]] = {
    "tactomo_protocol": set(),
    "tactomo_client": set(),
    "tactomo_models": {"tactomo_protocol"},
    "tactomo_viewer": {"tactomo_client"},
    "tactomo_foxglove": {"tactomo_client"},
    "tactomo_ros2": {"tactomo_client"},
    "lerobot_camera_tactomo": {"tactomo_client"},
    "tactomo": {
        *("tactomo_protocol", "tactomo_client", "tactomo_models"),
        *("tactomo_viewer", "tactomo_foxglove", "tactomo_ros2"),
    },
    "tactomo_lab": {"tactomo_protocol", "tactomo_models", "tactomo"},
}
# Folders, and modules beside them, of each package: each imports those before it alone.
ORDER = {
    "tactomo_models": (
        *(
            "errors",
            "arrays",
            "foreign_file",
            "matlab_file",
            "array_files",
            "archive",
            "growing_arrays",
            "toml_file",
            "robust",
            "inner_loop",
        ),
        *("sensor", "imported", "physics", "scans", "scene", "methods", "simulation"),
        *("calibration", "health", "frames", "reconstruct", "batch", "drift"),
        *("commissioning", "simulators"),
    ),
    "tactomo": (
        *("errors", "plain", "log", "timing", "events", "endpoint", "scans", "worker"),
        *("ending", "memory", "running"),
        *("protocols", "config", "recordings", "acquisition", "stream", "imaging"),
        *("service", "twin", "cli", "__main__"),
    ),
    "tactomo_lab": ("scenes", "baselines", "tanks", "training", "evaluation", "commands"),
}
# What a package must do without, but for the modules whose names begin so.
FOREIGN = {
    "torch": ("tactomo_lab.training.",),
    "onnx": ("tactomo_lab.training.",),
    "mujoco": ("tactomo_models.simulators.mujoco_skin.",),
    "ezdxf": ("tactomo_models.imported.",),
    "svgelements": ("tactomo_models.imported.",),
    "h5py": ("tactomo_models.matlab_file",),
    "serial": ("tactomo.",),
    "zmq": ("tactomo.", "tactomo_client.", "tactomo_foxglove."),
}


def modules() -> dict[str, Path]:
    """Every module of ours by name; a package's own file under the package's name."""
    found = {}
    for package, folder in PACKAGES.items():
        for path in folder.rglob("*.py"):
            parts = (package, *path.relative_to(folder).with_suffix("").parts)
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def imports() -> Mapping[str, frozenset[str]]:
    """What each module of ours imports: modules, ours and others'."""
    known = modules()
    return {name: frozenset(_imported(name, known)) for name in known}


def _imported(name: str, known: Mapping[str, Path]) -> Iterator[str]:
    path = known[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level < 2, f"{path}: no more than one dot"
            source = node.module or ""
            if node.level:
                source = f"{package}.{source}".rstrip(".")
            for alias in node.names:
                whole = f"{source}.{alias.name}"
                yield whole if whole in known else source


def edges() -> Iterator[tuple[str, str]]:
    """Every import of one module of ours by another."""
    for name, imported in sorted(imports().items()):
        for other in sorted(imported):
            if other.partition(".")[0] in PACKAGES:
                yield name, other


def part(module: str) -> str:
    """The folder of a package, or the module beside folders, that a module is in."""
    return [*module.split("."), ""][1]


@pytest.mark.slow
def test_packages_import_those_that_they_may() -> None:
    wrong = [
        f"{name} imports {other}"
        for name, other in edges()
        if (own := name.partition(".")[0]) != (of := other.partition(".")[0])
        and of not in ALLOWED[own]
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("package", ORDER)
def test_folders_import_those_before_them(package: str) -> None:
    order = ORDER[package]
    own = {part(name) for name in modules() if name.startswith(f"{package}.")}
    assert own <= set(order), "give these a place in the order"
    wrong = [
        f"{name} imports {other}"
        for name, other in edges()
        if name.startswith(f"{package}.")
        and other.partition(".")[0] == package
        and part(name) != part(other)
        and (not part(other) or order.index(part(other)) > order.index(part(name)))
    ]
    assert not wrong, "\n".join(wrong)


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph: dict[str, set[str]] = {name: set() for name in imports()}
    for name, other in edges():
        graph[name].add(other)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


@pytest.mark.parametrize("foreign", FOREIGN)
def test_what_few_parts_may_import(foreign: str) -> None:
    wrong = [
        name
        for name, imported in imports().items()
        if any(other.partition(".")[0] == foreign for other in imported)
        and not f"{name}.".startswith(FOREIGN[foreign])
    ]
    assert not wrong, f"{foreign} is imported by {', '.join(wrong)}"
