"""The mesh with a texture: lighter, unwrapped, painted from the keyframes, written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from ...formats.textured_mesh import TexturedMesh, write_textured_glb, write_textured_obj
from ..geometry.posed_depth import PosedDepth
from ..outcome import Outcome
from ..system.lru_sequence import LruSequence
from ..system.progress import Progress
from ..types import Frame, SemanticMesh
from .atlas import simplified, unwrapped
from .mesh import keyframe_rows
from .texture import Shot, paint_texture, texels_wanted

TEXTURE_SIDE = 4096
"""A texture has at most this many pixels a side: what viewers on the web and phones take."""


def make_textured(
    outcome: Outcome, mesh: SemanticMesh, views: Sequence[PosedDepth], progress: Progress
) -> TexturedMesh:
    """A tenth of the mesh's vertices, and an image of its surface from the keyframes that `views` are of."""
    shots = _shots(outcome, views)
    light = simplified(mesh)
    atlas = unwrapped(light, texels_wanted(light.vertices, light.faces, shots), TEXTURE_SIDE)
    texture = paint_texture(atlas, shots, progress)
    uv = (atlas.corners / (atlas.width, atlas.height)).astype(np.float32)
    return TexturedMesh(light.vertices, light.labels, atlas.corner_vertex, uv, atlas.corner_faces, texture)


def write_textured(
    mesh: TexturedMesh, class_names: tuple[str, ...], folder: Path, gltf_from_world: NDArray[np.float64]
) -> list[Path]:
    """mesh_textured.obj with its .mtl and .png, and mesh_textured.glb in axes that gltf_from_world (3, 3) turns to."""
    paths = write_textured_obj(folder / "mesh_textured.obj", mesh, class_names)
    turned = replace(mesh, vertices=(mesh.vertices @ gltf_from_world.T).astype(np.float32))
    write_textured_glb(folder / "mesh_textured.glb", turned, class_names)
    return [*paths, folder / "mesh_textured.glb"]


def _shots(outcome: Outcome, views: Sequence[PosedDepth]) -> Sequence[Shot]:
    frame_of = {f.id: f for f in outcome.frames}
    frames = [frame_of[int(outcome.trajectory.frame_ids[r])] for r in keyframe_rows(outcome)]
    measured = np.array([f.sharpness for f in frames])
    # Blank walls count as blurred in themselves: neighbours, which see about the same, define what is sharp there.
    usual = median_filter(measured, size=7, mode="nearest")
    sharpness = np.sqrt(np.minimum(measured / np.maximum(usual, 1e-9), 1))
    return LruSequence(
        len(frames), lambda n: _shot(outcome, frames[n], views[n], float(sharpness[n])), lambda shot: 1, 1
    )


def _shot(outcome: Outcome, frame: Frame, view: PosedDepth, sharpness: float) -> Shot:
    hidden = outcome.run.left_out(frame)
    if hidden is not None:
        size = (view.depth.shape[1], view.depth.shape[0])
        kept = cv2.resize(hidden.astype(np.uint8), size, interpolation=cv2.INTER_AREA) == 0
        view = replace(view, trust=np.where(kept, view.trust, 0).astype(np.float32))

    def photo() -> NDArray[np.float32]:
        picture = outcome.run.image(frame).astype(np.float32) / np.float32(255)
        return picture if outcome.exposure is None else outcome.exposure.remove(picture, frame.timestamp)

    return Shot(view, outcome.calibration.intrinsics, sharpness, photo)
