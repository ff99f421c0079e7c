"""Parts of a finished run and of a film, with stand-ins for renders: cameras, backgrounds, lengths of frames."""

from __future__ import annotations

import io
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from PIL import Image

from gsopt.config.train import DataConfig, TrainConfig
from gsopt.errors import InputError, SettingError, UsageError
from gsopt.events import to_json
from gsopt.geometry.cameras import Cameras, intrinsics
from gsopt.results import finished_run, video
from gsopt.results.finished_run import background_of, camera_path, cameras_along, look_at_point, with_longest_side


def camera(width: int = 40, height: int = 30, x: float = 0.0) -> Cameras:
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    return Cameras(viewmat[None], intrinsics(0.8, width, height)[None].float(), width, height)


@pytest.mark.parametrize(
    ("plan", "color"),
    [
        ({"background": {"color": [0.25, 2, -1]}}, [0.25, 1.0, 0.0]),
        ({"background": {"color": [0, 0.5]}}, None),
        ({"background": {"color": "white"}}, None),
        ({"background": None}, None),
        ({}, None),
        (None, [0.0, 0.0, 0.0]),
    ],
)
def test_the_background_is_that_of_the_plan_or_else_of_the_settings(
    plan: Any, color: list[float] | None, tmp_path: Path
) -> None:
    config = TrainConfig(data=DataConfig(path="/a", background="black"))
    (tmp_path / "config.json").write_bytes(to_json({"config": config.to_dict(), "plan": plan}))
    if color is None:
        with pytest.raises(InputError, match=r"`plan\.background` in .* is no color"):
            background_of(tmp_path)
    else:
        assert background_of(tmp_path).tolist() == color


def splats(opacities: list[float]) -> Any:
    means = torch.arange(3.0 * len(opacities)).view(-1, 3)
    values = SimpleNamespace(means=means, opacities=torch.tensor(opacities), __len__=None)
    return type("Splats", (), {**vars(values), "__len__": lambda self: len(opacities)})()


def test_a_path_around_one_camera_looks_at_the_middle_of_the_more_opaque_half() -> None:
    one, two = Cameras.cat([camera()]), Cameras.cat([camera(), camera(x=1.0)])
    model = splats([0.9, 0.1, 0.5, 0.6, 0.2])
    assert look_at_point(model, two) is None
    assert look_at_point(splats([]), one) is None
    found = look_at_point(model, one)
    assert found is not None
    assert found.tolist() == model.means[torch.tensor([0, 2, 3])].median(dim=0).values.tolist()


@pytest.mark.parametrize(
    ("width", "height", "longest", "size"), [(40, 30, 80, (80, 60)), (30, 40, 10, (8, 10)), (400, 1, 40, (40, 1))]
)
def test_the_longer_side_of_a_camera_is_scaled(width: int, height: int, longest: int, size: tuple[int, int]) -> None:
    found = with_longest_side(camera(width, height), longest)
    assert (found.width, found.height) == size


def run_of(monkeypatch: pytest.MonkeyPatch, test: int = 2) -> Any:
    train = tuple(SimpleNamespace(name=f"in/{i}.png", camera=camera(40 + i, 30, float(i))) for i in range(3))
    held = tuple(SimpleNamespace(name=f"out/{i}.png", camera=camera(20, 50, 9.0)) for i in range(test))
    scene = SimpleNamespace(train=train, test=held, origin=(1.0, 2.0, 3.0))
    monkeypatch.setattr(finished_run, "load_scene", lambda data: scene)
    monkeypatch.setattr(finished_run, "with_refined_poses", lambda scene, path: scene)
    return SimpleNamespace(config=SimpleNamespace(data=None), path=Path("run"), gaussians=None)


def test_views_are_drawn_under_their_numbered_names(monkeypatch: pytest.MonkeyPatch) -> None:
    run = run_of(monkeypatch)
    assert [name for name, _ in cameras_along(run, "train", 9)] == ["0000_0", "0001_1", "0002_2"]
    found = cameras_along(run, "test", 9, longest=100)
    assert [(name, shot.width, shot.height) for name, shot in found] == [("0000_0", 40, 100), ("0001_1", 40, 100)]
    with pytest.raises(InputError, match="held out no views to render"):
        cameras_along(run_of(monkeypatch, test=0), "test", 9)


def test_a_path_has_the_size_of_the_first_view_and_a_file_the_origin_of_the_scene(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run, asked = run_of(monkeypatch), list[Any]()

    def along(run: Any, cameras: Cameras, path: str, count: int) -> Cameras:
        asked.append((cameras.width, cameras.height, path, count))
        return cameras

    monkeypatch.setattr(finished_run, "camera_path", along)
    assert [name for name, _ in cameras_along(run, "orbit", 7)] == ["0000", "0001", "0002"]
    assert asked == [(40, 30, "orbit", 7)]
    monkeypatch.setattr(
        finished_run, "read_camera_path", lambda path, origin: (asked.append((path, origin)), [camera()])[1]
    )
    assert [name for name, _ in cameras_along(run, "film.json", 7)] == ["0000"]
    assert asked[1] == (Path("film.json"), (1.0, 2.0, 3.0))


@pytest.mark.parametrize("path", ["orbit", "turntable", "ellipse", "interpolated"])
def test_each_path_is_made_by_its_name(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("orbit", "turntable", "ellipse", "interpolated"):
        monkeypatch.setattr(
            finished_run, f"{name}_path", lambda cameras, count, *target, name=name: (name, count, target)
        )
    monkeypatch.setattr(finished_run, "look_at_point", lambda splats, cameras: "middle")
    run: Any = SimpleNamespace(gaussians=None)
    expected = () if path == "interpolated" else ("middle",)
    assert camera_path(run, camera(), path, 5) == (path, 5, expected)


def test_frames_are_drawn_one_by_one_into_a_folder_or_a_film(monkeypatch: pytest.MonkeyPatch) -> None:
    run: Any = SimpleNamespace(draw=lambda shot: f"drawn {shot}")
    shots: Any = [("a", 1), ("b", 2)]
    told: list[Any] = []
    monkeypatch.setattr(
        finished_run, "save_stills", lambda folder, frames, overwrite: told.append((folder, [*frames], overwrite))
    )
    monkeypatch.setattr(
        finished_run,
        "save_video",
        lambda output, frames, fps, overwrite: told.append((output, [*frames], fps, overwrite)),
    )
    finished_run.render_stills(run, shots, Path("f"))
    finished_run.render_video(run, shots, Path("v"), 12.0, overwrite=True)
    assert told == [
        (Path("f"), [("a", "drawn 1"), ("b", "drawn 2")], False),
        (Path("v"), ["drawn 1", "drawn 2"], 12.0, True),
    ]


def frames(count: int, width: int = 8, height: int = 6) -> list[Image.Image]:
    return [Image.new("RGB", (width, height), (40 * i, 0, 0)) for i in range(count)]


@pytest.mark.parametrize(
    ("kind", "fps", "duration"),
    [
        (".webp", 24.0, 42),
        (".webp", 100.0, 10),
        (".gif", 24.0, 40),
        (".gif", 100.0, 20),
        (".gif", 50.0, 20),
        (".gif", 1.0, 1000),
    ],
)
def test_a_frame_of_a_gif_lasts_two_hundredths_of_a_second_at_least(kind: str, fps: float, duration: int) -> None:
    file = io.BytesIO()
    video.write_video(file, iter(frames(2)), kind, fps)
    with Image.open(io.BytesIO(file.getvalue())) as film:
        film.seek(0)
        film.load()
        assert film.n_frames == 2  # type: ignore[attr-defined]
        assert film.info["duration"] == duration
        assert film.info.get("loop") == 0


@pytest.mark.parametrize(("largest", "fine"), [(8, True), (7, False)])
def test_a_side_may_be_as_long_as_the_format_holds(largest: int, fine: bool) -> None:
    renders = [torch.zeros(6, 8, 3, dtype=torch.uint8)] * 2
    if fine:
        assert [image.size for image in video._same_size(renders, largest)] == [(8, 6)] * 2
    else:
        with pytest.raises(InputError, match="holds at most 7 px a side, got 8"):
            list(video._same_size(renders, largest))


@pytest.mark.parametrize(("fps", "fine"), [(0.1, True), (240.0, True), (0.09, False), (241.0, False)])
def test_a_film_has_a_tenth_of_a_frame_to_240_a_second(fps: float, fine: bool, tmp_path: Path) -> None:
    render = torch.zeros(6, 8, 3, dtype=torch.uint8)
    if fine:
        video.save_video(tmp_path / "a.gif", [render] * 2, fps)
        assert (tmp_path / "a.gif").is_file()
    else:
        with pytest.raises((UsageError, SettingError), match="--fps"):
            video.save_video(tmp_path / "a.gif", [render] * 2, fps)
        assert not (tmp_path / "a.gif").exists()


@pytest.mark.parametrize(("size", "even"), [((9, 7), (8, 6)), ((8, 6), (8, 6)), ((1, 1), (2, 2)), ((3, 2), (2, 2))])
def test_an_mp4_has_even_sides_one_stream_and_ends_with_what_the_encoder_kept(
    size: tuple[int, int], even: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Any] = []

    class Container:
        def __enter__(self) -> Container:
            return self

        def __exit__(self, *_: object) -> None: ...

        def add_stream(self, codec: str, rate: Fraction, options: dict[str, str]) -> Any:
            told.append((codec, rate, options))
            return SimpleNamespace(encode=lambda *frame: frame or "rest")

        def mux(self, packet: Any) -> None:
            told.append(packet)

    av = SimpleNamespace(
        open=lambda file, mode, format: Container(), VideoFrame=SimpleNamespace(from_image=lambda image: image.size)
    )
    monkeypatch.setattr(video, "require", lambda *_: av)
    video.write_video(io.BytesIO(), iter(frames(3, *size)), ".mp4", 23.976)
    assert told == [("libx264", Fraction(23.976).limit_denominator(1000), {"crf": "18"}), *[(even,)] * 3, "rest"]
    told.clear()
    video.write_video(io.BytesIO(), iter([]), ".mp4", 24.0)
    assert told == []


def test_the_longest_sides_are_those_that_formats_and_decoders_know() -> None:
    """WebP counts sides in 14 bits, GIF in 16; H.264 decoders hold 8192 px."""
    assert video.MAX_SIDE == {".webp": 2**14 - 1, ".gif": 2**16 - 1, ".mp4": 2**13}
