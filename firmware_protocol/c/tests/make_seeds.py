"""Write the shared test vectors as files of bytes, for fuzzers to start from."""

import json
import sys
from pathlib import Path

VECTORS = Path(__file__).parents[2] / "vectors"


def main(folder: Path) -> None:
    """Write one file for each frame and each stream."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("packets.json", "streams.json"):
        for vector in json.loads((VECTORS / name).read_text("utf-8"))["vectors"]:
            said = bytes.fromhex(vector.get("stream", vector.get("frame")))
            (folder / vector["name"]).write_bytes(said)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
