"""Training a radiance field on posed photos."""
