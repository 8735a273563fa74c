"""The C++ client: built as its users build it, and run as programs that speak JSON lines."""

from __future__ import annotations

import json
import queue
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

from builds import BUILD_S, build_folder
from needs import lacking, need

CPP_FOLDER: Final = Path(__file__).parents[2] / "clients" / "cpp"
PROBE: Final = CPP_FOLDER / "tests" / "probe.cpp"
STRICT: Final = "-std=c++17 -Wall -Wextra -Wpedantic -Wconversion -Wshadow -Werror"
PACKAGES: Final = "apt install g++ cmake pkg-config cppzmq-dev libmsgpack-dev"
PATIENCE_S: Final = 60.0


def need_headers() -> None:
    """Skip the test where a compiler or the libraries' headers are missing."""
    need("c++")
    for header in ("zmq.hpp", "msgpack.hpp"):
        command = ["c++", "-std=c++17", "-DMSGPACK_NO_BOOST", "-x", "c++", "-M", "-"]
        source = f"#include <{header}>\n"
        if subprocess.run(command, input=source, capture_output=True, text=True).returncode:
            lacking(f"needs {header}: {PACKAGES}")


def compile_probe(compiler: str, flags: str) -> Path:
    """Build clients/cpp/tests/probe.cpp once a run, without a warning."""
    with build_folder(compiler, flags) as folder:
        program, built = folder / "probe", folder / "building"
        if not program.exists():
            command = [compiler, *STRICT.split(), *flags.split(), f"-I{CPP_FOLDER / 'include'}"]
            command += [str(PROBE), "-o", str(built), "-lzmq"]
            done = subprocess.run(command, capture_output=True, text=True, timeout=BUILD_S)
            assert done.returncode == 0, done.stderr
            built.rename(program)
    return program


def run(*command: object) -> str:
    """Run a program that succeeds, and return what it printed."""
    done = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def decode(program: Path, sensor: str, kind: str, messages: Iterable[bytes]) -> list[Any]:
    """Return what the client makes of each message; ``{"problem": ...}`` where it is no frame."""
    framed = b"".join(struct.pack("<I", len(message)) + message for message in messages)
    done = subprocess.run(
        [program, "decode", sensor, kind], input=framed, capture_output=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr.decode("utf-8", "replace")[-4000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


class Watch:
    """`probe watch`: what it says, as it says it. Use it in a `with` block."""

    def __init__(
        self, program: Path, sensor: str, address: str, kind: str, keys: object = ""
    ) -> None:
        command = [str(program), "watch", sensor, address, kind, str(keys)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self._said: queue.Queue[dict[str, Any]] = queue.Queue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def __enter__(self) -> Watch:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.poll() is None, f"it ended: {self._process.returncode}"
        self._process.kill()
        self._process.wait()
        self._reader.join()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def wait(self, condition: Callable[[dict[str, Any]], Any], what: str) -> dict[str, Any]:
        """Return the next thing said for which the condition holds."""
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                said = self._said.get(timeout=max(0.0, deadline_s - time.monotonic()))
            except queue.Empty:
                raise AssertionError(f"waited in vain for {what}") from None
            if condition(said):
                return said

    def frames(self, count: int) -> list[dict[str, Any]]:
        """Return the next so many frames."""
        return [self.wait(lambda said: said["frame"], "a frame")["frame"] for _ in range(count)]

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._said.put(json.loads(line))
