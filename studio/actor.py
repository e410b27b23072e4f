"""The person in front of the camera: the embedded body, dressed, lit and drawn in any pose."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Float, Float32, Int, Int32, UInt8

from capture.camera import Camera
from preprocess.body.body_file import load_body_model
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import vertex_normals
from preprocess.body.parametric_body import ShapedBody
from studio.clothing_layers import all_template_points, build_layers
from studio.lighting import LAMP_STRENGTH, bake_light, composite_over, shade_pixels
from studio.outfit import OUTFITS, SHOE, Outfit
from studio.phone.proportions import BodyProportions
from studio.zbuffer import rasterize

A_POSE = np.zeros(69)
A_POSE[[2, 5, 47, 50]] = (0.2, -0.2, -0.8, 0.8)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Actor:
    """A dressed person who can be drawn in any pose.

    Attributes:
        betas: Its shape coefficients.
        shaped: The body underneath; `poses.npz` is about this one.
        outfit: What it wears.
        rest_vertices: Vertices of all layers at rest, metres.
        template_points: Where each vertex lies on the undressed template.
        body_vertices: The body vertex that each vertex hangs from.
        faces: Triangles.
        materials: Material of each triangle.
        baked_light: Painted light on each vertex.
        palette: The outfit's colors, tinted by the seed.
    """

    betas: Float[np.ndarray, "10"]
    shaped: ShapedBody
    outfit: Outfit
    rest_vertices: Float[np.ndarray, "vertices 3"]
    template_points: Float32[np.ndarray, "vertices 3"]
    body_vertices: Int32[np.ndarray, "vertices"]
    faces: Int32[np.ndarray, "faces 3"]
    materials: Int32[np.ndarray, "faces"]
    baked_light: Float32[np.ndarray, "vertices 3"]
    palette: Float32[np.ndarray, "colors 3"]

    @classmethod
    def of(
        cls, subject: int = 1, seed: int = 0, proportions: BodyProportions | None = None
    ) -> "Actor":
        """One of the subjects of `OUTFITS`.

        Args:
            subject: Which one.
            seed: Varies shape and colors a little (0: as designed).
            proportions: What is different from the body model beyond betas; None: nothing.
        """
        body, outfit = load_body_model(), OUTFITS[subject]
        if proportions is not None:
            outfit = replace(outfit, looseness=proportions.looseness)
        generator = np.random.default_rng([seed, subject])
        spread = 0.0 if seed == 0 else 1.0
        betas = np.zeros(10)
        betas[:4] = np.array(outfit.betas) + 0.15 * spread * generator.standard_normal(4)
        tint = 1.0 + 0.05 * spread * generator.standard_normal((len(outfit.palette), 3))
        layers = build_layers(body, outfit)
        starts = np.cumsum([0] + [len(layer.rest_vertices) for layer in layers])
        source = np.concatenate([layer.body_vertices for layer in layers])
        shape = body.shape_directions[source] @ betas
        rest = np.concatenate([layer.rest_vertices for layer in layers]) + shape
        faces = np.concatenate(
            [layer.faces + start for layer, start in zip(layers, starts, strict=False)]
        )
        kinds = np.concatenate([np.full(len(layer.faces), layer.material) for layer in layers])
        shaped = body.with_shape(betas)
        if proportions is not None:
            rest = proportions.move_vertices(rest, body.weights[source], shaped.joints)
            shaped = _reproportion(shaped, proportions)
        undone = cls(
            betas=betas,
            shaped=shaped,
            outfit=outfit,
            rest_vertices=rest,
            template_points=all_template_points(layers),
            body_vertices=source,
            faces=faces.astype(np.int32),
            materials=kinds.astype(np.int32),
            baked_light=np.ones((len(rest), 3), dtype=np.float32),
            palette=np.clip(np.array(outfit.palette) * tint, 0.0, 1.0).astype(np.float32),
        )
        return undone.with_baked_light()

    @cached_property
    def _weights(self) -> Float[np.ndarray, "vertices 24"]:
        """Skinning weights of all layers: those of the body vertices they hang from."""
        return self.shaped.body.weights[self.body_vertices].astype(np.float64)

    @cached_property
    def sole_vertices(self) -> Int[np.ndarray, "chosen"]:
        """The vertices of the shoes."""
        return np.unique(self.faces[self.materials == SHOE])

    def vertices(
        self, pose: BodyPose, chosen: Int[np.ndarray, "chosen"] | slice = slice(None)
    ) -> Float[np.ndarray, "chosen 3"]:
        """Vertices of all layers in the world, metres, skinned with the body's own weights."""
        weights = self._weights[chosen]
        transforms = self.shaped.with_pose(pose).world_from_rest()[:, :3, :].reshape(24, 12)
        blended = (weights @ transforms).reshape(-1, 3, 4)
        return (
            np.einsum("vab,vb->va", blended[..., :3], self.rest_vertices[chosen]) + blended[..., 3]
        )

    def sole_height_m(self, pose: BodyPose) -> float:
        """Height of the lowest shoe in a pose, metres: where the floor is."""
        return float(self.vertices(pose, self.sole_vertices)[:, 1].min())

    def render_rgb_alpha(
        self, pose: BodyPose, camera: Camera, supersampling: int = 4
    ) -> tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]:
        """Color of the covered part of each pixel, and how much of it is covered, in [0, 1]."""
        cut = self.outfit.measures
        seen = rasterize(
            self.vertices(pose),
            self.faces,
            camera,
            supersampling=supersampling,
            template_points=self.template_points,
            materials=self.materials,
            measures=cut,
        )
        return shade_pixels(
            seen,
            faces=self.faces,
            materials=self.materials,
            template_points=self.template_points,
            light=self.baked_light,
            palette=self.palette,
            measures=cut,
            checked=self.outfit.checked,
        )

    def render_over(
        self,
        pose: BodyPose,
        camera: Camera,
        background: UInt8[np.ndarray, "height width 3"] | None = None,
    ) -> tuple[UInt8[np.ndarray, "height width 3"], UInt8[np.ndarray, "height width"]]:
        """The person in front of a background (white if None), and the soft mask."""
        rgb, alpha = self.render_rgb_alpha(pose, camera)
        return composite_over(rgb, alpha, background), (alpha * 255.0 + 0.5).astype(np.uint8)

    def with_baked_light(self, lamp_strength: float = LAMP_STRENGTH) -> "Actor":
        """The same actor with the light of the A-pose painted on.

        Args:
            lamp_strength: Of the lamp, as a factor of color; without it the sky's light remains.
        """
        pose = BodyPose(
            root_rotation=np.zeros(3),
            root_translation=np.zeros(3),
            joint_rotations=A_POSE.reshape(23, 3),
        )
        points = self.vertices(pose)
        light = bake_light(
            points,
            vertex_normals(points, self.faces),
            self.faces,
            template_points=self.template_points,
            materials=self.materials,
            measures=self.outfit.measures,
            lamp_strength=lamp_strength,
        )
        return replace(self, baked_light=light)


def _reproportion(shaped: ShapedBody, proportions: BodyProportions) -> ShapedBody:
    """The body at rest with other proportions."""
    return replace(
        shaped,
        vertices=proportions.move_vertices(shaped.vertices, shaped.body.weights, shaped.joints),
        joints=proportions.move_joints(shaped.joints),
    )
