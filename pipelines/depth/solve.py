"""The one solver of scale fields: robust linear equations between nodes, a prior and smoothness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import cg

from pipelines.depth.fields import Basis, Grid

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Prior:
    """How far, relatively, a node strays from where it is expected (node_sd) and from its neighbours (step_sd)."""

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


def solve_fields(parts: Sequence[Equations], fields: Array, expected: Array, prior: Prior) -> Array:
    """(N, nodes) the fields after one step: Cauchy-weighted equations, and `expected` (N, nodes) as far as the prior
    holds them to it."""
    normal = sparse.kron(sparse.identity(len(fields)), prior.normal(), format="csr")
    right = -(normal @ (fields - expected).reshape(-1))
    rows, columns, weights, residuals = [], [], [], []
    offset = 0
    for part in parts:
        certainty = np.sqrt(part.share / (1 + (part.residual / part.sd) ** 2)) / part.sd
        rows.append(np.repeat(np.arange(offset, offset + len(certainty)), part.columns.shape[1]))
        columns.append(part.columns.ravel())
        weights.append((part.weights * certainty[:, None]).ravel())
        residuals.append(part.residual * certainty)
        offset += len(certainty)
    if offset:
        places = (np.concatenate(rows), np.concatenate(columns))
        design = sparse.csr_matrix((np.concatenate(weights), places), shape=(offset, fields.size))
        normal = normal + design.T @ design
        right = right - design.T @ np.concatenate(residuals)
    change, _ = cg(normal, right, rtol=1e-6, maxiter=500, M=sparse.diags(1 / normal.diagonal()))
    return fields + change.reshape(fields.shape)
