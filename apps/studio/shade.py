"""From what the subsamples see to colours: the mean over a pixel's covered subsamples."""

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from apps.studio.paint import albedo_at
from apps.studio.raster import ZBuffer
from avatar.kernels.jit import compile_kernel


def shade_pixels(
    zbuffer: ZBuffer,
    *,
    faces: Int32[np.ndarray, "faces 3"],
    materials: Int32[np.ndarray, "faces"],
    template_points: Float32[np.ndarray, "vertices 3"],
    light: Float32[np.ndarray, "vertices 3"],
    palette: Float32[np.ndarray, "colours 3"],
    measures: Float32[np.ndarray, "cuts"],
    checked: bool,
) -> tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]:
    """SrgbColor of the covered part of each pixel (sRGB in [0, 1]) and how much of it is covered.

    Args:
        seen: The z-buffer.
        faces, kinds: Triangles, and what each is made of.
        place, light: Place on the undressed template and light falling on each vertex.
        palette, cut, checked: The outfit, as `paint` reads it.
    """
    height, width = zbuffer.face.shape[0] // zbuffer.supersampling, zbuffer.face.shape[1] // zbuffer.supersampling
    rgb = np.zeros((height, width, 3), dtype=np.float32)
    alpha = np.zeros((height, width), dtype=np.float32)
    _shade(
        zbuffer.face, zbuffer.barycentric, zbuffer.supersampling, faces, materials, template_points, light, palette, measures, checked,
        rgb, alpha,
    )  # fmt: skip
    return rgb, alpha


def composite_over(
    rgb: Float32[np.ndarray, "height width 3"],
    alpha: Float32[np.ndarray, "height width"],
    background: UInt8[np.ndarray, "height width 3"] | None = None,
) -> UInt8[np.ndarray, "height width 3"]:
    """The person in front of a background (white if None)."""
    behind = np.float32(1.0) if background is None else background.astype(np.float32) / 255.0
    mixed = alpha[..., None] * rgb + (1.0 - alpha[..., None]) * behind
    return (np.clip(mixed, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


@compile_kernel(nogil=True, error_model="numpy")
def _shade(
    face_of: Int32[np.ndarray, "rows columns"],
    share_of: Float32[np.ndarray, "rows columns 2"],
    fine: int,
    faces: Int32[np.ndarray, "faces 3"],
    kinds: Int32[np.ndarray, "kinds"],
    place: Float32[np.ndarray, "vertices 3"],
    light: Float32[np.ndarray, "vertices 3"],
    palette: Float32[np.ndarray, "colours 3"],
    cut: Float32[np.ndarray, "cuts"],
    checked: bool,
    rgb: Float32[np.ndarray, "height width 3"],
    alpha: Float32[np.ndarray, "height width"],
) -> None:
    for i in range(alpha.shape[0]):
        for j in range(alpha.shape[1]):
            red, green, blue, covered = 0.0, 0.0, 0.0, 0
            for row in range(i * fine, (i + 1) * fine):
                for column in range(j * fine, (j + 1) * fine):
                    face = face_of[row, column]
                    if face < 0:
                        continue
                    covered += 1
                    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                    on_b, on_c = share_of[row, column, 0], share_of[row, column, 1]
                    on_a = 1.0 - on_b - on_c
                    colour = albedo_at(
                        kinds[face],
                        on_a * place[a, 0] + on_b * place[b, 0] + on_c * place[c, 0],
                        on_a * place[a, 1] + on_b * place[b, 1] + on_c * place[c, 1],
                        on_a * place[a, 2] + on_b * place[b, 2] + on_c * place[c, 2],
                        palette,
                        cut,
                        checked,
                    )
                    for_red = on_a * light[a, 0] + on_b * light[b, 0] + on_c * light[c, 0]
                    for_green = on_a * light[a, 1] + on_b * light[b, 1] + on_c * light[c, 1]
                    for_blue = on_a * light[a, 2] + on_b * light[b, 2] + on_c * light[c, 2]
                    red += min(max(colour[0] * for_red, 0.0), 1.0)
                    green += min(max(colour[1] * for_green, 0.0), 1.0)
                    blue += min(max(colour[2] * for_blue, 0.0), 1.0)
            if covered > 0:
                rgb[i, j, 0] = red / covered
                rgb[i, j, 1] = green / covered
                rgb[i, j, 2] = blue / covered
                alpha[i, j] = covered / (fine * fine)
