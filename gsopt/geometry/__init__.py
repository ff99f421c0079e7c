"""Mathematics that several packages share: cameras, paths, focus, projection, rotations, harmonics, voxels, Z-order."""
