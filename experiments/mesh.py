"""How near does `gsopt mesh` come to the true mesh, beside the visual hull and a Poisson mesh of the splats?

    python experiments/mesh.py RUN... --meshes MESHES [--draw] [-o FILE.json]

Each RUN is a finished run on an object that scripts/synth_views.py rendered from a file in MESHES. Chamfer distance:
the mean of both directions over 200,000 points a surface, in percent of the radius of the object's bounding sphere;
of the true mesh, only points that some direction sees count. Normal consistency: mean |cosine| between the normals of
nearest points. Poisson (Kazhdan & Hoppe 2013): pymeshlab's, depth 7, on the centers of splats of opacity above 0.5,
normals along their shortest axes, turned towards the nearest camera. Runs that have a record in FILE are not measured
again. Wants pip install trimesh pymeshlab. --draw rewrites the table of docs/howto/mesh.md.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pymeshlab
import torch
import trimesh
from scipy.spatial import cKDTree

from gsopt.benchmark.machine import machine
from gsopt.benchmark.markdown import replace_block, table
from gsopt.data.scene import load_scene
from gsopt.events import to_json, write_atomic
from gsopt.geometry.focus import find_focus
from gsopt.geometry.quats import normalize, rotation_matrices
from gsopt.init.hull import carve
from gsopt.init.thumbnails import small_photos
from gsopt.results.finished_run import FinishedRun, open_run
from gsopt.results.mesh import surface
from gsopt.results.mesh.extract import FACES, VOXELS, extract_mesh
from gsopt.results.mesh.fusion import box_around, truncation
from gsopt.results.mesh.hull_distance import hull_distance, outlines

HERE = Path(__file__).resolve().parent
RESULT, PAGE = HERE / "results/mesh.json", HERE.parent / "docs/howto/mesh.md"
POINTS, DIRECTIONS, RASTER, DEPTH_MARGIN = 200_000, 96, 256, 0.02
ARMS = ("gsopt mesh", "visual hull", "Poisson")


def normalized_truth(scene: Path, meshes: Path) -> trimesh.Trimesh:
    """The true mesh in the frame of the scene."""
    found = json.loads((scene / "object.json").read_text())
    mesh = trimesh.load(next(meshes.rglob(found["mesh"])), force="mesh", process=False)
    mesh.apply_transform(np.array(found["normalized_from_mesh"]))
    return mesh


def visible(points: np.ndarray) -> np.ndarray:
    """True for points that one of many directions sees, by a raster of the nearest depths."""
    place = np.arange(DIRECTIONS) + 0.5
    z, turn = 1 - 2 * place / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * place
    flat = np.sqrt(1 - z * z)
    seen = np.zeros(len(points), bool)
    for axis in np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1):
        right = np.cross(axis, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        plane = np.stack([points @ right, points @ np.cross(axis, right)], axis=1)
        column, row = ((plane + 1.1) / 2.2 * RASTER).astype(int).clip(0, RASTER - 1).T
        depth, nearest = points @ axis, np.full(RASTER * RASTER, np.inf)
        np.minimum.at(nearest, row * RASTER + column, depth)
        seen |= depth <= nearest[row * RASTER + column] + DEPTH_MARGIN
    return seen


def samples(mesh: trimesh.Trimesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=1)
    return np.asarray(points), np.asarray(mesh.face_normals[faces])


def distances(truth: tuple[np.ndarray, np.ndarray], mesh: trimesh.Trimesh) -> dict[str, Any]:
    """Chamfer distance, % of the radius; normal consistency."""
    (p, p_normals), (q, q_normals) = truth, samples(mesh, POINTS)
    to_truth, there = cKDTree(p).query(q)
    to_mesh, here = cKDTree(q).query(p)
    agree = np.abs((q_normals * p_normals[there]).sum(1)).mean() + np.abs((p_normals * q_normals[here]).sum(1)).mean()
    return {
        "chamfer": round(50 * float(to_truth.mean() + to_mesh.mean()), 4),
        "normals": round(float(agree) / 2, 4),
        "faces": len(mesh.faces),
        "closed": bool(mesh.is_watertight),
    }


def hull_mesh(run: FinishedRun) -> trimesh.Trimesh:
    """The visual hull of the input silhouettes, decimated alike."""
    scene = load_scene(run.config.data)
    photos = small_photos(scene.train, 64)
    cells = carve(photos, find_focus([photo.camera for photo in photos], scene.extent))
    assert cells is not None
    centers = cells.centers()
    box = box_around(centers.amin(0) - cells.voxel, centers.amax(0) + cells.voxel, VOXELS)
    parts = [hull_distance(outlines(photos), points, truncation(box)) for points in box.chunks()]
    field = surface.tidied(torch.cat(parts).view(box.shape))
    vertices, faces = surface.triangulated(field, box)
    vertices, faces = surface.decimated(surface.smoothed(vertices, faces), faces, FACES)
    return trimesh.Trimesh(vertices, faces, process=False)


def poisson_mesh(run: FinishedRun) -> trimesh.Trimesh:
    """A Poisson mesh of the centers of the opaque splats."""
    splats = run.gaussians.select(run.gaussians.opacities > 0.5)
    turns = rotation_matrices(normalize(splats.quats))
    shortest = splats.log_scales.argmin(dim=1)
    normals = turns.gather(2, shortest[:, None, None].expand(-1, 3, 1))[:, :, 0]
    cameras = torch.cat([view.camera.centers for view in load_scene(run.config.data).train])
    nearest = cameras[torch.cdist(splats.means, cameras).argmin(dim=1)]
    normals = torch.where(((nearest - splats.means) * normals).sum(1, keepdim=True) < 0, -normals, normals)
    session = pymeshlab.MeshSet()
    session.add_mesh(pymeshlab.Mesh(splats.means.double().numpy(), v_normals_matrix=normals.double().numpy()))
    session.generate_surface_reconstruction_screened_poisson(depth=7, threads=1)
    mesh = session.current_mesh()
    return trimesh.Trimesh(mesh.vertex_matrix(), mesh.face_matrix(), process=False)


def measured(path: Path, meshes: Path) -> dict[str, Any]:
    """The record of a run."""
    run = open_run(path, threads=1)
    scene = Path(run.config.data.path)
    points, normals = samples(normalized_truth(scene, meshes), 5 * POINTS)
    rows = np.random.default_rng(0).permutation(np.flatnonzero(visible(points)))[:POINTS]
    truth = points[rows], normals[rows]
    mesh = extract_mesh(run)
    ours = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    found = zip(ARMS, (ours, hull_mesh(run), poisson_mesh(run)), strict=True)
    record = {"run": path.name, "object": scene.name, "views": len(load_scene(run.config.data).train)}
    return record | {name: distances(truth, arm) for name, arm in found}


def drawn(runs: list[dict[str, Any]]) -> str:
    """Means over objects for each number of views."""
    rows = []
    for views in sorted({run["views"] for run in runs}):
        some = [run for run in runs if run["views"] == views]
        cells = []
        for key in ("chamfer", "normals"):
            for arm in ARMS:
                cells.append(f"{np.mean([run[arm][key] for run in some]):.{2 if key == 'chamfer' else 3}f}")
        best = sum(run[ARMS[0]]["chamfer"] <= min(run[arm]["chamfer"] for arm in ARMS) for run in some)
        closed = sum(run[ARMS[0]]["closed"] for run in some)
        rows.append([str(views), str(len(some)), *cells, f"{best} of {len(some)}", f"{closed} of {len(some)}"])
    head = ["views", "objects", *(f"Chamfer: {arm}, %" for arm in ARMS), *(f"normals: {arm}" for arm in ARMS)]
    return table([*head, "nearest", "closed"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--meshes", type=Path)
    parser.add_argument("-o", type=Path, default=RESULT)
    parser.add_argument("--draw", action="store_true")
    flags = parser.parse_args()
    torch.set_num_threads(1)
    document = json.loads(flags.o.read_text()) if flags.o.exists() else {"runs": []}
    for path in flags.runs:
        if path.name in {run["run"] for run in document["runs"]}:
            continue
        document["runs"].append(measured(path, flags.meshes))
        print(document["runs"][-1], flush=True)
        write_atomic(flags.o, to_json({**document, "machine": machine()}))
    print(drawn(document["runs"]))
    if flags.draw:
        replace_block(PAGE, "mesh", drawn(document["runs"]))


if __name__ == "__main__":
    main()
