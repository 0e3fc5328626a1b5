"""The software bill of materials: `python -m tools.bill [--out sgwarp.cdx.json]`.

What sgwarp and its extras need, as installed here, in CycloneDX 1.5; and a table of licenses, copyleft ones first.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from tools.lock import LOCAL, LOCK, entries, normalized

COPYLEFT = re.compile(r"\bA?L?GPL|GNU|MPL|Mozilla|EUPL|NVIDIA|proprietary", re.IGNORECASE)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=None, help="write the bill as CycloneDX JSON")
    options = parser.parse_args()
    packages = sorted(needed("sgwarp").values(), key=lambda d: normalized(d.name))
    rows = [(d.name, d.version, license_of(d)) for d in packages if normalized(d.name) != "sgwarp"]
    for name, version, text in sorted(rows, key=lambda row: (not COPYLEFT.search(row[2]), row[0].lower())):
        print(f"{name:40} {version:20} {text}")
    if options.out is not None:
        options.out.write_text(json.dumps(bill(packages), indent=1, sort_keys=True) + "\n", encoding="utf-8")
    return 0


def needed(root: str) -> dict[str, Distribution]:
    """Distributions that `root` and its extras ask for, directly and transitively, as far as they are installed."""
    found: dict[str, Distribution] = {}
    waiting = [root]
    while waiting:
        name = waiting.pop()
        if normalized(name) in found:
            continue
        try:
            found[normalized(name)] = distribution(name)
        except PackageNotFoundError:  # of another platform, or of an extra that is not installed
            continue
        requires = found[normalized(name)].requires or []
        # Extras of others are theirs to ask for; ours count.
        ours = [text for text in requires if name == root or "extra ==" not in text]
        waiting += [match[0] for text in ours if (match := re.match(r"[\w.-]+", text))]
    return found


def license_of(package: Distribution) -> str:
    """The license expression, the classifiers, or the first line of what the package says."""
    about = package.metadata
    if about.get("License-Expression"):
        return str(about["License-Expression"])
    classified = [line.rsplit("::", 1)[1].strip() for line in about.get_all("Classifier") or () if "License ::" in line]
    text = (about.get("License") or "").strip().splitlines()
    return ", ".join(classified) or (text[0][:60] if text else "not stated")


def bill(packages: list[Distribution]) -> dict[str, object]:
    """CycloneDX 1.5, without dates or serial numbers: the same packages give the same bytes."""
    hashes = entries(LOCK) | entries(LOCAL)
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "components": [
            {
                "type": "library",
                "name": package.name,
                "version": package.version,
                "purl": f"pkg:pypi/{normalized(package.name)}@{package.version}",
                "licenses": [{"license": {"name": license_of(package)}}],
                "properties": [
                    {"name": "hash", "value": value}
                    for value in sorted(hashes.get((normalized(package.name), package.version), ()))
                ],
            }
            for package in packages
        ],
    }


if __name__ == "__main__":
    sys.exit(main())
