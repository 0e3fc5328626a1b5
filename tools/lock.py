"""Make requirements.lock: `python -m tools.lock`, every package of constraints.txt with the hashes of its files.

uv takes the hashes from the index, for all platforms and Pythons. Wheels of a folder in $PIP_FIND_LINKS whose
version has a local label (torch==2.13.0+cpu) are not on the index: theirs go into requirements-local.lock.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LOCK, LOCAL = ROOT / "requirements.lock", ROOT / "requirements-local.lock"
HEADER = """# Every package that sgwarp and its extras install, direct and transitive, with the hashes of its files.
# Install: pip install --require-hashes -r requirements.lock, then pip install --no-deps sgwarp. Regenerate: make lock
"""


def main() -> int:
    # constraints.txt is resolved already; nothing is chosen anew.
    options = [
        "--universal",
        "--python-version",
        "3.10",
        "--no-deps",
        "--no-header",
        "--no-annotate",
        "--generate-hashes",
        "--quiet",
    ]
    command = [sys.executable, "-m", "uv", "pip", "compile", *options, "constraints.txt"]
    made = subprocess.run(command, cwd=ROOT, check=False, stdout=subprocess.PIPE, text=True)
    if made.returncode:
        return made.returncode
    LOCK.write_text(HEADER + made.stdout, encoding="utf-8")
    lines = [line for folder in os.environ.get("PIP_FIND_LINKS", "").split() for line in _local(Path(folder))]
    if lines:
        LOCAL.write_text(
            "# Wheels with a local version, which no index has.\n" + "\n".join(lines) + "\n", encoding="utf-8"
        )
    print(f"{LOCK.name}: {len(entries(LOCK))} packages with their hashes")
    return 0


def entries(path: Path) -> dict[tuple[str, str], set[str]]:
    """Hashes of a lock file by (name, version), names in lower case with hyphens."""
    found: dict[tuple[str, str], set[str]] = {}
    if not path.is_file():
        return found
    for block in path.read_text(encoding="utf-8").replace("\\\n", " ").splitlines():
        match = re.match(r"([\w.-]+)==([^\s;]+)", block)
        if match:
            key = (normalized(match[1]), match[2])
            found.setdefault(key, set()).update(re.findall(r"--hash=(sha256:[0-9a-f]{64})", block))
    return found


def normalized(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _local(folder: Path) -> list[str]:
    wheels = sorted(folder.glob("*+*.whl")) if folder.is_dir() else []
    return [
        f"{normalized(wheel.name.split('-')[0])}=={wheel.name.split('-')[1]} "
        f"--hash=sha256:{hashlib.sha256(wheel.read_bytes()).hexdigest()}"
        for wheel in wheels
    ]


if __name__ == "__main__":
    sys.exit(main())
