"""Structure from motion: from photos or a video to a posed scene. Start with `pipeline.py`."""
