"""From photos or a film to a posed scene. Read `pipeline.py` first; `settings.py` needs no heavy import."""
