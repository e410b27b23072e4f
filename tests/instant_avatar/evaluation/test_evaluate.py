"""ia-evaluate: the same figures as the report's, and the paper's protocol."""

import json
import re
import shutil
from functools import partial

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatar.evaluation.image_metrics import ground_truth_on_white, ground_truth_over
from avatar.evaluation.perceptual import Lpips
from capture.image_folder import write_png
from capture.source_opening import open_source
from instant_avatar import evaluate
from instant_avatar.cli.command_line import INTERRUPTED
from instant_avatar.cli.console import Console
from instant_avatar.evaluation import datasets
from instant_avatar.evaluation.datasets import find_neuman, split_by_rule
from instant_avatar.evaluation.evaluation_session import FrameScorer
from instant_avatar.evaluation.frame_scoring import SHOWN_FRAMES, FrameScore, score_picture
from instant_avatar.evaluation.score_table import AvatarEvaluation, ScoreRow, markdown_table
from preprocess.capture_inputs import CaptureInputs
from preprocess.open_capture import open_capture
from tests.instant_avatar.report.test_report_page import Tags


@pytest.fixture
def call_evaluate(call):
    """Runs ia-evaluate."""
    return partial(call, evaluate)


def rows_of(path):
    (avatar,) = json.loads(path.read_text())["avatars"]
    return {
        (row["renderer"], row["poses"]): row
        for row in avatar["rows"]
        if row["background"] == "white"
    }


def test_a_runs_table_says_what_its_report_says_and_its_page_what_the_table_says(
    run, call_evaluate, tmp_path
):
    table, card = tmp_path / "t.json", tmp_path / "card.html"
    words = (run, "--background", "white", "black", "--json", table, "--card", card)
    ended = call_evaluate(*words)
    assert ended.code == 0, ended.err
    report, rows = json.loads((run / "report.json").read_text()), rows_of(table)
    assert set(rows) == {
        ("renderer", "given"), ("renderer", "fitted"), ("player hq", "given"),
        ("player lite", "given"),
    }  # fmt: skip
    for poses, key in (("given", "held_out"), ("fitted", "held_out_refined")):
        row = rows["renderer", poses]
        assert [frame["frame"] for frame in row["frames"]] == report[key]["frames"]
        for figure in ("psnr", "psnr_mask", "ssim"):
            assert row[figure] == pytest.approx(report[key][figure], abs=2e-4)
    assert rows["player hq", "given"]["psnr"] > rows["player lite", "given"]["psnr"] > 20.0
    assert f"{report['held_out']['psnr']:.2f}" in ended.out
    assert rows["renderer", "given"]["verdict"] == report["held_out"]["verdict"]
    conditions = json.loads(table.read_text())["conditions"]
    assert conditions["background"] == "white and black"
    assert conditions["resolution"] == "64x64 px"
    page = card.read_text()
    tags = Tags(page)
    scored = len(report["held_out"]["frames"])
    assert len(tags.addresses) == 3 * min(scored, SHOWN_FRAMES)
    assert all(address.startswith("data:image/webp;base64,") for address in tags.addresses)
    assert f"{rows['renderer', 'given']['psnr']:.2f}" in page
    assert conditions["machine"] in page
    assert re.search(r"card\.html|t\.json", call_evaluate(*words).refusal())


def test_a_package_alone_is_scored_as_within_its_run(run, film, call_evaluate, tmp_path):
    for name, what in (("run", run), ("package", run / "avatar.iavatar")):
        ended = call_evaluate(
            what, "--on", film, "--frames", "3::16", "--no-fitted", "--json", tmp_path / name
        )
        assert ended.code == 0, ended.err
    whole, alone = rows_of(tmp_path / "run"), rows_of(tmp_path / "package")
    assert set(alone) == {("player hq", "given"), ("player lite", "given")}
    for way, row in alone.items():
        assert [frame["frame"] for frame in row["frames"]] == [3, 19]
        assert row["psnr"] == whole[way]["psnr"]


@pytest.fixture
def dataset(film, call_ingest, tmp_path, monkeypatch):
    """Two subjects in the paper's layout, with shorter lists."""
    lists = {datasets.TRAIN_POSES: np.s_[0:16:2], datasets.TEST_POSES: np.s_[16:24:3]}
    names = ("female-3-casual", "male-3-casual")
    monkeypatch.setattr(datasets, "SPLITS", dict.fromkeys(names, ("0:16:2", "16:24:3")))
    for name in names:
        place = tmp_path / "PeopleSnapshot" / name
        shutil.copytree(film, place)
        poses = dict(np.load(place / "poses.npz"))
        kept = {key: each for key, each in poses.items() if key not in ("frame", "time", "valid")}
        (place / "poses").mkdir()
        for path, rows in lists.items():
            timed = {key: kept[key][rows] for key in ("global_orient", "body_pose", "transl")}
            np.savez(place / path, **(kept | timed))
        (place / "poses.npz").unlink()
        (place / "images").mkdir()
        for frame in open_source(film).frames():
            write_png(place / "images" / f"{frame.index:04d}.png", frame.rgb)
        (place / "video.mp4").unlink()
    return tmp_path / "PeopleSnapshot"


def psnrs(ended):
    return [line.split("|")[6] for line in ended.out.splitlines()]


@pytest.mark.slow
def test_the_papers_frames_are_learnt_scored_and_set_beside_the_papers_figures(
    dataset, call_evaluate, without_baking, tmp_path
):
    place, out = dataset / "male-3-casual", tmp_path / "evaluation"

    def call(steps):
        words = ("--out", out, "--size", 64, "--no-player", "--json", tmp_path / "t", "--overwrite")
        return call_evaluate(place, *words, "--steps", steps)

    ended = call(10)
    assert ended.code == 0, ended.err
    frames = json.loads((out / place.name / "report.json").read_text())["frames"]
    assert (frames["used"] + frames["near_duplicates"], frames["held_out"]) == (8, 0)
    row = rows_of(tmp_path / "t")["renderer", "given"]
    assert [frame["frame"] for frame in row["frames"]] == [16, 19, 22]
    assert "InstantAvatar (paper)" in ended.out
    assert "29.65" in ended.out
    (avatar,) = json.loads((tmp_path / "t").read_text())["avatars"]
    ways = [(row["poses"], row["background"]) for row in avatar["rows"]]
    assert ways == [(p, on) for p in ("given", "fitted") for on in ("white", "black")]
    assert "LPIPS (alex, vgg) was not measured" in ended.err
    assert "n/a" in ended.out
    again = call(10)
    assert "was trained before" in again.err
    assert psnrs(again) == psnrs(ended)
    longer = call(15)
    assert "Resuming after 10 steps" in longer.err
    assert "was trained before" not in longer.err


@pytest.mark.slow
def test_a_stopped_lesson_leaves_the_table_of_those_before(
    dataset, call_evaluate, without_baking, tmp_path, monkeypatch
):
    train = evaluate.ingest

    def stopped_in_the_second(given, console):
        return INTERRUPTED if given.video.name == "male-3-casual" else train(given, console)

    monkeypatch.setattr(evaluate, "ingest", stopped_in_the_second)
    ended = call_evaluate(
        dataset, "--out", tmp_path / "out", "--steps", 10, "--size", 64, "--no-player"
    )
    assert ended.code == INTERRUPTED
    assert "female-3-casual" in ended.out
    assert "male-3-casual" not in ended.out.replace("female-3-casual", "")


def test_the_papers_lists_are_as_long_as_the_paper_says():
    counts = {"female-3-casual": (112, 51), "female-4-casual": (84, 48), "male-3-casual": (114, 55),
              "male-4-casual": (110, 36)}  # fmt: skip
    for name, splits in datasets.SPLITS.items():
        lists = [range(*map(int, text.split(":"))) for text in splits]
        assert tuple(map(len, lists)) == counts[name]
    assert datasets.PAPER.keys() == counts.keys()


def test_a_box_is_scored_without_the_white_around_it(film):
    (seen, *_) = open_capture(CaptureInputs(video=film)).observations()
    truth = ground_truth_on_white(seen)
    wrong = np.dstack([np.clip(truth - 0.1, 0.0, 1.0), np.ones(truth.shape[:2])]).astype(np.float32)
    score = score_picture(seen, wrong, "white")
    rows, columns = np.nonzero(seen.alpha > 0.5)
    box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    error = ((wrong[..., :3] - truth)[box].astype(float) ** 2).mean()
    assert score.psnr_box == pytest.approx(-10.0 * np.log10(error), abs=1e-4)
    perfect = np.dstack([truth, np.ones(truth.shape[:2], np.float32)])
    score = score_picture(seen, perfect, "white")
    assert (score.psnr_box, score.ssim) == (np.inf, pytest.approx(1.0))


def test_each_background_has_its_own_scores_of_one_rendering(film, monkeypatch):
    monkeypatch.setattr(Lpips, "compare", lambda self, image, truth, name: float(image.mean()))
    lpips = Lpips(())
    lpips.conventions = ("alex",)
    (seen, *_) = open_capture(CaptureInputs(video=film)).observations()
    alpha = 0.5 * seen.alpha[..., None]
    picture = np.concatenate([alpha * (seen.frame.rgb / np.float32(255.0)), alpha], axis=-1)
    drawn = FrameScorer({"hq": lambda _: picture}, None, ("white", "black"), lpips)
    drawn.score_frame(seen)
    white, black = (row.scores[0] for row in drawn.rows)
    for score, gray in ((white, 1.0), (black, 0.0)):
        shown = picture[..., :3] + np.float32(gray) * (1.0 - picture[..., 3:])
        error = ((shown - ground_truth_over(seen, gray)).astype(float) ** 2).mean()
        assert score.psnr == pytest.approx(-10.0 * np.log10(error), abs=1e-3)
        assert score.as_json()["lpips_alex"] == pytest.approx(shown.mean(), abs=1e-4)
    assert white.psnr != black.psnr
    assert white.overlap == black.overlap


def test_a_run_is_found_again_from_another_folder(run, film, call_evaluate, tmp_path, monkeypatch):
    place = tmp_path / "then"
    shutil.copytree(film, place / "capture")
    shutil.copytree(run, place / "out" / "run")
    report = place / "out" / "run" / "report.json"
    content = json.loads(report.read_text())
    content["command"] |= {"video": "capture", "out": "out/run"}
    report.write_text(json.dumps(content))
    monkeypatch.chdir(tmp_path)
    ended = call_evaluate(place / "out" / "run", "--no-fitted", "--no-player")
    assert ended.code == 0, ended.err
    assert f"{content['held_out']['psnr']:.2f}" in ended.out


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["{run}", "--frames", "0:5"], "--on"),
        (["{run}", "--rotate", "90"], "--on"),
        (["{run}", "--lpips-weights", "{tmp}/nothing"], "--lpips-weights"),
        (["{run}/avatar.iavatar"], "--on"),
        (["{run}/report.html"], "is no package"),
        (["{tmp}"], "neither a run"),
        (["{data}", "--on", "{film}"], "omit --on"),
        (["{lost}"], "report.json"),
        ([], "run"),
    ],
)
def test_what_cannot_be_scored_is_refused_with_the_reason(
    run, film, call_evaluate, tmp_path, words, told
):
    lost = tmp_path / "lost"
    shutil.copytree(run, lost)
    (lost / "report.json").unlink()
    (data := tmp_path / "sets" / "male-3-casual").mkdir(parents=True)
    places = {"data": data, "run": run, "film": film, "tmp": tmp_path, "lost": lost}
    ended = call_evaluate(*(word.format(**places) for word in words))
    assert told in ended.refusal()
    assert ended.out == ""


def evaluation(name, *, capture="video.mp4", poses="given", frames=range(8), gain=0.0, paper=None):
    """Scores as of a run: 28 dB in the mask, changing from frame to frame, plus a gain."""
    scores = [
        FrameScore(
            frame=frame, psnr=30.0, psnr_mask=28.0 + frame % 3 + gain, psnr_box=29.0, ssim=0.9,
            cpu_ms=1.0,
        )
        for frame in frames
    ]  # fmt: skip
    rows = [ScoreRow(renderer="renderer", poses=each, scores=scores) for each in (poses, "fitted")]
    return AvatarEvaluation(name=name, capture=capture, size=(64, 64), rows=rows, paper=paper)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"gain": 0.5}, "better is better than run by 0.50 dB .* on the same 8 frames"),
        ({"gain": -0.5, "poses": "tracked"}, "run is better than better by 0.50 dB"),
        ({"gain": 0.0}, "No clear difference"),
        ({"gain": 0.2, "capture": "other.mp4"}, "No clear difference.* frames of different capt"),
        ({"gain": 4.0, "capture": "other.mp4"}, "better is better than run by 4.00 dB"),
    ],
)
def test_the_better_of_two_runs_is_named_and_no_mean_is_made(other, said):
    table = markdown_table([evaluation("run"), evaluation("better", **other)])
    assert re.search(said, table)
    assert "| mean" not in table
    assert f"| {other.get('poses', 'given')} " in table


def test_subjects_of_a_dataset_have_a_mean_and_are_not_compared():
    table = markdown_table([evaluation("one", paper={}), evaluation("two", paper={}, gain=1.0)])
    assert "| mean" in table
    assert "better" not in table


@pytest.fixture(scope="module")
def filmed(film):
    """The film: observations of all frames, and its poses' arrays."""
    return list(open_capture(CaptureInputs(video=film)).observations()), np.load(film / "poses.npz")


def open_splits(subject, tmp_path):
    return subject.open_splits(tmp_path / "out", Console())


UNIT = 2.5
"""Units of the COLMAP world per meter."""


@pytest.fixture
def neuman(filmed, tmp_path):
    """A subject of NeuMan: a world of another unit; one frame's person is nearer and smaller."""
    seen, poses = filmed
    place = tmp_path / "neuman" / "seattle"
    for part in ("images", "segmentations", "sparse", "4d_humans"):
        (place / part).mkdir(parents=True)
    camera, lines = seen[0].camera, []
    (fx, fy), (cx, cy) = camera.focal_px, camera.center_px
    (place / "sparse" / "cameras.txt").write_text(f"1 PINHOLE 64 64 {fx} {fy} {cx} {cy}\n")
    for row, observation in enumerate(seen):
        name = f"{row:05d}.png"
        colors = observation.frame.rgb[..., ::-1]
        cv2.imwrite(str(place / "images" / name), colors)
        person = np.where(observation.alpha > 0.5, 0, 255).astype(np.uint8)
        cv2.imwrite(str(place / "segmentations" / name), person)
        x, y, z = UNIT * camera.camera_from_world[:3, 3]
        w, *axis = Rotation.from_matrix(camera.camera_from_world[:3, :3]).as_quat(scalar_first=True)
        lines.append(f"{row + 1} {w} {axis[0]} {axis[1]} {axis[2]} {x} {y} {z} 1 {name}\n\n")
    (place / "sparse" / "images.txt").write_text("".join(reversed(lines)))
    (place / "sparse" / "points3D.txt").write_text("")
    nearer = np.ones(len(seen))
    nearer[4] = 0.8
    center = UNIT * camera.center_world
    places = center + nearer[:, None] * (UNIT * poses["transl"] - center)
    np.savez(
        place / "4d_humans/smpl_optimized_aligned_scale.npz",
        global_orient=poses["global_orient"], body_pose=poses["body_pose"], transl=places,
        betas=np.zeros((len(seen), 10)), scale=UNIT * nearer,
    )  # fmt: skip
    return place


def test_neumans_frames_have_cameras_and_poses_in_meters(neuman, filmed, tmp_path):
    (neuman / "train_split.txt").write_text("00000.png\n00004.png\n00009.png\n")
    (neuman / "test_split.txt").write_text("00002.png\n00012.png\n")
    (subject,) = find_neuman(neuman.parent)
    assert (subject.name, subject.paper) == ("seattle", {})
    seen, poses = filmed
    for split, rows in zip(open_splits(subject, tmp_path), ([0, 4, 9], [2, 12]), strict=True):
        written = np.load(split.folder / "poses.npz")
        assert np.allclose(written["transl"], poses["transl"][rows], atol=1e-6)
        found = list(open_capture(CaptureInputs(video=split.folder)).observations())
        for observation, row in zip(found, rows, strict=True):
            assert (observation.frame.rgb == seen[row].frame.rgb).all()
            assert ((observation.alpha > 0.5) == (seen[row].alpha > 0.5)).all()
            expected = seen[row].camera.camera_from_world
            assert np.allclose(observation.camera.camera_from_world, expected, atol=1e-6)


def test_masks_of_the_poses_are_preferred_and_matched_in_order(neuman, filmed, tmp_path):
    (neuman / "4d_humans/sam_segmentations").mkdir()
    seen, _ = filmed
    for row in range(len(seen)):
        person = np.zeros((64, 64), np.uint8)
        person[:, 20 : 22 + row] = 255
        cv2.imwrite(str(neuman / f"4d_humans/sam_segmentations/mask_{row:04d}.png"), person)
    (subject,) = find_neuman(neuman)
    _, test = open_splits(subject, tmp_path)
    _, rows = split_by_rule(len(seen))
    for row in rows:
        mask = cv2.imread(str(test.folder / "masks" / f"{row:05d}.png"), cv2.IMREAD_UNCHANGED)
        assert (mask > 0).sum() == 64 * (2 + row)


@pytest.mark.slow
def test_the_protocol_runs_on_the_original_files(
    neuman, call_evaluate, on_one_core, without_baking, tmp_path
):
    scores = tmp_path / "scores.json"
    words = ["--out", tmp_path / "out", "--steps", 10, "--no-player", "--json", scores]
    said = call_evaluate(neuman, *words)
    assert said.code == 0, said.err
    (avatar,) = json.loads(scores.read_text())["avatars"]
    ways = [(row["poses"], row["background"]) for row in avatar["rows"]]
    assert ways == [(p, on) for p in ("given", "fitted") for on in ("white", "black")]
    expected = len(split_by_rule(24)[1])
    assert [len(row["frames"]) for row in avatar["rows"]] == [expected] * 4
    assert "InstantAvatar (paper)" not in said.out
