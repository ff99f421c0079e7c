"""One reconstruction of the textured room that several tests look at."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("pycolmap", reason="the extra sfm is not installed")

import textured_room as room

from gsopt.data.sfm.pipeline import PosedScene, pose_photos


@pytest.fixture(scope="session")
def room_photos(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("photos") / "room"
    room.photograph(folder, room.arc(6))
    return folder


@pytest.fixture(scope="session")
def posed_room(room_photos: Path, tmp_path_factory) -> PosedScene:
    return pose_photos(room_photos, tmp_path_factory.mktemp("scene") / "room", room.QUICK)
