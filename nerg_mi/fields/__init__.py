"""What is at a point: encodings, radiance and gaze networks, occupancy. Knows no rays, files or scenes."""

import importlib
import pkgutil

# Imported so that the registries know every kind, whichever module of the package is asked for.
for _module in pkgutil.iter_modules(__path__):
    if _module.name.startswith(("encoding_", "gaze_")):
        importlib.import_module(f"{__name__}.{_module.name}")
