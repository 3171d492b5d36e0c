"""Training a gaze field on rays and on salience images."""
