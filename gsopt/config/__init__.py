"""Every setting of a run: frozen dataclasses, without torch."""
