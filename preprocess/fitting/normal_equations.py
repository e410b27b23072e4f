"""Gauss-Newton equations of a clip: a chain of frames that share a few parameters.

Each frame has its own parameters, coupled to those of the frame before and after it; the shared
ones (proportions, focal length) are coupled to all frames. The matrix is block tridiagonal with an
arrow, and is solved exactly in time proportional to the number of frames.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve


@dataclass(frozen=True, eq=False, kw_only=True)
class ChainEquations:
    """Normal equations of a chain of frames with shared parameters, filled in place.

    Attributes:
        blocks: Each frame's own symmetric block.
        links: Precision of the difference between a frame and the next, parameter by parameter.
        borders: Coupling of each frame with the shared parameters.
        shared: Block of the shared parameters.
        right, right_shared: Right-hand sides.
    """

    blocks: Float[np.ndarray, "frames n n"]
    links: Float[np.ndarray, "gaps n"]
    borders: Float[np.ndarray, "frames n m"]
    shared: Float[np.ndarray, "m m"]
    right: Float[np.ndarray, "frames n"]
    right_shared: Float[np.ndarray, "m"]

    @classmethod
    def empty(cls, frames: int, own: int, shared: int) -> "ChainEquations":
        """Equations without terms, for `own` parameters of each frame."""
        return cls(
            blocks=np.zeros((frames, own, own)),
            links=np.zeros((max(frames - 1, 0), own)),
            borders=np.zeros((frames, own, shared)),
            shared=np.zeros((shared, shared)),
            right=np.zeros((frames, own)),
            right_shared=np.zeros(shared),
        )

    def add(
        self,
        frame: int,
        own: Float[np.ndarray, "rows n"],
        shared: Float[np.ndarray, "rows m"],
        residuals: Float[np.ndarray, "rows"],
        weights: Float[np.ndarray, "rows"],
    ) -> None:
        """Adds weighted residuals of one frame, with their Jacobians."""
        # Gauss-Newton: JᵀWJ step = -JᵀWr, with J = [own, shared]
        heavy, heavy_shared = weights[:, None] * own, weights[:, None] * shared
        self.blocks[frame] += own.T @ heavy
        self.borders[frame] += own.T @ heavy_shared
        self.shared[:] += shared.T @ heavy_shared
        self.right[frame] -= heavy.T @ residuals
        self.right_shared[:] -= heavy_shared.T @ residuals

    def add_all(
        self,
        own: Float[np.ndarray, "frames rows n"],
        shared: Float[np.ndarray, "frames rows m"],
        residuals: Float[np.ndarray, "frames rows"],
        weights: Float[np.ndarray, "frames rows"],
    ) -> None:
        """Adds weighted residuals of all frames, with their Jacobians."""
        heavy, heavy_shared = weights[..., None] * own, weights[..., None] * shared
        own_by = own.swapaxes(1, 2)
        self.blocks[:] += own_by @ heavy
        self.borders[:] += own_by @ heavy_shared
        self.shared[:] += np.tensordot(shared, heavy_shared, axes=((0, 1), (0, 1)))
        self.right[:] -= (residuals[:, None] @ heavy)[:, 0]
        self.right_shared[:] -= np.tensordot(residuals, heavy_shared, axes=((0, 1), (0, 1)))

    def change_parameters(self, by: Float[np.ndarray, "frames n n"]) -> None:
        """Replaces each frame's parameters x by y, where x = `by` y; before there are links."""
        back = by.swapaxes(-1, -2)  # A x = b becomes (byᵀ A by) y = byᵀ b
        self.blocks[:] = back @ self.blocks @ by
        self.borders[:] = back @ self.borders
        self.right[:] = (back @ self.right[..., None])[..., 0]

    def add_chain(
        self,
        state: Float[np.ndarray, "frames n"],
        precision: Float[np.ndarray, "n"],
        links: Float[np.ndarray, "gaps n"],
    ) -> None:
        """Adds priors around 0 for each frame, and priors of equality between neighbors.

        `state` holds the present parameters, `precision` is that of each of them in one frame, and
        `links` that of the difference between neighbors.
        """
        each = np.arange(state.shape[1])
        self.blocks[:, each, each] += precision
        self.right[:] -= precision * state
        self.add_links(np.diff(state, axis=0), links)

    def add_links(
        self, apart: Float[np.ndarray, "gaps n"], links: Float[np.ndarray, "gaps n"]
    ) -> None:
        """Adds priors of equality between neighbors, `apart` from each other at present."""
        each = np.arange(links.shape[1])
        # ½ l (apart + x_next - x)²: l on both diagonals, -l between them, ±l apart on the right
        self.links[:] += links
        self.blocks[:-1, each, each] += links
        self.blocks[1:, each, each] += links
        self.right[:-1] += apart * links
        self.right[1:] -= apart * links

    def add_shared(self, precision: Float[np.ndarray, "m"], state: Float[np.ndarray, "m"]) -> None:
        """Adds priors around 0 of the shared parameters, whose present values are `state`."""
        self.shared[np.diag_indices(len(state))] += precision
        self.right_shared[:] -= precision * state

    def hold(self, shared: Float[np.ndarray, "m"], own: float) -> None:
        """Keeps parameters from changing by a large precision; 0 lets them move."""
        self.shared[np.diag_indices(len(shared))] += shared
        each = np.arange(self.right.shape[1])
        self.blocks[:, each, each] += own

    def solve(self) -> tuple[Float[np.ndarray, "frames n"], Float[np.ndarray, "m"]]:
        """The step of the frames' parameters and of the shared ones, by elimination."""
        count = len(self.right_shared)
        corner = np.column_stack([self.shared, self.right_shared])
        links = np.concatenate([self.links, np.zeros((1, self.right.shape[1]))])
        # Forward, with frames f in turn, links L, borders B and right sides r:
        # K_f = blocks_f - L K_(f-1)⁻¹ L, and [B, r]_f += L K_(f-1)⁻¹ [B, r]_(f-1);
        # the shared parameters s keep their Schur complement, shared - Σ BᵀK⁻¹B.
        reduced, passed_on = [], []  # K⁻¹ of a frame's right sides and of its links
        block, carried = np.zeros_like(self.blocks[0]), 0.0
        for frame, link in enumerate(links):
            side = np.column_stack([self.borders[frame], self.right[frame]]) + carried
            factor = cho_factor(self.blocks[frame] - block, lower=True, check_finite=False)
            both = cho_solve(factor, np.column_stack([side, np.diag(link)]), check_finite=False)
            reduced.append(both[:, : count + 1])
            passed_on.append(both[:, count + 1 :])
            corner = corner - side[:, :count].T @ reduced[-1]
            carried, block = link[:, None] * reduced[-1], link[:, None] * passed_on[-1]
        shared = np.linalg.solve(corner[:, :count], corner[:, count])
        # Backward: x_f = K_f⁻¹ (r - B s + L x_(f+1))
        found, after = np.zeros_like(self.right), np.zeros(self.right.shape[1])
        for frame in range(len(links) - 1, -1, -1):
            local = reduced[frame][:, count] - reduced[frame][:, :count] @ shared
            found[frame] = after = local + passed_on[frame] @ after
        return found, shared
