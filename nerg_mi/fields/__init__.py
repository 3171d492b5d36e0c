"""What is at a point: encodings, radiance and gaze networks, occupancy. Knows no rays, files or scenes."""

# Imported so that the registry knows them, whichever module of the package is asked for.
from . import gaze_ensemble as gaze_ensemble
from . import gaze_log_density as gaze_log_density
from . import gaze_product as gaze_product
