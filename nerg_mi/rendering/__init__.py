"""From a scene file to a picture file: checks, bands of rows, writers."""
