"""`make wheels`: what pip installs from them, without the checkout, into environments of its own.

Without a network: an environment is given those installed packages that a wheel requires, and
theirs in turn, and no other. `pip check` says whether that is all.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import Distribution, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from page import first_line_of_the_readme
from whole_system import repository, running_demo

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]  # compresses 60 MB, and builds a model

BIN = Path(sys.executable).parent
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Each distribution's wheel, by its name."""
    folder = tmp_path_factory.mktemp("dist")
    ready = ("-o", ".venv/.ready-run")  # this environment is the one that builds
    at = ("-C", repository(), *ready, f"DIST={folder}", f"BIN={BIN}")
    run("make", "wheels", *at, folder=folder)
    assert len(list(folder.glob("*.tar.gz"))) == len(list(folder.glob("*.whl")))
    return {path.name.partition("-")[0]: path for path in folder.glob("*.whl")}


def run(*command: str | Path, folder: Path) -> str:
    """Run a program of another environment in a folder that is its home, too."""
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(folder), "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def installed(folder: Path, *wheels: Path) -> Path:
    """Return the programs' folder of a new environment with these wheels."""
    run(sys.executable, "-m", "venv", "--without-pip", folder, folder=folder.parent)
    python = folder / "bin" / "python"
    run(*PIP, "--python", python, "install", "--no-index", "--no-deps", *wheels, folder=folder)
    (packages,) = folder.glob("lib/python*/site-packages")
    ours = {path.name.partition("-")[0].replace("_", "-") for path in wheels}
    for info in list(packages.glob("tactomo*.dist-info")):
        link_requirements(Distribution.at(info), packages, ours)
    run(*PIP, "--python", python, "check", folder=folder)
    return folder / "bin"


def link_requirements(of: Distribution, packages: Path, found: set[str]) -> None:
    """Link into `packages` what a distribution requires; `found` names what is there already."""
    for requirement in map(Requirement, of.requires or ()):
        is_wanted = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if not is_wanted or requirement.name in found:
            continue
        found.add(requirement.name)
        other = distribution(requirement.name)
        for top in {file.parts[0] for file in other.files or ()} - {"..", "__pycache__"}:
            link = packages / top
            if not link.exists():
                link.symlink_to(Path(str(other.locate_file(top))))
        link_requirements(other, packages, found)


@pytest.fixture(scope="module")
def robot(wheels: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Programs of an environment in which `pip install tactomo` was run."""
    folder = tmp_path_factory.mktemp("robot")
    return installed(folder / "env", wheels["tactomo"], wheels["tactomo_client"])


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to be in, nothing of which leads to the checkout."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("XDG_CACHE_HOME", "XDG_DATA_HOME", "PYTHONPATH"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


def test_each_wheel_carries_its_licence(wheels: dict[str, Path]) -> None:
    assert wheels.keys() >= {"tactomo", "tactomo_client", "tactomo_lab"}
    for path in wheels.values():
        assert [name for name in zipfile.ZipFile(path).namelist() if name.endswith("/LICENSE")]


def test_each_package_is_in_the_wheel(wheels: dict[str, Path]) -> None:
    project = tomllib.loads((repository() / "pyproject.toml").read_text("utf-8"))
    packages = project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    names = zipfile.ZipFile(wheels["tactomo"]).namelist()
    assert {path.rpartition("/")[2] for path in packages} == {
        name.partition("/")[0] for name in names if ".dist-info/" not in name
    }


def test_the_demo_is_read_by_an_environment_of_the_client_alone(
    wheels: dict[str, Path], robot: Path, home: Path
) -> None:
    controller = installed(home / "env", wheels["tactomo_client"])
    with running_demo("--scene", "two_fingers_merge", program=[robot / "tactomo"]) as demo:
        line = first_line_of_the_readme(demo, home, python=controller / "python")
    assert "kPa" in line


def test_the_version_names_the_commit_that_was_built(robot: Path, home: Path) -> None:
    describe = ("git", "-C", repository(), "describe", "--always", "--dirty", "--abbrev=12")
    commit = subprocess.run(describe, capture_output=True, text=True, check=True).stdout.strip()
    version = run(robot / "tactomo", "--version", folder=home)
    assert version.endswith(f" (commit {commit})\n")


def test_the_bill_of_materials_names_each_requirement(wheels: dict[str, Path]) -> None:
    bill = json.loads(wheels["tactomo"].with_name("sbom.json").read_text("utf-8"))
    parts = {part["name"]: part for part in bill["components"]}
    project = tomllib.loads((repository() / "pyproject.toml").read_text("utf-8"))["project"]
    required = {Requirement(line).name for line in project["dependencies"]} - {"tactomo-client"}
    assert required <= parts.keys()
    assert all(part["hashes"] for part in parts.values())


def test_what_the_service_needs_is_there(robot: Path, home: Path) -> None:
    assert "[baseline]" in run(robot / "tactomo", "service", "example", folder=home)
    plan = ("service", "install", "left", "--port", "/dev/ttyUSB0", "--dry-run")
    assert "ExecStart=" in run(robot / "tactomo", *plan, folder=home)


def test_the_laboratory_evaluates(wheels: dict[str, Path], home: Path) -> None:
    ours = ("tactomo", "tactomo_client", "tactomo_lab")
    tactomo = installed(home / "env", *(wheels[name] for name in ours)) / "tactomo"
    scenes = ("evaluate", "field", "--rows", "ordinary", "--count", "1")
    assert "cnn-single" in run(tactomo, *scenes, "--method", "cnn-single", folder=home)
