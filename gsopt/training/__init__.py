"""Optimizes Gaussians until they match the input views; `loop.train` is the way in."""
