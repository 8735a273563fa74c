"""The C++ client's README, followed to the letter by a newcomer with an empty home."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from cpp_client import CPP_FOLDER, need_headers
from needs import need
from page import Page
from tactomo.stream import keys as key_files
from tactomo_client import Contact
from tactomo_client.fake import FakeSensor
from waiting import repeated

README = Page("clients/cpp/README.md")
ROOT = Path(__file__).parents[2]
CONTACT = Contact(7, 10.0, -5.0, 700.0, 0.2, 0.01, 183.0)
STRICT = "-Wall -Wextra -Wpedantic -Wconversion -Wshadow -Werror"
BUILD_S = 300.0

pytestmark = pytest.mark.timeout(600)  # compilers are slow where others work, too


@pytest.fixture(scope="module")
def pressed() -> Iterator[str]:
    """Where a sensor of the README's name is pressed all the time."""
    with FakeSensor("skin") as sensor, repeated(lambda: sensor.publish([CONTACT]), 0.02):
        yield sensor.address


class Checkout:
    """A checkout, and commands run in it with an empty home."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "tactomo"
        (self.folder / "clients").mkdir(parents=True)
        shutil.copytree(CPP_FOLDER, self.folder / "clients" / "cpp")
        self._environment = {
            **os.environ,
            "HOME": str(folder),
            "CXXFLAGS": STRICT,
            "CMAKE_BUILD_PARALLEL_LEVEL": "2",
        }

    def run(self, command: str) -> str:
        """Run a command of the README in the checkout, with which all is well."""
        done = subprocess.run(
            ["bash", "-ec", command],
            cwd=self.folder,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=BUILD_S,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        return done.stdout


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Checkout:
    need_headers()
    need("cmake", "pkg-config")
    return Checkout(tmp_path_factory.mktemp("home"))


@pytest.mark.slow
def test_from_nothing_to_a_running_controller(checkout: Checkout, pressed: str) -> None:
    """Every command but `apt`, in order; only the address is another one."""
    (checkout.folder / "robot").mkdir()
    for name in ("robot/CMakeLists.txt", "robot/robot.cpp"):
        (checkout.folder / name).write_text(README.file(name))
    said = {}
    exported = ""
    for command in README.commands():
        if command.startswith("sudo apt "):
            continue
        if command.startswith("export "):
            exported = f"{command}\n"
        elif command.startswith("build/controller"):
            said["controller"] = checkout.run(f"{command} --stream {pressed}")
        elif command == "robot/build/robot":
            said["robot"] = checkout.run(f"{command} {pressed}")
        else:
            checkout.run(exported + command)
    assert "retreat: pressed hard\n" in said["controller"]
    assert "5000 turns" in said["controller"]
    for seconds in ("soon", "-3", "nan", "5x", "1e99"):
        refused = checkout.run(f"! build/controller skin --seconds {seconds} 2>&1")
        assert refused.startswith("usage: "), seconds
    assert re.search(
        r"latest\(\): p50 [\d.]+ us, p99 [\d.]+ us, worst [\d.]+ us\n", said["controller"]
    )
    assert "7 at (10.0, -5.0) mm, 183 kPa\n" in said["robot"]
    by_pkg_config = checkout.run(f"robot/robot {pressed}")
    assert "7 at (10.0, -5.0) mm, 183 kPa\n" in by_pkg_config


@pytest.mark.slow
def test_the_controller_says_what_keys_are_wrong(
    checkout: Checkout, pressed: str, tmp_path: Path
) -> None:
    checkout.run("cmake -S clients/cpp -B build && cmake --build build")
    for name in ("desk", "robot"):
        key_files.make_pair(tmp_path, name)
    key_files.secret_path(tmp_path, "robot").unlink()
    said = checkout.run(f"build/controller skin --seconds 3 --stream {pressed} --keys {tmp_path}")
    assert "stop: not the server of that public key\n" in said


HERE = "add_subdirectory({source} tactomo)"
FETCHED = """include(FetchContent)
FetchContent_Declare(tactomo SOURCE_DIR {root} SOURCE_SUBDIR clients/cpp)
FetchContent_MakeAvailable(tactomo)"""


@pytest.mark.long
@pytest.mark.parametrize("way", [HERE, FETCHED], ids=["add_subdirectory", "FetchContent"])
def test_without_an_installation(checkout: Checkout, way: str, pressed: str) -> None:
    folder = checkout.folder.parent / "other"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    lists = README.file("robot/CMakeLists.txt")
    found = "find_package(tactomo 0.1 CONFIG REQUIRED)"
    assert found in lists
    places = {"source": checkout.folder / "clients" / "cpp", "root": checkout.folder}
    (folder / "CMakeLists.txt").write_text(lists.replace(found, way.format(**places)))
    (folder / "robot.cpp").write_text(README.file("robot/robot.cpp"))
    checkout.run(f"cmake -S {folder} -B {folder}/build && cmake --build {folder}/build")
    assert not list(folder.rglob("controller"))
    assert "7 at (10.0, -5.0) mm" in checkout.run(f"{folder}/build/robot {pressed}")


def test_a_missing_library_is_named(checkout: Checkout, tmp_path: Path) -> None:
    checkout.run(f"cmake -S clients/cpp -B {tmp_path} -DTACTOMO_EXAMPLES=OFF")
    checkout.run(f"cmake --install {tmp_path} --prefix {tmp_path}/prefix")
    (tmp_path / "CMakeLists.txt").write_text(README.file("robot/CMakeLists.txt"))
    (tmp_path / "robot.cpp").write_text("")
    command = ["cmake", "-S", tmp_path, "-B", tmp_path / "b", "-DTACTOMO_MSGPACK_INCLUDE=NOTFOUND"]
    command += [f"-DCMAKE_PREFIX_PATH={tmp_path}/prefix", "-DCMAKE_FIND_ROOT_PATH=/nowhere"]
    command += ["-DCMAKE_FIND_ROOT_PATH_MODE_INCLUDE=ONLY"]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=BUILD_S)
    assert done.returncode != 0
    assert "apt install cppzmq-dev libmsgpack-dev" in " ".join(done.stderr.split())


def test_its_version_is_the_python_clients() -> None:
    python = (ROOT / "clients" / "python" / "pyproject.toml").read_text()
    version = re.search(r'^version = "(.*)"', python, re.M)
    assert version
    assert f"project(tactomo VERSION {version[1]} " in (CPP_FOLDER / "CMakeLists.txt").read_text()


@pytest.mark.slow
def test_the_other_examples_compile(tmp_path: Path) -> None:
    """Commands, and keys: not run, for they would be sent to whoever listens."""
    need_headers()
    blocks = [block for block in README.blocks("cpp") if "main(" not in block]
    assert len(blocks) == 2
    functions = [f"void example_{i}() {{\n{block}}}\n" for i, block in enumerate(blocks)]
    source = tmp_path / "examples.cpp"
    source.write_text("#include <tactomo/client.hpp>\n#include <cstdio>\n" + "".join(functions))
    command = ["c++", "-std=c++17", "-fsyntax-only", *STRICT.split(), "-Wno-unused-variable"]
    command += [f"-I{CPP_FOLDER / 'include'}", str(source)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=BUILD_S)
    assert done.returncode == 0, done.stderr
