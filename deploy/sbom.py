"""Write what tactomo installs on a robot as a CycloneDX 1.5 bill of materials, from a lock file.

    python deploy/sbom.py requirements-run.lock VERSION > dist/sbom.json

Each component has the hashes of its wheels and source archives, as pip checks them.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

LINE = re.compile(
    r"^([A-Za-z0-9._-]+)==([^ ;\\]+)[^\n]*\n((?: +--hash=sha256:[0-9a-f]{64}[^\n]*\n)*)", re.M
)


def bill_of_materials(lock: str, version: str) -> dict[str, Any]:
    """Return the bill of materials of a lock file's text."""
    components = [
        {
            "type": "library",
            "name": name,
            "version": of,
            "purl": f"pkg:pypi/{name.lower()}@{of}",
            "hashes": [
                {"alg": "SHA-256", "content": content}
                for content in re.findall(r"sha256:([0-9a-f]{64})", hashes)
            ],
        }
        for name, of, hashes in LINE.findall(lock)
    ]
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": {"type": "application", "name": "tactomo", "version": version}},
        "components": components,
    }


if __name__ == "__main__":
    path, released = sys.argv[1:]
    print(json.dumps(bill_of_materials(Path(path).read_text("utf-8"), released), indent=2))
