"""A 3D diffusion prior: shape and color of what one to three photos leave open, learned from a shape library."""
