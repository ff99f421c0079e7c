"""Meshes to shape libraries."""
