"""Another video added to a finished avatar: both are learnt from, and the body stays."""

import json
import shutil

import numpy as np
import pytest

from avatar.training import checkpoint
from instant_avatar.run import run_capture
from preprocess.body.parametric_body import load_body_model, read_shaped_body

GIVEN = "--no-refine-poses"
"""What is shown here is not how poses are refined; fits of held-out frames take a while."""
FEW = ("--frames", "0:8", GIVEN)


def test_another_video_is_added_and_both_are_learnt_from(
    capture, call_ingest, without_baking, tmp_path, monkeypatch
):

    out, other = tmp_path / "run", tmp_path / "other"
    shutil.copytree(capture, other)
    first = call_ingest(capture, "--out", out, "--frames", "0:12", GIVEN)
    assert first.code == 0
    before = json.loads((out / "report.json").read_text())
    assert before["earlier_videos"] is None
    assert (out / "checkpoint" / checkpoint.LAST_RUN_FILE).exists()
    outcome = call_ingest(other, "--out", out, "--resume", "--frames", "12:24", GIVEN)
    assert outcome.code == 0
    after = json.loads((out / "report.json").read_text())
    extended = after["earlier_videos"]
    assert extended["replayed_key_frames"] == before["frames"]["used"]
    assert extended["videos"] == ["capture"]
    assert extended["frames_trained"] == before["frames"]["used"]
    assert extended["wall_seconds"] == pytest.approx(before["training"]["wall_seconds"])
    held = {1: before["held_out"]["frames"], 2: after["held_out"]["frames"]}
    assert {point["video"] for point in after["curve"]} == {1, 2}
    for point in after["curve"]:  # numbers in the video, whichever it was
        assert {number for number, _ in point["frames"]} <= set(held[point["video"]])
    page = (out / "report.html").read_text()
    assert "frames of capture)" in page
    assert "Earlier videos" in page
    assert after["frames"] == {**before["frames"], "dropped": []}  # of the new video alone
    assert after["training"]["steps"] == 2 * before["training"]["steps"]
    # both videos are learnt from, and an interrupted run finds both again
    kept = checkpoint.load_frames(out / "checkpoint" / checkpoint.LAST_RUN_FILE)
    numbers = [frame.index for frame in kept]
    assert sum(number < 0 for number in numbers) == sum(number >= 0 for number in numbers) == 9
    again = call_ingest(other, "--out", out, "--resume", "--frames", "12:24", GIVEN)
    assert again.code == 0
    assert "Training for" not in again.err  # the budget is used
    assert json.loads((out / "report.json").read_text())["earlier_videos"] == extended


@pytest.mark.slow
def test_an_added_video_keeps_the_avatars_body_and_says_how_its_own_differs(
    capture, call_ingest, without_baking, tmp_path, changed, rig
):
    out, other = tmp_path / "run", tmp_path / "other"
    shutil.copytree(capture, other)
    assert call_ingest(capture, "--out", out, *FEW).code == 0
    body = load_body_model()
    person = read_shaped_body(out / "checkpoint" / "person.npz", body)
    betas = np.zeros(10)
    betas[0] = 3.0
    stated = body.with_shape(betas)
    assert abs(stated.height_m - person.height_m) > 0.02
    changed(other / "poses.npz", betas=betas)
    outcome = call_ingest(other, "--out", out, "--resume", *FEW)
    assert outcome.code == 0
    said = " ".join(outcome.err.split())
    assert f"body of these poses is {100 * stated.height_m:.0f} cm tall" in said
    kept = read_shaped_body(out / "checkpoint" / "person.npz", body)
    np.testing.assert_array_equal(kept.vertices, person.vertices)
    trainer, _ = checkpoint.load(out / "checkpoint")
    np.testing.assert_allclose(trainer.avatar.rig.rest_joints, rig.rest_joints, atol=1e-6)


def test_an_added_video_of_another_body_is_refused(
    run, capture, call_ingest, tmp_path, changed, monkeypatch
):
    monkeypatch.setattr(run_capture, "correction_hint", lambda imported: "")  # it takes seconds
    out, other = tmp_path / "run", tmp_path / "other"
    shutil.copytree(capture, other)
    shutil.copytree(run, out)
    for arguments, word in (
        (("--height-cm", "150"), "--height-cm is 150"),
        (("--body", small_body(tmp_path)), "Give the same --body"),
    ):
        assert word in call_ingest(other, "--out", out, "--resume", *FEW, *arguments).refusal()
    (out / "checkpoint" / "person.npz").unlink()
    changed(other / "poses.npz", betas=np.full(10, 2.0))
    refusal = call_ingest(other, "--out", out, "--resume", *FEW).refusal()
    assert "a different body than the avatar" in refusal
    assert (out / "avatar.iavatar").exists()


def small_body(folder):
    """The embedded body with a vertex less."""
    body, path = load_body_model(), folder / "small.npz"
    faces = body.faces[(body.faces < len(body.template) - 1).all(axis=1)]
    tree = np.stack([body.parents, np.arange(24)])
    np.savez(
        path, v_template=body.template[:-1], shapedirs=body.shape_directions[:-1], f=faces,
        weights=body.weights[:-1], J=body.joints, J_shapedirs=body.joint_directions,
        kintree_table=tree,
    )  # fmt: skip
    return path
