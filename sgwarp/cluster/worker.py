"""A worker process of the local engine: reads tasks, a line of JSON each, and answers with outcomes."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict

from sgwarp.cluster.tasks import Task, named_function
from sgwarp.cluster.watching import end_with
from sgwarp.cluster.working import work


def serve(parent: int) -> None:
    """Work until stdin ends, or the process `parent` does.

    A line is {"task": ...}, or {"call": "module:function", "arguments": [...]} for what prepares the worker.
    """
    end_with(parent)
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print is no answer
    for line in sys.stdin:
        message = json.loads(line)
        if "call" in message:
            named_function(message["call"])(*message["arguments"])
            answer = {}
        else:
            answer = asdict(work(Task.from_json(message["task"])))
        print(json.dumps(answer), file=answers, flush=True)
