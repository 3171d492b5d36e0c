"""What is at a point: encodings, radiance and gaze networks, occupancy. Knows no rays, files or scenes."""
