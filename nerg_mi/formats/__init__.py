"""File formats of fields, meshes, splats and areas of interest. Each reader refuses what it can not read, and runs
nothing."""
