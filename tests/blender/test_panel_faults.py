"""Whatever goes wrong outside ends in a message of the panel."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from in_panel import event, fails_with, stand_in
from job_records import HOSTILE_RECORDS, record_of
from made_splats import random_splats

from blender_addon.core.ply import write_ply


def test_faults_end_in_a_message(panel: Any, tmp_path: Path) -> None:
    import bpy

    write_ply(tmp_path / "a.ply", random_splats(5, 0))
    (tmp_path / "lies.ply").write_bytes((tmp_path / "a.ply").read_bytes().replace(b"vertex 5", b"vertex 999"))
    settings = bpy.context.preferences.addons["blender_addon"].preferences
    fails_with("claims 999 rows", bpy.ops.gsopt.import_splats, filepath=str(tmp_path / "lies.ply"))
    fails_with("neither .ply nor .spz", bpy.ops.gsopt.import_splats, filepath=str(tmp_path / "a.obj"))
    fails_with("holds no splats yet", bpy.ops.gsopt.import_splats, filepath=str(tmp_path))
    fails_with("holds no run", bpy.ops.gsopt.attach, directory=str(tmp_path))
    fails_with("Nothing to render", bpy.ops.gsopt.render_dataset)
    fails_with("no dataset", bpy.ops.gsopt.launch)
    fails_with("No run is going on", bpy.ops.gsopt.stop)
    fails_with("notes are empty", bpy.ops.gsopt.propose)
    fails_with("No splats are named", bpy.ops.gsopt.import_splats)
    (tmp_path / "photos").mkdir()
    panel.photos = str(tmp_path / "photos")
    before, panel.folder = panel.folder, str(tmp_path / "a.ply")
    fails_with("a.ply", bpy.ops.gsopt.find_poses)
    panel.folder = before
    settings.interpreter = str(tmp_path / "no python")
    fails_with("not there or not a program", bpy.ops.gsopt.test)
    wrong = tmp_path / "wrong python"
    wrong.write_text("#!/bin/sh\necho 'No module named gsopt'; exit 1\n")
    wrong.chmod(0o755)
    settings.interpreter = str(wrong)
    fails_with("No module named gsopt", bpy.ops.gsopt.test)
    other = {"gsopt": "9.1", "rasterizer": {"isa": "x", "backend": "x", "ms_per_step": 1, "problem": None}}
    wrong.write_text(f"#!/bin/sh\necho '{json.dumps(other)}'\n")
    fails_with("gsopt 9.1, this extension knows", bpy.ops.gsopt.test)


@pytest.mark.parametrize(
    ("log", "status", "said"),
    [
        (event("started", pid=2**22 + 1, total=9, step=0), "killed", "Resume"),
        (
            event("started", pid=1, total=9) + event("error", message="The disk is full. Free some space."),
            "error",
            "disk",
        ),
        (event("started", pid=1, total=9).replace('"v": 1', '"v": 7'), "unreadable", "protocol version 7"),
        ("garbage\n" * 10 + event("done", step=9), "done", ""),
        (event("done", step=9) + '{"v": 1, "seq": 3, "ki', "done", ""),
    ],
)
def test_whatever_a_run_left_behind_is_told(panel: Any, tmp_path: Path, log: str, status: str, said: str) -> None:
    import bpy

    run = tmp_path / "run"
    run.mkdir()
    (run / "events.jsonl").write_text(log)
    bpy.ops.gsopt.attach(directory=str(run))
    bpy.ops.gsopt.follow(seconds=20.0)
    assert panel.run_status == status
    assert said in panel.run_message


def test_a_program_that_dies_at_once_is_told(panel: Any, tmp_path: Path) -> None:
    import bpy

    (tmp_path / "data").mkdir()
    panel.dataset, panel.source = str(tmp_path / "data"), "DATASET"
    wrong = tmp_path / "python"
    wrong.write_text("#!/bin/sh\necho 'gsopt: There is no scene in it. Give another.'; exit 3\n")
    wrong.chmod(0o755)
    bpy.context.preferences.addons["blender_addon"].preferences.interpreter = str(wrong)
    fails_with("There is no scene in it", bpy.ops.gsopt.launch)
    assert panel.run_status == "error"


def test_a_killed_run_is_told_and_can_go_on(panel: Any, tmp_path: Path) -> None:
    """`-m gsopt train DATA -m RUN` are the first words, `-m gsopt train --resume -m RUN` when it goes on."""
    import bpy

    from blender_addon.core import job

    (tmp_path / "data").mkdir()
    panel.dataset, panel.source = str(tmp_path / "data"), "DATASET"
    begin, end = event("started", pid=0, total=9, step=0), event("done", step=9)
    (tmp_path / "begin").write_text(begin.replace('"pid": 0', '"pid": PID'))
    (tmp_path / "end").write_text(end)
    stand_in(
        tmp_path,
        f'if [ "$4" = --resume ]; then cat "{tmp_path}/end" >> "$6/events.jsonl"; exit; fi\n'
        f'mkdir -p "$6"; sed "s/PID/$$/" "{tmp_path}/begin" > "$6/events.jsonl"; exec sleep 60',
    )
    bpy.ops.gsopt.launch(wait=False)
    bpy.ops.gsopt.follow(step=0, seconds=20.0)
    from blender_addon import progress_timer

    assert progress_timer.wait(lambda: panel.run_status == "running", 20.0)
    fails_with("A run is going on", bpy.ops.gsopt.launch)
    job.end(job.read_job(Path(panel.run_job)), force=True)
    bpy.ops.gsopt.follow(seconds=20.0)
    assert panel.run_status == "killed"
    assert "Resume" in panel.run_message
    bpy.ops.gsopt.resume()
    assert panel.run_status == "done"


def test_poses_are_found_or_the_reason_is_told(panel: Any, tmp_path: Path) -> None:
    import bpy

    (tmp_path / "photos").mkdir()
    panel.source = "PHOTOS"
    fails_with("No photos are chosen", bpy.ops.gsopt.find_poses)
    panel.photos = str(tmp_path / "photos")
    stand_in(tmp_path, "echo 'gsopt: Only 2 of 9 photos overlap. Take more.'; exit 3")
    fails_with("Only 2 of 9 photos overlap", bpy.ops.gsopt.find_poses)
    stand_in(tmp_path, 'mkdir -p "$6"; echo {} > "$6/transforms.json"')
    bpy.ops.gsopt.find_poses()
    assert panel.source == "DATASET"
    assert (Path(panel.dataset) / "transforms.json").is_file()


def test_the_object_is_cut_out_or_the_reason_is_told(panel: Any, tmp_path: Path) -> None:
    import bpy

    panel.source = "DATASET"
    panel.dataset = ""
    fails_with("No dataset is chosen", bpy.ops.gsopt.cut_out)
    (tmp_path / "data").mkdir()
    panel.dataset = str(tmp_path / "data")
    stand_in(tmp_path, "echo 'gsopt: Cutting out an object needs a mask model.'; exit 2")
    fails_with("needs a mask model", bpy.ops.gsopt.cut_out)
    stand_in(tmp_path, 'mkdir -p "$4/masks"; echo {} > "$4/masks/masks.json"')
    bpy.ops.gsopt.cut_out()
    assert panel.job_masks.state == "DONE"
    fails_with("has masks already", bpy.ops.gsopt.cut_out)


def test_a_downloaded_job_ends_in_a_message(panel: Any, tmp_path: Path) -> None:
    import bpy

    from blender_addon import progress_timer

    for number, changed in enumerate(HOSTILE_RECORDS):
        record_of(tmp_path / str(number), changed)
        for kind in progress_timer.KINDS:
            entry, panel.message = getattr(panel, f"job_{kind}"), ""
            entry.folder, entry.state = str(tmp_path / str(number)), "RUNNING"
            progress_timer.look(bpy.context.scene)
            assert entry.state == "FAILED"
            assert "job.json is damaged" in panel.message


def test_stop_ends_no_process_that_a_downloaded_job_names(panel: Any, tmp_path: Path) -> None:
    import bpy

    foreign = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], start_new_session=True)
    try:
        record_of(tmp_path, {"pid": foreign.pid, "started": time.time()})
        (tmp_path / "events.jsonl").write_text(event("started", pid=foreign.pid, total=9, step=0))
        panel.run_path = panel.run_job = str(tmp_path)
        panel.run_status = "running"
        bpy.ops.gsopt.stop(kill=True)
        assert panel.run_status == "killed"
        time.sleep(0.2)
        assert foreign.poll() is None
    finally:
        foreign.kill()
        foreign.wait()


def test_datasets_with_values_beyond_blenders_end_in_a_message(panel: Any, tmp_path: Path) -> None:
    import bpy

    huge = 10**400
    frame = {"file_path": "a", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
    lens = {"camera_angle_x": 0.7, "cx": 1, "cy": 1, "w": 2, "h": 2}
    for changed in ({"w": huge}, {"h": huge}, {"cx": huge}, {"file_path": "\ud800"}):
        (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": [{**frame, **changed}]}))
        fails_with("Frame 0", bpy.ops.gsopt.import_cameras, directory=str(tmp_path))
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": [frame]}))
    (tmp_path / "object.json").write_text(json.dumps({"normalized_from_mesh": [[huge] * 4] * 4}))
    fails_with("normalized_from_mesh", bpy.ops.gsopt.import_cameras, directory=str(tmp_path))
    (tmp_path / "object.json").unlink()
    prompts = {"version": 1, "prompts": [{"text": "a"}], "images": [{"file": True}]}
    (tmp_path / "a.json").write_text(json.dumps(prompts))
    assert bpy.ops.gsopt.prompts_read(filepath=str(tmp_path / "a.json")) == {"FINISHED"}
    (tmp_path / "a.json").write_text(json.dumps({**prompts, "notes": float("inf")}))
    fails_with("No JSON file can hold", bpy.ops.gsopt.prompts_read, filepath=str(tmp_path / "a.json"))


def test_work_can_be_canceled_and_is_not_begun_twice(panel: Any, tmp_path: Path) -> None:
    import bpy

    from blender_addon.core import job

    panel.photos = str(tmp_path)
    stand_in(tmp_path, "sleep 60")
    bpy.ops.gsopt.find_poses(wait=False)
    work = job.read_job(Path(panel.job_poses.folder))
    assert job.alive(work)
    fails_with("going on already", bpy.ops.gsopt.find_poses)
    bpy.ops.gsopt.cancel(kind="poses")
    assert panel.job_poses.state == "NONE"
    job._children[work.pid].wait(20)
    fails_with("no work called", bpy.ops.gsopt.cancel, kind="x")


def test_a_folder_that_cannot_be_written_to_is_told(panel: Any, tmp_path: Path) -> None:
    import bpy

    (tmp_path / "file").touch()
    panel.folder, panel.notes = str(tmp_path / "file" / "below"), "lantern"
    bpy.ops.mesh.primitive_cube_add()
    stand_in(tmp_path, "exit 0")
    for operator in (bpy.ops.gsopt.propose, bpy.ops.gsopt.test):
        fails_with("Choose another folder", operator)
    bpy.context.preferences.addons["blender_addon"].preferences.checkout = str(Path(__file__).resolve().parents[2])
    fails_with("Cannot write", bpy.ops.gsopt.render_dataset)
    assert [scene.name for scene in bpy.data.scenes] == ["Scene"], "the stage is gone"


def test_splats_in_edit_mode_are_left_alone(panel: Any, tmp_path: Path) -> None:
    import bpy
    from in_panel import bring_in

    bring_in(tmp_path / "a.ply")
    bpy.ops.object.mode_set(mode="EDIT")
    for operator in (bpy.ops.gsopt.filter, bpy.ops.gsopt.statistics, bpy.ops.gsopt.delete_hidden):
        fails_with("Leave Edit Mode", operator)
    bpy.ops.object.mode_set(mode="OBJECT")
    assert bpy.ops.gsopt.statistics() == {"FINISHED"}


def test_a_defect_of_ours_is_a_message_and_the_timer_goes_on(
    panel: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import bpy

    from blender_addon import splat_object

    def broken(*_: Any) -> None:
        raise TypeError("oops")

    write_ply(tmp_path / "a.ply", random_splats(5, 0))
    monkeypatch.setattr(splat_object, "put", broken)
    fails_with(
        "A defect of the extension: TypeError('oops')", bpy.ops.gsopt.import_splats, filepath=str(tmp_path / "a.ply")
    )
    assert panel.job_import.state == "FAILED"
    monkeypatch.undo()
    assert bpy.ops.gsopt.import_splats(filepath=str(tmp_path / "a.ply")) == {"FINISHED"}


def test_a_run_is_shared_and_cleaned_or_the_reason_is_told(panel: Any, tmp_path: Path) -> None:
    """`-m gsopt export RUN -o OUT --force` and `-m gsopt clean RUN`, by a stand-in that makes their products."""
    import bpy

    for operator in (bpy.ops.gsopt.share, bpy.ops.gsopt.clean, bpy.ops.gsopt.undo_clean):
        fails_with("no finished run", operator)
    run = tmp_path / "run"
    run.mkdir()
    (run / "splat.ply").write_bytes(b"cleaned")
    panel.run_path = str(run)
    stand_in(tmp_path, "echo 'gsopt: The disk is full.'; exit 3")
    fails_with("The disk is full", bpy.ops.gsopt.share)
    fails_with("The disk is full", bpy.ops.gsopt.clean)
    stand_in(
        tmp_path, 'if [ "$3" = export ]; then echo page > "$6"; else echo picture > "$4/clean.png"; echo "3 go"; fi'
    )
    bpy.ops.gsopt.share()
    assert (run / "page.html").read_text() == "page\n"
    bpy.ops.gsopt.clean()
    assert "3 go" in panel.message
    fails_with("was not cleaned", bpy.ops.gsopt.undo_clean)
    (run / "splat.before-clean.ply").write_bytes(b"before")
    (run / "metrics.before-clean.json").write_text("first")
    bpy.ops.gsopt.undo_clean()
    assert (run / "splat.ply").read_bytes() == b"before"
    assert (run / "metrics.json").read_text() == "first"
