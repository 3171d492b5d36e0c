"""Training of radiance and gaze fields: data, losses, trainers and recipes."""
