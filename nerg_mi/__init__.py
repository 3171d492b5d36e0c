"""Neural radiance and gaze fields for Mitsuba 3.

Importing this package makes its plugins available to Mitsuba: before or after `import mitsuba`, before or after
`mi.set_variant`, and again after every change of variant. Mitsuba itself is not imported, so that this stays cheap.

Raises `ImportError` where the libLLVM that Dr.Jit would load is one on which it aborts the process.
"""

import sys as _sys
from pathlib import Path as _Path

from . import checkout as _checkout
from . import llvm as _llvm
from . import registration as _registration

__version__ = "0.1.0"

_checkout.find_folders(__name__, _Path(__file__).resolve().parent)
_llvm.prepare()
# The command itself must start on a machine with an unusable libLLVM, because `nerg doctor` says what to do about it;
# there the check comes with the import of Mitsuba.
if "nerg_command" not in _sys.modules:
    _llvm.require()
_registration.install()
