"""Measurements of `gsopt bench`: kernels, whole scenes and suites, written as JSON and drawn from it."""
