"""Mathematics without fields, files or scenes: boxes, the sphere, distributions on it, colour spaces."""
