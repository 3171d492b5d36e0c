"""Run a command with other values of parameters that are no options of it, for small inputs:

python -m tools.with_defaults probes=8 train gaze rays.npz --environment hits -o gaze.safetensors
"""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Sequence
from itertools import takewhile
from typing import Any

from nerg_mi import cli
from nerg_mi.cli.declarations import import_function
from nerg_mi.cli.table import ROWS


def find_defaults(line: Sequence[str]) -> dict[str, Any]:
    """Return the defaults of the function that the command ``line`` calls, which may be changed."""
    row = ROWS.get(" ".join(line[:2])) or ROWS[line[0]]
    return inspect.unwrap(import_function(row.function)).__kwdefaults__


if __name__ == "__main__":
    words = list(takewhile(lambda word: "=" in word, sys.argv[1:]))
    line = sys.argv[1 + len(words) :]
    find_defaults(line).update({name: json.loads(value) for name, _, value in (word.partition("=") for word in words)})
    cli.main(line)
