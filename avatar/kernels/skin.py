"""What linear blend skinning and its inverse mean, in plain torch."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def interpolate_volume(
    points: Float[Tensor, "points 3"],
    weights: Float[Tensor, "x y z channels"],
    low: Float[Tensor, "3"],
    nodes_per_m: Float[Tensor, "3"],
) -> Float[Tensor, "points channels"]:
    """Trilinear skinning weights at canonical points; the border's outside."""
    last = torch.tensor(weights.shape[:3], device=points.device) - 1
    place = ((points - low) * nodes_per_m / last * 2.0 - 1.0).flip(-1)[None, :, None, None]
    volume = weights.permute(3, 0, 1, 2)[None]
    read = torch.nn.functional.grid_sample(
        volume, place, mode="bilinear", padding_mode="border", align_corners=True
    )
    return read[0, :, :, 0, 0].T


def skin_points(
    points: Float[Tensor, "points 3"],
    weights: Float[Tensor, "x y z channels"],
    low: Float[Tensor, "3"],
    nodes_per_m: Float[Tensor, "3"],
    bones: Float[Tensor, "channels 12"],
) -> Float[Tensor, "points 3"]:
    """Linear blend skinning: x ↦ Σ w_j(x) B_j x (Fast-SNARF, eq. 3)."""
    blend = (interpolate_volume(points, weights, low, nodes_per_m) @ bones).unflatten(1, (3, 4))
    return (blend[..., :3] @ points[..., None])[..., 0] + blend[..., 3]


def broyden_roots(
    targets: Float[Tensor, "points 3"],
    starts: Float[Tensor, "points 3"],
    weights: Float[Tensor, "x y z channels"],
    low: Float[Tensor, "3"],
    nodes_per_m: Float[Tensor, "3"],
    bones: Float[Tensor, "channels 12"],
    *,
    iterations: int = 12,
    tolerance_m: float = 1e-4,
) -> tuple[Float[Tensor, "points 3"], Bool[Tensor, "points"]]:
    """Canonical points that skinning carries to `targets`, by BroydenLookup's method per sample.

    Fast-SNARF, §3.2. The inverse Jacobian starts from the blended rotation's inverse.

    Returns:
        The roots, and which of them came to rest within the tolerance.
    """
    x = starts.clone()
    blend = (interpolate_volume(x, weights, low, nodes_per_m) @ bones).unflatten(1, (3, 4))
    inverse = torch.linalg.inv(blend[..., :3])
    error = skin_points(x, weights, low, nodes_per_m, bones) - targets
    for _ in range(iterations):
        moving = (error.norm(dim=-1) > tolerance_m)[:, None]
        step = torch.where(moving, -(inverse @ error[..., None])[..., 0], 0.0)
        x = x + step
        new = skin_points(x, weights, low, nodes_per_m, bones) - targets
        change = (inverse @ (new - error)[..., None])[..., 0]
        scale = (step * change).sum(dim=-1, keepdim=True)
        scale = torch.where(scale.abs() < 1e-12, 1e-12, scale)
        row = (step[:, None] @ inverse)[:, 0]
        update = ((step - change) / scale)[..., None] * row[:, None]
        inverse = torch.where(moving[..., None], inverse + update, inverse)
        error = new
    return x, error.norm(dim=-1) <= 2.0 * tolerance_m
