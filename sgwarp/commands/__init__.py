"""The subcommands of `sgwarp`: one dataclass each, whose fields are the options and whose `run` does the work.

Only `sgwarp.cli` imports this package, once tyro is known to be there; torch and warp come with `run`.
"""

from sgwarp.commands.batch import Batch
from sgwarp.commands.convert import Convert
from sgwarp.commands.demo import Demo
from sgwarp.commands.distill import Distill
from sgwarp.commands.edit import Edit
from sgwarp.commands.encoders import Encoders
from sgwarp.commands.evaluate import Evaluate
from sgwarp.commands.fit import Fit
from sgwarp.commands.info import Info
from sgwarp.commands.instances import Instances
from sgwarp.commands.lift import Lift
from sgwarp.commands.poses import Poses
from sgwarp.commands.predict import Predict
from sgwarp.commands.query import Query
from sgwarp.commands.render import Render
from sgwarp.commands.report import Report
from sgwarp.commands.segment import Segment
from sgwarp.commands.track import Track
from sgwarp.commands.view import View

COMMANDS = {
    "poses": Poses,
    "fit": Fit,
    "lift": Lift,
    "distill": Distill,
    "predict": Predict,
    "query": Query,
    "segment": Segment,
    "track": Track,
    "instances": Instances,
    "edit": Edit,
    "view": View,
    "render": Render,
    "batch": Batch,
    "info": Info,
    "convert": Convert,
    "encoders": Encoders,
    "evaluate": Evaluate,
    "report": Report,
    "demo": Demo,
}
