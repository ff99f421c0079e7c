"""The GPU backend: one text of kernels, compiled where it is first used."""
