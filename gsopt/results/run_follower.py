"""Follows the events of a run directory: its newest splats and how far it is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsopt.events import LAST, read_events


@dataclass(frozen=True)
class Update:
    """A change to display."""

    splats: Path | None
    """File to load, or None when the event is only text."""
    caption: str


class RunFollower:
    """Reads a run's new events and returns its newest splats."""

    def __init__(self, run: Path) -> None:
        self.run = run
        self.share: float | None = None
        """Share of the steps that are done, or None while no run is going on."""
        self._offset = 0

    def poll(self) -> Update | None:
        """The newest update since the last call, or None; older previews are skipped."""
        events, self._offset = read_events(self.run / "events.jsonl", self._offset)
        updates = [update for event in events if (update := self._update(event)) is not None]
        drawn = [update for update in updates if update.splats is not None]
        if not updates:
            return None
        return Update(drawn[-1].splats if drawn else None, updates[-1].caption)

    def _update(self, event: dict[str, Any]) -> Update | None:
        kind = event.get("kind")
        self._follow_progress(event)
        if kind == "preview":
            step = event.get("step")
            return Update(self._inside(event.get("path")), f"step {step}" if type(step) is int else "preview")
        if kind in LAST:
            return Update(self._inside("splat.ply"), str(kind))
        return None

    def _follow_progress(self, event: dict[str, Any]) -> None:
        step, total = event.get("step"), event.get("total")
        if event.get("kind") in LAST:
            self.share = None
        elif type(step) is int and type(total) is int and total > 0:
            self.share = min(max(step / total, 0.0), 1.0)

    def _inside(self, name: object) -> Path | None:
        """The file `name` of the run, or None when it is missing or outside the run directory."""
        if not isinstance(name, str):
            return None
        try:
            path = (self.run / name).resolve()
            return path if path.is_relative_to(self.run.resolve()) and path.is_file() else None
        except (OSError, ValueError, RuntimeError):  # too long, no text or a NUL, a circle of links
            return None
