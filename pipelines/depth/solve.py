"""The one solver of scale fields: robust linear equations between nodes, a prior and smoothness."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import cg

from .fields import Basis, Grid

Array = NDArray[np.float64]
_ROWS_AT_ONCE = 200_000
_MOST_ITERATIONS = 500
"""Of conjugate gradients; 600 keyframes that hang together by pairs alone took 129."""
log = logging.getLogger("msgs_slam")


@dataclass(frozen=True)
class Prior:
    """Relative standard deviation of a node from its expected value (node_sd) and from its neighbours (step_sd)."""

    grid: Grid
    node_sd: float
    step_sd: float

    def normal(self) -> sparse.csr_matrix:
        """(nodes, nodes) normal matrix of "a node is 0" and "neighbouring nodes are equal"."""
        index = np.arange(self.grid.size).reshape(self.grid.rows, self.grid.columns)
        sides = ((index[:, :-1], index[:, 1:]), (index[:-1], index[1:]))
        pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in sides])
        step = sparse.coo_matrix(
            (np.tile([1.0, -1.0], len(pairs)), (np.repeat(np.arange(len(pairs)), 2), pairs.ravel())),
            shape=(len(pairs), self.grid.size),
        ).tocsr()
        return sparse.identity(self.grid.size) / self.node_sd**2 + step.T @ step / self.step_sd**2


@dataclass(frozen=True)
class Equations:
    """Q linear equations residual + Σ weight * change = 0 between nodes of all fields, numbered through.

    columns and weights (Q, E), residual and sd (Q,). `share`: neighbouring samples may err alike; each then counts as
    so much of an equation.
    """

    columns: NDArray[np.int64]
    weights: Array
    residual: Array
    sd: Array
    share: float = 1.0

    @staticmethod
    def of_places(
        field: NDArray[np.int64] | int, basis: Basis, size: int, residual: Array, sd: Array, share: float
    ) -> Equations:
        """One place of one field each: field (Q,) or a number, `size` nodes a field."""
        columns = basis.nodes + np.reshape(np.asarray(field), (-1, 1)) * size
        return Equations(columns, basis.weights, residual, sd, share)

    def within(self, own: range) -> Equations:
        """With nodes of some fields as the unknowns, counted from the first of them: the others stay as they are."""
        inside = (self.columns >= own.start) & (self.columns < own.stop)
        columns, weights = np.where(inside, self.columns - own.start, 0), np.where(inside, self.weights, 0.0)
        return replace(self, columns=columns, weights=weights)


def solve_fields(parts: Iterable[Equations], fields: Array, expected: Array, prior: Prior) -> Array:
    """(N, nodes) the fields after one step: Cauchy-weighted equations, and `expected` (N, nodes) as far as the prior
    holds them to it. Where the step does not converge, a warning is logged and the fields stay as they were."""
    normals = [sparse.kron(sparse.identity(len(fields)), prior.normal(), format="csr")]
    right = -(normals[0] @ (fields - expected).reshape(-1))
    for design, residual in _designs(parts, fields.size):
        normals.append((design.T @ design).tocsr())
        right = right - design.T @ residual
        # Like sizes are added to each other: the whole is not copied for every part.
        while len(normals) > 1 and normals[-2].nnz <= 2 * normals[-1].nnz:
            normals[-2:] = [normals[-2] + normals[-1]]
    normal = sum(normals[:-1], normals[-1])
    change, unsolved = cg(normal, right, rtol=1e-6, maxiter=_MOST_ITERATIONS, M=sparse.diags(1 / normal.diagonal()))
    if unsolved:
        log.warning(
            "the scales of depth of %d keyframes did not converge in %d iterations and stay as they were: depth may "
            "disagree between these keyframes. Check the depth files or the depth network",
            len(fields),
            _MOST_ITERATIONS,
        )
        return fields
    return fields + change.reshape(fields.shape)


def _designs(parts: Iterable[Equations], size: int) -> Iterator[tuple[sparse.csr_matrix, Array]]:
    """The weighted equations as matrices (Q, size) of some hundred thousand rows, and their residuals (Q,): all of a
    long recording would take gigabytes."""
    waiting: list[Equations] = []
    for part in chain(parts, (None,)):
        if part is not None:
            waiting.append(part)
        if waiting and (part is None or sum(len(p.residual) for p in waiting) >= _ROWS_AT_ONCE):
            certainties = [np.sqrt(p.share / (1 + (p.residual / p.sd) ** 2)) / p.sd for p in waiting]
            certainty = np.concatenate(certainties)
            each = [(c[:, None] * p.weights).ravel() for c, p in zip(certainties, waiting, strict=True)]
            starts = np.cumsum(np.concatenate([[0], *(np.full(len(p.residual), p.columns.shape[1]) for p in waiting)]))
            columns = np.concatenate([p.columns.ravel() for p in waiting])
            design = sparse.csr_matrix((np.concatenate(each), columns, starts), shape=(len(certainty), size))
            yield design, np.concatenate([p.residual for p in waiting]) * certainty
            waiting.clear()
