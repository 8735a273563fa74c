"""Fuzz the C++ client's decoder by libFuzzer: ``python tests/fuzz/run_cpp.py [FLAGS]``.

It is built by clang++, with sanitizers, and starts from the examples that the Python client's
decoder is fuzzed with. Flags are libFuzzer's.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from builds import SANITIZED
from cpp_client import CPP_FOLDER, STRICT
from fuzz_targets import TARGETS

FUZZER = CPP_FOLDER / "tests" / "fuzz_message.cpp"


def main() -> None:
    """Build it and run it."""
    with tempfile.TemporaryDirectory() as folder:
        program, corpus = Path(folder) / "fuzz_message", Path(folder) / "corpus"
        corpus.mkdir()
        for number, example in enumerate(TARGETS["message"].examples()):
            (corpus / f"example-{number}").write_bytes(example)
        flags = [*STRICT.split(), *SANITIZED.split(), "-fsanitize=fuzzer", "-O1"]
        include = f"-I{CPP_FOLDER / 'include'}"
        command = ["clang++", *flags, include, str(FUZZER), "-o", str(program), "-lzmq"]
        subprocess.run(command, check=True)
        limits = ["-timeout=5", "-rss_limit_mb=2048"]
        sys.exit(subprocess.run([program, *sys.argv[1:], corpus, *limits]).returncode)


if __name__ == "__main__":
    main()
