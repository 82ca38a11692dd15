"""The textured mesh against the one with vertex colours: both drawn from the cameras of a run, against its pictures.

    python tests/benchmarks/textured_mesh.py RUN.msgs [--folder DIR]      exported files of the run, or those in DIR

dB over the pixels that both meshes cover, with each picture's exposure, mean over pictures; "between" are the frames
that no mesh was made from. Drawn with four samples a pixel. "Holes": background within five pixels of the mesh or
enclosed by it, as a share of the silhouette, in five keyframes spread over the path.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes

from msgs_slam.formats.glb import read_mesh_glb
from msgs_slam.formats.images import write_rgb
from msgs_slam.formats.ply import read_mesh_ply
from msgs_slam.pipelines.evaluation.metrics import psnr
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.scene.world import WORLD
from msgs_slam.pipelines.system.raster import draw_faces
from msgs_slam.pipelines.types import Intrinsics

SAMPLES = 2
"""A side of a pixel."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--folder", type=Path, help="where the exported files lie; default: in the run")
    parser.add_argument("--every", type=int, default=1, help="draw every n-th frame")
    parser.add_argument("--picture", type=Path, help="write photograph, vertex colours and texture side by side")
    args = parser.parse_args()
    measure(args.run, args.folder or args.run / "export", args.every, args.picture)


def measure(root: Path, folder: Path, every: int, picture: Path | None) -> None:
    """One line for the keyframes, one for the frames between."""
    outcome = load_outcome(RunFolder(root))
    outcome = outcome.moved((world := WORLD.read(folder / "world.json")).exported_from_run)
    trajectory, camera = outcome.trajectory, outcome.calibration.intrinsics
    plain = read_mesh_ply(folder / "mesh.ply")
    drawers = [
        VertexColours(plain.vertices, plain.faces, plain.colors),
        Light(folder / "mesh.glb", world.gltf_from_exported),
    ]
    rows: dict[bool, list[tuple[float, ...]]] = {True: [], False: []}
    sheets = []
    for row in np.flatnonzero(trajectory.is_posed)[::every]:
        frame = next(f for f in outcome.frames if f.id == trajectory.frame_ids[row])
        photo, drawn = outcome.run.image(frame), []
        for drawer in drawers:
            color, covered = drawer.draw(trajectory.cam_from_world[row], camera)
            if outcome.exposure is not None:
                color = outcome.exposure.apply(color, frame.timestamp)
            drawn.append((np.round(color.clip(0, 1) * 255).astype(np.uint8), covered))
        both = drawn[0][1] & drawn[1][1]
        if both.any():
            figures = [psnr(color, photo, both) for color, _ in drawn]
            rows[bool(trajectory.is_keyframe[row])].append((*figures, *(covered.mean() for _, covered in drawn)))
        sheets.append(np.concatenate([photo, *(np.where(c[..., None], d, 0) for d, c in drawn)], axis=1))
    light = drawers[1]
    print(f"{root.name}: faces {len(plain.faces)} / {len(light.faces)}, texture {light.picture.shape[:2]}")
    for is_keyframe, name in ((True, "keyframes"), (False, "between")):
        if rows[is_keyframe]:
            a, b, seen, seen_textured = np.mean(rows[is_keyframe], axis=0)
            print(
                f"  {name} {len(rows[is_keyframe])}: vertex colours {a:.2f} dB, texture {b:.2f} dB ({b - a:+.2f}); "
                f"covered {100 * seen:.1f} / {100 * seen_textured:.1f} %"
            )
    keyframes = np.flatnonzero(trajectory.is_keyframe)
    shares = []
    for row in keyframes[np.linspace(0, len(keyframes) - 1, 5).astype(int)]:
        shares.append([holes(drawer.draw(trajectory.cam_from_world[row], camera)[1]) for drawer in drawers])
    print("  holes, % of all vertices / textured: " + ", ".join(f"{100 * a:.2f} / {100 * b:.2f}" for a, b in shares))
    if picture is not None:
        picked = np.linspace(0, len(sheets) - 1, min(len(sheets), 5)).astype(int)
        write_rgb(picture, np.concatenate([sheets[i] for i in picked]))


def holes(covered: NDArray) -> float:
    """The share of the silhouette (H, W) that shows the background: slits, and what the mesh encloses."""
    ball = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (11, 11))
    padded = np.pad(covered.astype(np.uint8), 8, mode="edge")
    near = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, ball)[8:-8, 8:-8] > 0
    silhouette = binary_fill_holes(near | covered)
    return float((silhouette & ~covered).sum() / max(silhouette.sum(), 1))


class Drawer:
    """Triangles to samples; what colour a sample has is for subclasses to say."""

    def __init__(self, vertices: NDArray, faces: NDArray) -> None:
        self.vertices, self.faces = vertices.astype(np.float64), np.ascontiguousarray(faces, np.int32)

    def draw(self, cam_from_world: NDArray, camera: Intrinsics) -> tuple[NDArray, NDArray]:
        """color (H, W, 3) 0..1, covered (H, W) bool: every sample of the pixel shows a face."""
        fine = camera.resized(camera.width * SAMPLES, camera.height * SAMPLES)
        drawn = draw_faces(self.vertices, self.faces, cam_from_world, fine)
        hit = drawn.face >= 0
        color = np.zeros((*hit.shape, 3), np.float32)
        color[hit] = self.colors_at(drawn.face[hit], drawn.shares[hit])
        blocks = (camera.height, SAMPLES, camera.width, SAMPLES)
        return color.reshape(*blocks, 3).mean(axis=(1, 3)), hit.reshape(blocks).all(axis=(1, 3))

    def colors_at(self, face: NDArray, shares: NDArray) -> NDArray:
        raise NotImplementedError


class VertexColours(Drawer):
    def __init__(self, vertices: NDArray, faces: NDArray, colors: NDArray) -> None:
        super().__init__(vertices, faces)
        self.colors = colors / np.float32(255)

    def colors_at(self, face: NDArray, shares: NDArray) -> NDArray:
        return np.einsum("nk,nkc->nc", shares, self.colors[self.faces[face]])


class Light(Drawer):
    """The lighter mesh, with its texture or its vertices' colours."""

    def __init__(self, path: Path, gltf_from_world: NDArray) -> None:
        mesh = read_mesh_glb(path)
        super().__init__(mesh.vertices @ gltf_from_world, mesh.faces)
        self.uv, self.picture, self.colors = mesh.corner_uv, mesh.texture, mesh.colors / np.float32(255)

    def colors_at(self, face: NDArray, shares: NDArray) -> NDArray:
        if not self.picture.size:
            return np.einsum("nk,nkc->nc", shares, self.colors[self.faces[face]])
        uv = np.einsum("nk,nkc->nc", shares, self.uv[self.faces[face]])
        height, width = self.picture.shape[:2]
        x, y = (uv[:, 0] * width - 0.5).astype(np.float32), (uv[:, 1] * height - 0.5).astype(np.float32)
        out = np.empty((len(face), 3), np.float32)
        for a in range(0, len(face), 30000):  # OpenCV takes pictures of at most 32767 a side
            part = slice(a, a + 30000)
            out[part] = cv2.remap(self.picture, x[None, part], y[None, part], cv2.INTER_LINEAR)[0] / np.float32(255)
        return out


if __name__ == "__main__":
    main()
