"""Rigid motions: 4x4 matrices and their twists.

A twist is (6,) = (translation part ρ, rotation part φ), radians, translation first. `exp(twist)` is the motion; a
*left* perturbation of a pose is `exp(twist) @ cam_from_world`. Everything takes torch tensors, in whose precision it
computes and through which it differentiates, or numpy arrays, which it takes to float64; any leading batch dimensions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..types import Array, require_shape

ArrayT = TypeVar("ArrayT", Tensor, NDArray[np.float64])

SMALL_ANGLE = 1e-4
"""Below this angle series replace the closed forms: they are exact to 1e-16 there and keep gradients finite."""


def exp(twist: ArrayT) -> ArrayT:
    """(..., 6) twist -> (..., 4, 4) motion."""
    return _on_tensors(_exp, twist)


def log(motion: ArrayT) -> ArrayT:
    """(..., 4, 4) motion -> (..., 6) twist with a rotation angle in [0, π]; the inverse of `exp`."""
    return _on_tensors(_log, motion)


def inverse(motion: ArrayT) -> ArrayT:
    """(..., 4, 4) motion -> its inverse, by transposing the rotation."""
    return _on_tensors(_inverse, motion)


def transform(motion: ArrayT, points: ArrayT) -> ArrayT:
    """(4, 4) motion applied to (..., 3) points."""
    rotation, translation = motion[:3, :3], motion[:3, 3]
    return points @ rotation.T + translation


def scaled(motion: NDArray[np.float64], scale: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """(..., 4, 4) motion with distances `scale` (...,) times as long."""
    out = motion.copy()
    out[..., :3, 3] *= np.asarray(scale)[..., None]
    return out


def rotation_angle(motion: ArrayT) -> ArrayT:
    """(..., 4, 4) motion -> (...,) rotation angle in radians, accurate near 0 and near π."""
    return _on_tensors(_rotation_angle, motion)


def hat(vector: Tensor) -> Tensor:
    """(..., 3) -> (..., 3, 3) skew matrix with hat(a) @ b = a x b."""
    x, y, z = vector.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).unflatten(-1, (3, 3))


def _on_tensors(function: Callable[[Tensor], Tensor], array: ArrayT) -> ArrayT:
    if isinstance(array, Tensor):
        return function(array)
    return function(torch.from_numpy(np.ascontiguousarray(array, dtype=np.float64))).numpy()


def _sin_cos_ratios(angle2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin θ/θ, (1-cos θ)/θ², (θ-sin θ)/θ³ from θ²; each branch of `where` sees only arguments it can differentiate."""
    small = angle2 < SMALL_ANGLE**2
    safe = torch.where(small, torch.ones_like(angle2), angle2)
    angle = safe.sqrt()
    a = torch.where(small, 1 - angle2 / 6, angle.sin() / angle)
    # 2 sin²(θ/2) keeps the digits that 1 - cos θ loses.
    b = torch.where(small, 0.5 - angle2 / 24, 2 * (angle / 2).sin() ** 2 / safe)
    c = torch.where(small, 1 / 6 - angle2 / 120, (angle - angle.sin()) / (safe * angle))
    return a, b, c


def _assemble(rotation: Tensor, translation: Tensor) -> Tensor:
    top = torch.cat([rotation, translation.unsqueeze(-1)], dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat([top, bottom], dim=-2)


def _exp(twist: Tensor) -> Tensor:
    rho, phi = twist[..., :3], twist[..., 3:]
    a, b, c = (x[..., None, None] for x in _sin_cos_ratios((phi * phi).sum(-1)))
    skew = hat(phi)
    skew2 = skew @ skew
    eye = torch.eye(3, dtype=twist.dtype, device=twist.device)
    rotation = eye + a * skew + b * skew2
    left_jacobian = eye + b * skew + c * skew2
    return _assemble(rotation, (left_jacobian @ rho.unsqueeze(-1)).squeeze(-1))


def _log(motion: Tensor) -> Tensor:
    phi = _rotation_log(motion[..., :3, :3])
    angle2 = (phi * phi).sum(-1)
    small = angle2 < SMALL_ANGLE**2
    safe = torch.where(small, torch.ones_like(angle2), angle2)
    half = safe.sqrt() / 2
    # Inverse of the left Jacobian: I - φ^/2 + (1 - (θ/2) cot(θ/2)) / θ² φ^².
    k = torch.where(small, 1 / 12 + angle2 / 720, (1 - half * half.cos() / half.sin()) / safe)[..., None, None]
    skew = hat(phi)
    eye = torch.eye(3, dtype=motion.dtype, device=motion.device)
    rho = (eye - 0.5 * skew + k * (skew @ skew)) @ motion[..., :3, 3:]
    return torch.cat([rho.squeeze(-1), phi], dim=-1)


def _rotation_log(rotation: Tensor) -> Tensor:
    """Through the unit quaternion: unlike the skew part of R it keeps all digits up to and including θ = π."""
    quat_wxyz = _quaternion(rotation)
    w, xyz = quat_wxyz[..., 0], quat_wxyz[..., 1:]
    sine2 = (xyz * xyz).sum(-1)
    small = sine2 < SMALL_ANGLE**2
    sine = torch.where(small, torch.ones_like(sine2), sine2).sqrt()
    # θ/sin(θ/2) for small angles: 2 (1/w) (1 - (s/w)²/3).
    safe_w = torch.where(small, w, torch.ones_like(w))
    factor = torch.where(small, 2 / safe_w * (1 - sine2 / (3 * safe_w**2)), 2 * torch.atan2(sine, w) / sine)
    return factor.unsqueeze(-1) * xyz


def _quaternion(rotation: Tensor) -> Tensor:
    """(..., 3, 3) -> (..., 4) wxyz with w >= 0, by that one of four formulas that divides by the most."""
    xx, yy, zz = (rotation[..., i, i] for i in range(3))
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], dim=-1)
    sums = [rotation[..., i, j] + rotation[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2))]
    differences = [rotation[..., i, j] - rotation[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))]
    (xy, xz, yz), (wx, wy, wz) = sums, differences
    rows = [
        torch.stack([squares[..., 0], wx, wy, wz], dim=-1),
        torch.stack([wx, squares[..., 1], xy, xz], dim=-1),
        torch.stack([wy, xy, squares[..., 2], yz], dim=-1),
        torch.stack([wz, xz, yz, squares[..., 3]], dim=-1),
    ]
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quaternion = torch.stack(rows, dim=-2).gather(-2, best).squeeze(-2)
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def _inverse(motion: Tensor) -> Tensor:
    transposed = motion[..., :3, :3].transpose(-1, -2)
    return _assemble(transposed, -(transposed @ motion[..., :3, 3:]).squeeze(-1))


def _rotation_angle(motion: Tensor) -> Tensor:
    return _rotation_log(motion[..., :3, :3]).norm(dim=-1)


@dataclass(frozen=True)
class Similarity:
    """target = scale * rotation @ source + translation; rotation (3, 3) in SO(3), translation (3,)."""

    scale: float
    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        require_shape("rotation", self.rotation, (3, 3))
        require_shape("translation", self.translation, (3,))
        if not self.scale > 0:
            raise ValueError(f"scale must be positive, got {self.scale}")

    def apply(self, points: NDArray) -> Array:
        """(..., 3) source points in the target's frame."""
        return self.scale * (points @ self.rotation.T) + self.translation

    def apply_to_poses(self, cam_from_source: NDArray) -> Array:
        """cam_from_target (N, 4, 4): the same cameras, rigid, after their world was mapped into the target's."""
        cam_from_target = np.tile(np.eye(4), (len(cam_from_source), 1, 1))
        rotations = cam_from_source[:, :3, :3] @ self.rotation.T
        cam_from_target[:, :3, :3] = rotations
        cam_from_target[:, :3, 3] = self.scale * cam_from_source[:, :3, 3] - rotations @ self.translation
        return cam_from_target

    def inverse(self) -> Similarity:
        """Return the inverse transform, source_from_target."""
        rotation = self.rotation.T
        return Similarity(1 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def __matmul__(self, other: Similarity) -> Similarity:
        """a_from_b @ b_from_c = a_from_c."""
        translation = self.apply(other.translation)
        return Similarity(self.scale * other.scale, self.rotation @ other.rotation, translation)


def align_points(source: NDArray, target: NDArray, with_scale: bool = True) -> Similarity:
    """Fit the similarity (or, without scale, the rigid motion) that takes source (N, 3) to target (N, 3).

    Least squares in closed form (Umeyama, PAMI 1991). Raises ValueError for fewer than three points, points
    that are not finite, or points on one line, where the rotation is not determined.
    """
    require_shape("source", source, (None, 3))
    require_shape("target", target, (len(source), 3))
    if len(source) < 3 or not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise ValueError(f"alignment needs at least three finite points, got {len(source)}")
    source_mean, target_mean = source.mean(0), target.mean(0)
    source_centred, target_centred = source - source_mean, target - target_mean
    u, d, vt = np.linalg.svd(target_centred.T @ source_centred / len(source))
    if d[1] <= 1e-12 * max(d[0], 1e-300):
        raise ValueError("alignment is not determined: the points lie on one line")
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    scale = float(d @ signs / (source_centred**2).sum(1).mean()) if with_scale else 1.0
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def best_rotation(source: Array, target: Array) -> Array:
    """(3, 3) in SO(3) that takes the directions source (N, 3) nearest to target (N, 3) (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(target.T @ source)
    return np.asarray((u * [1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt, np.float64)
