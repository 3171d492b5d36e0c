"""What is implausible about a set of rays, and the mistake that is likely behind it."""
