"""`sgwarp demo`: the whole way on a room that ships with the package."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sgwarp.commands.inputs_kept import LOG
from sgwarp.commands.options import Options, check_folder
from sgwarp.runs.progress import show_progress

if TYPE_CHECKING:
    from sgwarp.scene import Semantics
    from sgwarp.viewer.live import Live
    from sgwarp.viewer.workbench import Workbench


@dataclass(kw_only=True)
class Demo(Options):
    """Lift the default encoder into the room that ships with the package, ask for its furniture, measure and draw."""

    out: Path = Path("demo_out")
    """Folder for the pictures, report.md and run.json."""

    view: bool = False
    """Show the room in the browser while it is lifted, and the result until Ctrl-C."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        from sgwarp.demo.run import PICTURES

        yield "--out", [self.out / name for name in (*PICTURES, "report.md", LOG)]

    def run(self) -> None:
        check_folder("--out", self.out)
        self.start()
        from sgwarp.demo.run import run_demo

        if not self.view:
            run_demo(self.out, device=self.device, show=show_progress)
            return
        live = self._live()
        try:
            run_demo(self.out, device=self.device, show=show_progress, watch=live.watch)
            live.finish()
        finally:
            live.close()

    def _live(self) -> Live:
        from sgwarp.demo.data import Room
        from sgwarp.demo.run import ENCODER
        from sgwarp.encoders.registry import image_tower_for, make_text_encoder
        from sgwarp.viewer.live import Live
        from sgwarp.viewer.workbench import Materials, Workbench

        room = Room.load().to(self.device)
        text = make_text_encoder(ENCODER, self.device)
        tower = image_tower_for(text.space, self.device)

        def begin(semantics: Semantics) -> Workbench:
            return Workbench(Materials(room.gaussians, semantics, None, text, views=room.views, make_tower=tower))

        return Live(
            begin,
            Workbench.replace_semantics,
        )
