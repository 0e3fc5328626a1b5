"""`sgwarp encoders`: which sources of 2D semantics there are."""

from __future__ import annotations

import json
from dataclasses import dataclass

ROLES = {
    "images": "image level: sees one region at a time",
    "pixels": "pixel level: features for every pixel",
    "instances": "instance level: finds and names things; add +text:NAME, which embeds the names",
    "maps": "complete: files, and networks with classes of their own",
    "masks": "masks, to be added to one of the above with +",
}


@dataclass(kw_only=True)
class Encoders:
    """List the sources of 2D semantics: what to give to --encoder, and what each needs."""

    json: bool = False
    """Print JSON instead of lines."""

    command_line = ""

    def run(self) -> None:
        from sgwarp.encoders.catalogue import KINDS

        if self.json:
            facts = [
                {
                    "name": kind.name,
                    "role": kind.role,
                    "about": kind.about,
                    "example": kind.example,
                    "options": list(kind.options),
                    "installed": not kind.missing,
                    "install": f'pip install "sgwarp[{kind.extra}]"' if kind.extra else None,
                }
                for kind in KINDS.values()
            ]
            print(json.dumps(facts, indent=2))
            return
        for role, title in ROLES.items():
            print(f"{title}")
            for kind in (kind for kind in KINDS.values() if kind.role == role):
                state = f'needs: pip install "sgwarp[{kind.extra}]"' if kind.missing else "installed"
                print(f"  {kind.name:12} {kind.about} ({state})")
                print(f"  {'':12} --encoder '{kind.example}'")
                if kind.options:
                    print(f"  {'':12} options: {', '.join(kind.options)}")
            print()
        print("Options follow a question mark: clip:PATH?longest=448&templates=room. Several encoders, with weights:")
        print("  --encoder 'conse@2++clip:PATH+sam:PATH@1'")
