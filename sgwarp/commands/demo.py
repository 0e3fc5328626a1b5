"""`sgwarp demo`: the whole way on a room that ships with the package."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sgwarp.commands.options import Options, check_folder
from sgwarp.runs.progress import show_progress


@dataclass(kw_only=True)
class Demo(Options):
    """Lift the default encoder into the room that ships with the package, ask for its furniture, measure and draw."""

    out: Path = Path("demo_out")
    """Folder for the pictures, report.md and run.json."""

    def run(self) -> None:
        check_folder("--out", self.out)
        self.start()
        from sgwarp.demo.run import run_demo

        run_demo(self.out, device=self.device, show=show_progress)
