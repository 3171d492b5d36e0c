"""Loading scene files, rendering them in bands, and writing scene and image files."""
