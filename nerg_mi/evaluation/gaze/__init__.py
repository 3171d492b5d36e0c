"""A gaze field, and its baselines, at positions and of people that it was not trained on."""
