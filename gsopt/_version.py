"""The version of gsopt; pyproject.toml and the Blender extension carry the same, and a test compares them."""

__version__ = "0.2.0"
