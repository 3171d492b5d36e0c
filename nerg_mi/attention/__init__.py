"""From tracking data to supervision: rays, skeletons, von Mises-Fisher densities, probes, splits."""
