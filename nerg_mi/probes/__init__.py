"""From rays to densities over directions: probes, kernel densities on the sphere, what a surface receives."""
