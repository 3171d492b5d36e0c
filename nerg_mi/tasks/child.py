"""A process that runs tasks, one at a time: ``python -m nerg_mi.tasks.child``.

Mitsuba has one variant a process and is used by one thread, and a fault in a kernel ends its process; so whoever hands
out tasks keeps them apart from itself. Each line on the standard input is a request and each on the standard output
its answer, as JSON (`children`); what tasks print goes to the standard error. Where the standard input ends, whoever
asked is gone, and the process ends at once, whatever it computes.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
import traceback
from pathlib import Path
from typing import Any, TextIO

from nerg_mi.errors import expected, sentence
from nerg_mi.threads import VARIABLE, share, threads_of_worker

from .inputs import ChangedInput, Checksums
from .making import OtherCode, make_output
from .store import Store
from .task import task_of

FINAL = (ChangedInput, OtherCode)
"""Errors that running the task again cannot mend."""


def answer(request: dict[str, Any], checksums: Checksums) -> dict[str, Any]:
    """What comes of a request: ``receipt``, or ``error`` (a sentence) with its ``kind`` and ``trace``."""
    try:
        task = task_of(request["task"])
        paths = {name: Path(path) for name, path in request["paths"].items()}
        return {"receipt": vars(make_output(task, paths, Store(request["store"]), checksums))}
    except Exception as error:
        kind = "final" if isinstance(error, FINAL) else "mendable" if expected(error) else "fault"
        return {"error": sentence(error), "kind": kind, "trace": traceback.format_exc()}


def serve(requests: TextIO, answers: TextIO) -> None:
    """Answer every line of ``requests``, until they end."""
    waiting: queue.Queue[str] = queue.Queue()

    def listen() -> None:
        for line in requests:
            waiting.put(line)
        # Nobody waits for what is being computed.
        os._exit(0)

    threading.Thread(target=listen, daemon=True, name="requests").start()
    checksums, own = Checksums(), threads_of_worker()
    while True:
        request = json.loads(waiting.get())
        # Of one job, and not of the next that this process works for.
        os.environ[VARIABLE] = str(share(own, request.get("threads", 0)))
        print(json.dumps(answer(request, checksums)), file=answers, flush=True)


def main() -> None:
    # Ctrl-C is for whoever asks, who closes the standard input.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    serve(sys.stdin, answers)


if __name__ == "__main__":
    main()
