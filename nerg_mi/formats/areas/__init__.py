"""Areas of interest of every kind, in one JSON file: boxes, parts of meshes, shapes of a scene, groups, recordings."""
