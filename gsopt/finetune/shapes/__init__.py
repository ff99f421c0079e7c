"""Trains a 3D diffusion prior on the shapes of a library."""
