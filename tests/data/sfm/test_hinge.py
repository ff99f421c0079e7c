"""Photos that share points with the others through one photo alone, found and advised in a run."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import textured_room as room
import torch

from gsopt.data.sfm.pipeline import pose_photos
from gsopt.geometry.cameras import look_at


def turned(index: int, degrees: float) -> torch.Tensor:
    """A camera in one corner of the room, from another place for every index, that looks in a direction."""
    angle, turn = math.radians(degrees), torch.tensor([1.3, 1.3, 2.1]) * index
    offset = torch.stack([0.35 * turn[0].cos(), 0.35 * turn[1].sin(), 0.15 * turn[2].sin()]).double()
    eye = torch.tensor([1.9, -1.9, 1.5], dtype=torch.float64) + offset
    forward = torch.tensor([math.cos(angle), math.sin(angle), -0.12], dtype=torch.float64)
    return look_at(eye[None], eye + forward, torch.tensor([0, 0, 1], dtype=torch.float64))


@pytest.mark.parametrize(("between", "named"), [((122,), True), ((122, 121, 123), False)])
def test_photos_of_two_walls_that_one_photo_joins_are_named(
    between: tuple[int, ...], named: bool, tmp_path: Path
) -> None:
    """No photo of one wall shows the other. With a photo on each side of the one that shows both, no advice is left."""
    directions = (88, 89, 90, *between, 153, 154, 155)
    room.photograph(tmp_path / "photos", torch.cat([turned(i, degrees) for i, degrees in enumerate(directions)]))
    posed = pose_photos(tmp_path / "photos", tmp_path / "scene", room.QUICK)
    assert len(posed.diagnosis.registered) == len(directions)
    hinges = [advice for advice in posed.diagnosis.advice if "share points with the other photos" in advice]
    wall = "room_00.jpg, room_01.jpg, room_02.jpg"
    expected = f"{wall} share points with the other photos through room_03.jpg alone"
    assert [advice.partition(":")[0] for advice in hinges] == [expected] * named
