"""A report on a gaze field: one HTML file that holds everything it shows and asks no network for anything."""
