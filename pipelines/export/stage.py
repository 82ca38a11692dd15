"""Stage 6: files for other programs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from formats.mesh import read_mesh_ply
from pipelines.config import ExportConfig
from pipelines.export.mesh import make_mesh, mesh_figures, write_mesh
from pipelines.export.writers import write_colmap, write_notes, write_ply, write_spz_file, write_trajectory
from pipelines.outcome import Outcome, load_outcome
from pipelines.progress import Progress, SilentProgress
from pipelines.run_folder import RunFolder
from pipelines.stages import Stage, StageContext
from pipelines.types import SemanticMesh


def run(context: StageContext) -> dict[str, Any]:
    """All files; a mesh that an interrupted attempt has finished is kept."""
    outcome, settings = load_outcome(context.run, context.device), context.config.export
    gaussian_map = outcome.require_map()
    write_all_but_mesh(outcome, settings, context.folder)
    mesh = _finished_mesh(context.folder)
    if mesh is None:
        mesh = make_mesh(outcome, settings, context.progress)
        write_mesh(mesh, outcome.classes.names, context.folder)
    if len(mesh.faces) == 0:
        context.warn("the mesh is empty: no surface is seen by enough keyframes")
    return {
        "images": int(outcome.trajectory.is_posed.sum()),
        "gaussians": len(gaussian_map),
        "compact_map_mb": round((context.folder / "point_cloud_compact.safetensors").stat().st_size / 1e6, 2),
        **mesh_figures(mesh),
    }


def write_all_but_mesh(outcome: Outcome, settings: ExportConfig, folder: Path) -> list[Path]:
    """COLMAP model, PLYs, trajectory, notes; the SPZ where the settings want it."""
    paths = write_colmap(outcome, folder) + write_ply(outcome, settings.sh_rest, folder)
    paths += write_spz_file(outcome, folder) if settings.spz else []
    return paths + write_trajectory(outcome, folder) + write_notes(outcome, folder)


def _finished_mesh(folder: Path) -> SemanticMesh | None:
    # The GLB is written last: where it is, the PLY is whole.
    if not (folder / "mesh.glb").exists() or not (folder / "mesh.ply").exists():
        return None
    return SemanticMesh(**vars(read_mesh_ply(folder / "mesh.ply")))


def export_run(
    run: RunFolder,
    folder: Path,
    only: str | None = None,
    progress: Progress | None = None,
    settings: ExportConfig | None = None,
) -> list[Path]:
    """Write one of the `EXPORTS`, or with None all, of a run into a folder; returns what was written.

    Settings are the run's own where none are given. Raises InputError for a run without a map.
    """
    outcome = load_outcome(run)
    outcome.require_map()
    settings = settings or outcome.config.export

    def mesh() -> list[Path]:
        found = make_mesh(outcome, settings, progress or SilentProgress())
        return write_mesh(found, outcome.classes.names, folder)

    writers: dict[str, Callable[[], list[Path]]] = {
        "colmap": lambda: write_colmap(outcome, folder),
        "ply": lambda: write_ply(outcome, settings.sh_rest, folder),
        "spz": lambda: write_spz_file(outcome, folder),
        "mesh": mesh,
        "tum": lambda: write_trajectory(outcome, folder),
    }
    return writers[only]() if only else write_all_but_mesh(outcome, settings, folder) + mesh()


STAGE = Stage("export", 1, run, "COLMAP model, Gaussian PLY, labelled mesh, trajectory")
