"""Functions of position and direction: encodings, radiance and gaze networks, occupancy. Without rays, files or
scenes."""

import importlib
import pkgutil

# Import all kinds so that they are registered, whichever module of the package is imported first.
for _module in pkgutil.iter_modules(__path__):
    if _module.name.startswith("gaze_"):
        importlib.import_module(f"{__name__}.{_module.name}")
