"""Files of Gaussian splats, one format a module: 3DGS PLY, .splat, SPZ, glTF."""
