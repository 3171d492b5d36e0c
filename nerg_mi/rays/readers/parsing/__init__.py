"""Files of tracking data taken apart: tables, column maps, skeleton files; and poses of heads as rotations."""
