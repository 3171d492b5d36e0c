"""No kernel is compiled before a benchmark that imports this ahead of Dr.Jit: first frames are first frames."""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile

# Later it would be too late, and in the way of programs that are started.
if "drjit" not in sys.modules:
    _FOLDER = tempfile.mkdtemp(prefix="kernels-")
    os.environ["DRJIT_CACHE_DIR"] = _FOLDER
    atexit.register(shutil.rmtree, _FOLDER, ignore_errors=True)
