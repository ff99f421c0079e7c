"""Mathematics that several packages share: cameras, rotations, projection, voxels, harmonics."""
