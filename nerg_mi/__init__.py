"""Neural radiance and gaze fields for Mitsuba 3.

Importing this package makes its plugins available to Mitsuba: before or after `import mitsuba`, before or after
`mi.set_variant`, and again after every change of variant. Mitsuba itself is not imported, so that this stays cheap.

Where the libLLVM that Dr.Jit would load is one on which it aborts the process, importing Dr.Jit or Mitsuba after this
package raises `nerg_mi.errors.UnusableLLVM`, an `ImportError`; where Dr.Jit is loaded already, importing this package
does. Everything else works there, the command `nerg doctor` first of all.
"""

from pathlib import Path as _Path

from . import checkout as _checkout
from . import llvm as _llvm
from . import registration as _registration

__version__ = "0.1.0"

_checkout.find_folders(__name__, _Path(__file__).resolve().parent)
_llvm.prepare()
_registration.install()
