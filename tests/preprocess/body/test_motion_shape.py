"""Whose poses a motion holds: by betas, or by fitted proportions."""

from dataclasses import replace

import numpy as np
import pytest

from capture.input_error import InputError
from preprocess.body.parametric_body import load_body_model, smpl_rest_joints, with_smpl_joints
from preprocess.body.proportion_space import ProportionSpace, shape_for_motion


def test_fitted_proportions_are_the_persons_shape_whatever_the_betas(motion):
    body = load_body_model()
    space = ProportionSpace.around(body.with_shape())
    coefficients = np.linspace(-1.0, 1.0, space.count)
    shaped = shape_for_motion(body, replace(motion, proportions=coefficients))
    np.testing.assert_allclose(shaped.vertices, space.shape(coefficients).vertices)
    np.testing.assert_allclose(shaped.joints, space.shape(coefficients).joints)
    assert np.abs(shape_for_motion(body, motion).joints - shaped.joints).max() > 0.005
    strangers = replace(motion, body_model="smpl", proportions=coefficients)
    plain = shape_for_motion(body, replace(motion, body_model="smpl"))
    np.testing.assert_array_equal(shape_for_motion(body, strangers).joints, plain.joints)


def test_proportions_of_another_body_are_refused(motion):
    with pytest.raises(InputError, match="7 proportions"):
        shape_for_motion(load_body_model(), replace(motion, proportions=np.zeros(7)))


def test_the_bodys_joints_move_exactly_as_smpls_do(motion):
    shaped = shape_for_motion(load_body_model(), replace(motion, body_model="smpl"))
    offset = shaped.joints - smpl_rest_joints()
    np.testing.assert_allclose(offset, np.broadcast_to(offset[0], (24, 3)), atol=1e-12)


def test_the_skin_moves_with_its_joints(shaped):
    moved = with_smpl_joints(shaped)
    rigid = shaped.body.weights.max(axis=1) > 0.999
    joint = shaped.body.weights[rigid].argmax(axis=1)
    before = shaped.vertices[rigid] - shaped.joints[joint]
    after = moved.vertices[rigid] - moved.joints[joint]
    np.testing.assert_allclose(after, before, atol=2e-3)
