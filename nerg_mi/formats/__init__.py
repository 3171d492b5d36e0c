"""File formats of fields, meshes, splats and areas of interest. Readers refuse unsupported files and never run code."""
