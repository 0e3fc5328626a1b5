"""Install the checkout and its extras from files whose hashes are known: `python -m tools.install test,ptx`.

pip says which versions it would take under constraints.txt; those are then installed with --require-hashes from
requirements.lock, and the checkout itself, which has no hash, without dependencies.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from tools.lock import LOCAL, LOCK, ROOT, entries, normalized

PIP = (sys.executable, "-m", "pip", "install", "--disable-pip-version-check", "--quiet")


def main(extras: str) -> int:
    requirement = f"{ROOT}[{extras}]" if extras else str(ROOT)
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        wanted = ("--dry-run", "--report", str(report), "-c", str(ROOT / "constraints.txt"))
        subprocess.run([*PIP, *wanted, requirement], check=True)
        chosen = json.loads(report.read_text(encoding="utf-8"))["install"]
        names = [(normalized(item["metadata"]["name"]), item["metadata"]["version"]) for item in chosen]
        known = entries(LOCK) | entries(LOCAL)
        packages = [key for key in names if key[0] != "sgwarp"]
        missing = [f"{name}=={version}" for name, version in packages if not known.get((name, version))]
        if missing:
            print(f"requirements.lock: has no hashes of {', '.join(missing)}; run make lock", file=sys.stderr)
            return 1
        lines = [
            f"{name}=={version} {' '.join(f'--hash={h}' for h in sorted(known[name, version]))}"
            for name, version in packages
        ]
        listed = Path(folder) / "requirements.txt"
        listed.write_text("\n".join(lines) + "\n", encoding="utf-8")
        if lines:
            subprocess.run([*PIP, "--require-hashes", "--no-deps", "-r", str(listed)], check=True)
    subprocess.run([*PIP, "--no-deps", "-e", str(ROOT)], check=True)
    print(f"{len(packages)} packages, all with the hashes of requirements.lock")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else ""))
