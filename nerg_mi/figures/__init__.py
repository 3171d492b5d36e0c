"""Pictures for people: tone mapping, overlays of gaze, figures and floor plans."""
