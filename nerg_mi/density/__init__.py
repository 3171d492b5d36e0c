"""From rays to densities over directions: probes, bandwidths, what a surface receives."""
