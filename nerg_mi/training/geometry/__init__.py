"""The places that a gaze field is trained in: fields, shapes, volumes, or the hit points of rays."""
