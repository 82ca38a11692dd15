"""Stage 6: files for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from formats.mesh import read_mesh_ply
from pipelines.config import ExportConfig, load_config
from pipelines.export.mesh import make_mesh, mesh_figures, write_mesh
from pipelines.export.result import Result
from pipelines.export.writers import write_colmap, write_notes, write_ply, write_trajectory
from pipelines.progress import Progress, SilentProgress
from pipelines.run_folder import RunFolder
from pipelines.stages import Stage, StageContext
from pipelines.types import SemanticMesh


def run(context: StageContext) -> dict[str, Any]:
    """All files; a mesh that an interrupted attempt has finished is kept."""
    result = Result.load(context.run)
    write_all_but_mesh(context.run, result, context.folder)
    mesh = _finished_mesh(context.folder)
    if mesh is None:
        mesh = make_mesh(result, context.config.export, context.progress)
        write_mesh(mesh, result.classes.names, context.folder)
    if len(mesh.faces) == 0:
        context.warn("the mesh is empty: no surface is seen by enough keyframes")
    return {
        "images": int(result.trajectory.is_posed.sum()),
        "gaussians": len(result.gaussian_map),
        "compact_map_mb": round((context.folder / "point_cloud_compact.safetensors").stat().st_size / 1e6, 2),
        **mesh_figures(mesh),
    }


def write_all_but_mesh(run: RunFolder, result: Result, folder: Path) -> list[Path]:
    """COLMAP model, PLYs, trajectory, notes."""
    paths = write_colmap(run, result, folder) + write_ply(result, folder) + write_trajectory(result, folder)
    return paths + write_notes(result, folder)


def _finished_mesh(folder: Path) -> SemanticMesh | None:
    # The GLB is written last: where it is, the PLY is whole.
    if not (folder / "mesh.glb").exists() or not (folder / "mesh.ply").exists():
        return None
    return SemanticMesh(**vars(read_mesh_ply(folder / "mesh.ply")))


def export_run(run: RunFolder, folder: Path, only: str | None = None, progress: Progress | None = None) -> list[Path]:
    """Write the exports ("colmap", "ply", "mesh", "tum", None = all) of a run into a folder; returns what was written.

    Raises InputError for a run without a map.
    """
    result = Result.load(run)
    settings = load_config(run.settings_file).export if run.settings_file.exists() else ExportConfig()
    if only == "colmap":
        return write_colmap(run, result, folder)
    if only == "ply":
        return write_ply(result, folder)
    if only == "tum":
        return write_trajectory(result, folder)
    mesh = make_mesh(result, settings, progress or SilentProgress())
    paths = write_mesh(mesh, result.classes.names, folder)
    return paths if only == "mesh" else write_all_but_mesh(run, result, folder) + paths


def export_colmap(run: RunFolder, folder: Path) -> list[Path]:
    """`sparse/0` (binary and text) with `frames/` beside it."""
    return export_run(run, folder, "colmap")


def export_ply(run: RunFolder, folder: Path) -> list[Path]:
    """point_cloud.ply, point_cloud_semantic.ply and the compact map."""
    return export_run(run, folder, "ply")


def export_mesh(run: RunFolder, folder: Path) -> list[Path]:
    """mesh.ply and mesh.glb."""
    return export_run(run, folder, "mesh")


def export_tum(run: RunFolder, folder: Path) -> list[Path]:
    """trajectory.txt."""
    return export_run(run, folder, "tum")


STAGE = Stage("export", 1, run, "COLMAP model, Gaussian PLY, labelled mesh, trajectory")
