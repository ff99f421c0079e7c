"""Diffusion priors behind one protocol."""
