"""Mathematics that knows no field, file or scene: boxes, the sphere, distributions on it, colour spaces."""
