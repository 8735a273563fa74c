"""Fuzz one parser by libFuzzer, led by coverage: ``python tests/fuzz/run.py TARGET [FLAGS]``.

``list`` in place of a target names all of them. Flags are libFuzzer's, such as
``-max_total_time=300``. What breaks the parser is left in ``crash-...`` in the current folder;
give that file as the only flag to see it again. Needs atheris.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import atheris

PACKAGES = ["tactomo", "tactomo_client", "tactomo_models", "tactomo_protocol", "mcap", "tomllib"]
SUPPORT = Path(__file__).parents[1] / "support"


def main() -> None:
    """Fuzz the target that the command line names."""
    sys.path.insert(0, str(SUPPORT))
    with atheris.instrument_imports(include=PACKAGES):
        from fuzz_targets import TARGETS
    if sys.argv[1:] == ["list"]:
        print(*TARGETS)
        return
    if len(sys.argv) < 2 or sys.argv[1] not in TARGETS:
        sys.exit(f"usage: run.py {'|'.join(TARGETS)} [FLAGS]")
    target = TARGETS[sys.argv.pop(1)]

    def parse(data: bytes) -> None:
        target.parse(data)

    with tempfile.TemporaryDirectory() as corpus:
        for number, example in enumerate(target.examples()):
            (Path(corpus) / f"example-{number}").write_bytes(example)
        atheris.Setup([*sys.argv, corpus, "-timeout=5", "-rss_limit_mb=2048"], parse)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
