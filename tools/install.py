"""Install the checkout and its extras from files whose hashes are known: `python -m tools.install test,ptx`.

pip says which versions it would take under constraints.txt, of wheels alone: nothing of a package runs before its hash
was compared. Those are then installed with --require-hashes from requirements.lock. So is what builds the checkout,
which has no hash and comes last, without dependencies.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

from tools.lock import LOCAL, LOCK, ROOT, entries, normalized

PIP = (sys.executable, "-m", "pip", "install", "--disable-pip-version-check", "--quiet")
WHEELS = ("--only-binary", ":all:")
BUILD = ("hatchling", "editables")


def main(extras: str) -> int:
    """Returns the exit code; 1 if a package has no hash."""
    wanted = requirements(filter(None, extras.split(",")))
    try:
        count = _install(BUILD) + _install(wanted)
    except LookupError as error:
        print(f"{LOCK.name}: has no hashes of {error.args[0]}; run make lock", file=sys.stderr)
        return 1
    subprocess.run([*PIP, "--no-deps", "--no-build-isolation", "-e", str(ROOT)], check=True)
    print(f"{count} packages, all with the hashes of {LOCK.name}")
    return 0


def requirements(extras: Iterable[str]) -> list[str]:
    """What pyproject.toml asks for: the dependencies and those of the extras, extras within extras resolved.

    Raises:
        KeyError: There is no such extra.
    """
    project = _pyproject()["project"]
    found, waiting, seen = list(project["dependencies"]), list(extras), set[str]()
    while waiting:
        extra = waiting.pop()
        if extra in seen:
            continue
        seen.add(extra)
        for text in project["optional-dependencies"][extra]:
            own = re.fullmatch(r"sgwarp\[(.*)\]", text)
            waiting += own[1].split(",") if own else []
            found += [] if own else [text]
    return sorted(set(found))


def _pyproject() -> dict:
    try:
        import tomllib
    except ImportError:  # Python 3.10
        from pip._vendor import tomli as tomllib  # type: ignore[no-redef]
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def _install(wanted: Iterable[str]) -> int:
    """Install requirements and what they need; returns how many packages that are."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        options = ("--dry-run", "--report", str(report), "-c", str(ROOT / "constraints.txt"))
        subprocess.run([*PIP, *WHEELS, *options, *wanted], check=True)
        chosen = json.loads(report.read_text(encoding="utf-8"))["install"]
    names = [(normalized(item["metadata"]["name"]), item["metadata"]["version"]) for item in chosen]
    return _install_hashed(names)


def _install_hashed(packages: list[tuple[str, str]]) -> int:
    """Install (name, version) from wheels that have one of the known hashes.

    Raises:
        LookupError: Of these, no hash is known.
    """
    known = entries(LOCK) | entries(LOCAL)
    if missing := [f"{name}=={version}" for name, version in packages if not known.get((name, version))]:
        raise LookupError(", ".join(missing))
    if not packages:
        return 0
    with tempfile.TemporaryDirectory() as folder:
        listed = Path(folder) / "requirements.txt"
        hashes = {key: " ".join(f"--hash={value}" for value in sorted(known[key])) for key in packages}
        lines = [f"{name}=={version} {hashes[name, version]}\n" for name, version in packages]
        listed.write_text("".join(lines), encoding="utf-8")
        subprocess.run([*PIP, *WHEELS, "--require-hashes", "--no-deps", "-r", str(listed)], check=True)
    return len(packages)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else ""))
