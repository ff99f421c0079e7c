"""How Gaussians are changed until they look like the input views; `loop.train` is the way in."""
