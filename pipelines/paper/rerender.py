"""Keyframes drawn into each other, and the normal equations of that: what (25) and (26) are minimised by.

A keyframe's Gaussians begin as one per pixel, of the pixel's colour, class and scaled proxy depth. Drawn so into other
keyframes they show where poses and depths disagree; the optimised colours of the map fit whatever depth they have.
The depth is the proxy's times a smooth field, because a network is off by several per cent, smoothly over an image: the
nodes of the field are unknowns beside the pose. Steps are those of Gauss and Newton.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

from ..depth.fields import FINE, Basis
from ..geometry import se3
from ..geometry.camera import project, unproject
from ..mapping.views import View
from ..types import VOID, Intrinsics
from .uncertainty import PAPER, Constants

Array = NDArray[np.float64]
CELL = 6
"""Of each square of so many pixels the one on the strongest edge is drawn."""
SD_COLOR, SD_CLASS, SD_DEPTH = 0.02, 0.2, 0.05
"""Of colours and class colours in 0..1 and of log depths; larger differences count less and less (Cauchy)."""
FIELD_SD, STEP_SD = 0.4, 0.2
"""Of a field's nodes, and of the differences between neighbours: weak, for many pixels say the same."""
POSE_SD = 0.05
"""Of a pose beside where it was, in scene depths and radians: weak beside what is drawn."""
SAME_SURFACE = 0.15
"""Log depths this near are of one surface: what lies deeper is hidden."""
_BLUR, _CLASS_BLUR = 0.7, 2.0
_PALETTE_SEED = 7
_UNKNOWNS = 6 + FINE.size
"""Of a keyframe: twist and field."""
_ROW = 20
"""Entries in a row of the Jacobian: two twists and four nodes of each field."""
_PAIRS_AT_ONCE = 32
"""Whose rows are held together: 30 MB."""
_DAMPINGS = (1e-6, 1e-3)
"""Tried one after the other. A path bends along motions that hardly any pixel sees: more damping holds it bent."""
_DIRECT = 3000
"""Up to so many unknowns the normal equations are solved directly."""


@dataclass(frozen=True)
class Samples:
    """A keyframe as it is drawn and drawn into.

    rays (n, 3) of depth 1, depth (n,), weight (n,), place in the field and planes (n, C) of some pixels; labelled (n,):
    whether they have a class; image (H, W, C) uint8 of all: colours, then class colours; log_depth (H, W), nan where
    unknown.
    """

    camera: Intrinsics
    rays: Array
    depth: Array
    weight: Array
    basis: Basis
    planes: Array
    labelled: NDArray[np.bool_]
    image: NDArray[np.uint8]
    log_depth: NDArray[np.float32]


def sample(view: View, classes: int, constants: Constants = PAPER, cell: int = CELL) -> Samples:
    """Take pixels on edges, spread evenly over a view, where its depth is not unreliable: one of cell x cell."""
    depth, trust, image = view.depth.numpy(), view.trust.numpy(), _planes(view, classes)
    known = (depth > 0) & (trust > constants.tau_low)
    if view.scene is not None:
        known &= view.scene.numpy()
    down, right = np.gradient(image[..., :3].mean(-1))
    strength = np.where(known, np.hypot(down, right) + 1e-3, 0)
    h, w = (n // cell for n in strength.shape)
    cells = strength[: h * cell, : w * cell].reshape(h, cell, w, cell).swapaxes(1, 2).reshape(h * w, cell * cell)
    best, at = cells.argmax(1), np.flatnonzero(cells.max(1) > 0)
    row, column = at // w * cell + best[at] // cell, at % w * cell + best[at] % cell
    xy, camera = np.stack([column + 0.5, row + 0.5], 1), view.intrinsics
    return Samples(
        camera, unproject(xy, np.ones(len(xy)), camera), depth[row, column].astype(np.float64),
        trust[row, column].astype(np.float64), FINE.at(xy, camera.width, camera.height),
        image[row, column] / 255, view.channels.numpy()[row, column] != VOID, image,
        np.log(np.where(depth > 0, depth, np.nan)).astype(np.float32),
    )  # fmt: skip


def _planes(view: View, classes: int) -> NDArray[np.uint8]:
    """(H, W, 3 or 6) a little blurred, so that there is a slope to go down: colours, and classes in colours drawn at
    random, which are as far from each other as classes are."""
    planes = [cv2.GaussianBlur(view.colors.numpy(), (0, 0), _BLUR)]
    if classes:
        channels = view.channels.numpy()
        known = (channels != VOID).astype(np.float32)
        palette = np.random.default_rng(_PALETTE_SEED).random((classes + 1, 3)).astype(np.float32)
        drawn = cv2.GaussianBlur(palette[np.minimum(channels, classes)] * known[..., None], (0, 0), _CLASS_BLUR)
        planes.append(drawn / np.maximum(cv2.GaussianBlur(known, (0, 0), _CLASS_BLUR), 1e-3)[..., None])
    return np.asarray(np.clip(np.concatenate(planes, -1) * 255, 0, 255).round(), np.uint8)


def looked_up(image: NDArray, xy: Array) -> tuple[Array, Array]:
    """Bilinear values (n, C) of an image (H, W, C) at pixels xy (n, 2), and their derivatives (n, C, 2) to these."""
    at = np.clip(np.floor(xy - 0.5).astype(int), 0, [image.shape[1] - 2, image.shape[0] - 2])
    (left, top), (fx, fy) = at.T, ((xy - 0.5) - at).T[..., None]
    a, b, c, d = (image[top + y, left + x].astype(np.float64) for y in (0, 1) for x in (0, 1))
    upper, lower = a + fx * (b - a), c + fx * (d - c)
    return upper + fy * (lower - upper), np.stack([(1 - fy) * (b - a) + fy * (d - c), lower - upper], -1)


@dataclass
class Redrawn:
    """n pixels of a keyframe in another: which, where (n, 3) in either camera, and what differs.

    photo (n, C) differences in standard deviations, their slopes (n, C, 2) over the image and weights (n, C); deep (n,)
    log depths likewise, with slopes (n, 2); basis: the other's field there.
    """

    rows: NDArray[np.int64]
    here: Array
    there: Array
    photo: Array
    slopes: Array
    terms: Array
    deep: Array
    deep_slopes: Array
    basis: Basis


@dataclass
class Rerendering:
    """Keyframes by place: poses (N, 4, 4) cam_from_world and log fields (N, nodes), of which those move and bend (N,)
    bool are unknowns; of each pair (i, j) keyframe i is drawn into j. The pose term of (25) holds poses to start
    (N, 4, 4); unit: the scene's depth."""

    samples: Sequence[Samples]
    poses: Array
    fields: Array
    moves: NDArray[np.bool_]
    bends: NDArray[np.bool_]
    pairs: Sequence[tuple[int, int]]
    unit: float
    start: Array
    constants: Constants = PAPER

    def drawn(self, i: int, j: int) -> Redrawn:
        """Draw i into j: pixels that land inside, on the surface that j sees."""
        mine, other, c = self.samples[i], self.samples[j], self.constants
        here = mine.rays * (mine.depth * np.exp(mine.basis.of(self.fields[i])))[:, None]
        there = se3.transform(self.poses[j] @ se3.inverse(self.poses[i]), here)
        xy, z = project(there, other.camera)
        size = np.array([other.camera.width, other.camera.height])
        rows = np.flatnonzero((z > 0) & (xy > 1).all(1) & (xy < size - 1).all(1))
        log_depth, deep_slopes = looked_up(other.log_depth[..., None], xy[rows])
        basis = FINE.at(xy[rows], *size)
        deep = np.log(z[rows]) - log_depth[:, 0] - basis.of(self.fields[j])
        same = np.flatnonzero(np.abs(np.nan_to_num(deep, nan=np.inf)) < SAME_SURFACE)
        rows = rows[same]
        values, slopes = looked_up(other.image, xy[rows])
        photo, sd = semantic_residual(values / 255, mine.planes[rows]), deviations(values.shape[1])
        terms = np.tile(np.array([c.map_color / 3] * 3 + [c.xi] * (values.shape[1] - 3)), (len(rows), 1))
        terms[~mine.labelled[rows], 3:] = 0
        deep_slopes = deep_slopes[same, 0] + _field_slopes(self.fields[j], basis[same], size)
        return Redrawn(
            rows, here[rows], there[rows], photo, slopes / (255 * sd[:, None]), terms,
            deep[same] / SD_DEPTH, deep_slopes / SD_DEPTH, basis[same],
        )  # fmt: skip

    def cost(self) -> float:
        """Mean over the pixels drawn of log(1 + r²) of photo and of depth residuals; infinite where none is drawn."""
        total, count = 0.0, 0
        for i, j in self.pairs:
            seen = self.drawn(i, j)
            photo, deep = np.log1p((seen.terms * seen.photo**2).sum(1)), np.log1p(seen.deep**2)
            total += float((self.samples[i].weight[seen.rows] * (photo + self.constants.map_depth * deep)).sum())
            count += len(seen.rows)
        return total / count if count else np.inf

    def equations(self, i: int, j: int) -> tuple[Array, NDArray[np.int64], Array]:
        """Rows (3 n, 20) of the weighted Jacobian, the unknowns (3 n, 20) that they are of, and residuals (3 n,).

        All colours of a pixel pull at its place in the image: two rows stand for them, the third for the depth.
        """
        seen, mine, other = self.drawn(i, j), self.samples[i], self.samples[j].camera
        n, weight = len(seen.rows), mine.weight[seen.rows]
        by_photo = np.sqrt(weight / (1 + (seen.terms * seen.photo**2).sum(1)))
        by_depth = np.sqrt(self.constants.map_depth * weight / (1 + seen.deep**2))
        weighted = seen.slopes * seen.terms[..., None]
        root = np.linalg.cholesky(np.swapaxes(weighted, 1, 2) @ seen.slopes + 1e-6 * np.eye(2))
        pull = np.linalg.solve(root, (np.swapaxes(weighted, 1, 2) @ seen.photo[..., None]))[..., 0]
        x, y, z = seen.there.T
        to_image = np.zeros((n, 2, 3))
        to_image[:, 0, 0], to_image[:, 0, 2] = other.fx / z, -other.fx * x / z**2
        to_image[:, 1, 1], to_image[:, 1, 2] = other.fy / z, -other.fy * y / z**2
        deeper = -(seen.deep_slopes[:, None] @ to_image)
        deeper[:, 0, 2] += 1 / (SD_DEPTH * z)
        scale = np.stack([by_photo, by_photo, by_depth], 1)
        to_rows = np.concatenate([np.swapaxes(root, 1, 2) @ to_image, deeper], 1) * scale[..., None]
        rotation = (self.poses[j] @ se3.inverse(self.poses[i]))[:3, :3]
        along = (seen.here @ rotation.T)[:, :, None] * mine.basis.weights[seen.rows][:, None]
        bent = np.zeros((n, 3, 4))
        bent[:, 2] = -seen.basis.weights * (by_depth / SD_DEPTH)[:, None]
        values = [to_rows @ _moving(seen.there), -to_rows @ rotation @ _moving(seen.here), to_rows @ along, bent]
        twist = np.tile(np.arange(6), (n, 1))
        nodes = [mine.basis.nodes[seen.rows] + i * _UNKNOWNS + 6, seen.basis.nodes + j * _UNKNOWNS + 6]
        unknowns = np.concatenate([twist + j * _UNKNOWNS, twist + i * _UNKNOWNS, *nodes], 1)
        residuals = np.concatenate([pull, seen.deep[:, None]], 1) * scale
        return np.concatenate(values, 2).reshape(-1, _ROW), unknowns.repeat(3, 0), residuals.reshape(-1)

    def priors(self) -> tuple[sparse.csr_matrix, Array]:
        """Rows and residuals of what is known beforehand: fields are small and smooth, poses about where they were."""
        node = np.arange(FINE.size).reshape(FINE.rows, FINE.columns)
        first = np.concatenate([node[:, :-1].ravel(), node[:-1].ravel()])
        second = np.concatenate([node[:, 1:].ravel(), node[1:].ravel()])
        eye = sparse.identity(FINE.size, format="csr")
        field = sparse.vstack([eye / FIELD_SD, (eye[second] - eye[first]) / STEP_SD])
        block = sparse.block_diag([sparse.diags(1 / pose_deviations(self.unit)), field])
        residuals = np.concatenate([pose_term(self.poses, self.start, self.unit), (field @ self.fields.T).T], 1)
        return sparse.kron(sparse.identity(len(self.samples)), block, "csr"), residuals.ravel()

    def stepped(self, damping: float) -> Rerendering:
        """Poses and fields after a step of Gauss and Newton, of Levenberg's and Marquardt's damping."""
        n = len(self.samples)
        free = np.repeat(np.stack([self.moves, self.bends], 1).ravel(), np.tile([6, FINE.size], n))
        prior, apart = self.priors()
        normal, right = prior.T @ prior, -(prior.T @ apart)
        for begin in range(0, len(self.pairs), _PAIRS_AT_ONCE):
            parts = [self.equations(i, j) for i, j in self.pairs[begin : begin + _PAIRS_AT_ONCE]]
            values, unknowns, residuals = (np.concatenate(p) for p in zip(*parts, strict=True))
            shape, ends = (len(values), n * _UNKNOWNS), np.arange(0, values.size + 1, _ROW)
            rows = sparse.csr_matrix((values.ravel(), unknowns.ravel(), ends), shape)
            normal, right = normal + rows.T @ rows, right - rows.T @ residuals
        mask = sparse.diags(free.astype(float))
        diagonal = np.where(free, damping * normal.diagonal() + 1e-12, 1.0)
        normal = (mask @ normal @ mask + sparse.diags(diagonal)).tocsr()
        delta = _solved(normal, np.where(free, right, 0.0))
        each = delta.reshape(n, _UNKNOWNS)
        return replace(self, poses=se3.exp(each[:, :6]) @ self.poses, fields=self.fields + each[:, 6:])

    def minimised(self, steps: int) -> Rerendering:
        """At most so many steps, as long as they lower the cost."""
        best, cost = self, self.cost()
        for _ in range(steps):
            tried = ((there := best.stepped(d), there.cost()) for d in _DAMPINGS)
            there, found = next((t for t in tried if t[1] < cost), (best, cost))
            gain, best, cost = cost - found, there, found
            if not gain >= 0.002 * cost:  # no number where nothing was drawn
                break
        return best


def _solved(normal: sparse.csr_matrix, right: Array) -> Array:
    """(U,) the solution: of few keyframes at once, of many by conjugate gradients, each keyframe's own block undone."""
    if len(right) <= _DIRECT:
        return np.asarray(np.linalg.solve(normal.toarray(), right))
    begins = range(0, len(right), _UNKNOWNS)
    own = np.linalg.inv(np.stack([normal[b : b + _UNKNOWNS, b : b + _UNKNOWNS].toarray() for b in begins]))

    def undone(vector: Array) -> Array:
        return (own @ vector.reshape(len(own), _UNKNOWNS, 1)).ravel()

    before = LinearOperator(normal.shape, matvec=undone, dtype=np.float64)
    return np.asarray(cg(normal, right, rtol=1e-5, maxiter=1000, M=before)[0])


def pose_term(poses: Array, start: Array, unit: float) -> Array:
    """First term of Eq. (25): (N, 6) twists from start to poses (N, 4, 4), in their deviations."""
    return se3.log(poses @ se3.inverse(start)) / pose_deviations(unit)


def pose_deviations(unit: float) -> Array:
    """(6,) of a twist: in scene depths and radians."""
    return POSE_SD * np.array([unit] * 3 + [1.0] * 3)


def semantic_residual(drawn: Array, seen: Array) -> Array:
    """Second term of Eq. (26): S_k - S(E_i, G_k) of n pixels, as colours and class colours in 0..1 (n, C) drawn and
    seen, divided by their deviations."""
    return (drawn - seen) / deviations(drawn.shape[1])


def deviations(planes: int) -> Array:
    """(C,) of colours, and of the class colours after them."""
    return np.array([SD_COLOR] * 3 + [SD_CLASS] * (planes - 3))


def _field_slopes(field: Array, at: Basis, size: NDArray[np.int64]) -> Array:
    """(n, 2) derivatives of a field (nodes,) to pixels of an image of that size (width, height)."""
    a, b, c, d = field[at.nodes].T
    right, down = at.weights[:, [1, 3]].sum(1), at.weights[:, 2:].sum(1)
    slopes = np.stack([(b - a) * (1 - down) + (d - c) * down, (c - a) * (1 - right) + (d - b) * right], 1)
    turn = slice(None, None, 1 if size[0] >= size[1] else -1)  # a grid's columns lie along the longer side
    return (slopes * ([FINE.columns - 1, FINE.rows - 1] / size[turn]))[:, turn]


def _moving(points: Array) -> Array:
    """(n, 3, 6) derivative of points (n, 3) to a twist: the identity, and a turn."""
    out = np.zeros((len(points), 3, 6))
    out[:, :, :3] = np.eye(3)
    x, y, z = points.T
    out[:, 0, 4], out[:, 0, 5], out[:, 1, 5] = z, -y, x
    out[:, 1, 3], out[:, 2, 3], out[:, 2, 4] = -z, y, -x
    return out
