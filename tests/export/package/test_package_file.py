import json
import os
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from capture.input_error import InputError
from export import build
from export.bake.bake_tables import MAX_VOXEL_M, MIN_VOXEL_M, BakeConfig, ExportRefused
from export.build import POOR_PSNR, export_field
from export.package.manifest import FORMAT_VERSION
from export.package.package_file import read_package, write_package
from export.player import Player


def rewritten(source, target, change):
    """A copy of a package whose entries went through `change(name, content)`; None drops one."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            changed = change(name, old.read(name))
            if changed is not None:
                new.writestr(name, changed)
    return target


def with_manifest(**changes):
    def change(name, content):
        if name != "manifest.json":
            return content
        return json.dumps(json.loads(content) | changes).encode()

    return change


def test_a_package_comes_back_byte_by_byte(exported, tmp_path):
    package = read_package(exported.path, tier=None)
    again = tmp_path / "again.iavatar"
    assert write_package(package, again) == exported.bytes
    assert again.read_bytes() == exported.path.read_bytes()


def test_the_manifest_says_what_the_package_is(exported):
    with zipfile.ZipFile(exported.path) as archive:
        content = json.loads(archive.read("manifest.json"))
        assert set(archive.namelist()) - {"manifest.json"} == set(content["sha256"])
    assert content["format"] == FORMAT_VERSION
    assert len(content["joints"]) == len(content["rest_joints"]) == 24
    assert "metres" in content["units"]
    assert content["metrics"] == {"psnr": 30.0, "warnings": list(exported.warnings)}
    note = content["tiers"]["hq"]
    assert note["psnr_to_renderer"] == exported.psnr_to_renderer["hq"] > 30
    assert max(side for frame in content["golden"] for side in frame["size_px"]) <= 128


def test_every_altered_byte_of_a_stream_is_noticed(exported, tmp_path):
    content = bytearray(exported.path.read_bytes())
    whole, noticed = read_package(exported.path).manifest.to_json(), []
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(content) - 1, 12):
        damaged = content.copy()
        damaged[place] ^= 0x55
        path = tmp_path / "damaged.iavatar"
        path.write_bytes(damaged)
        try:
            package = read_package(path)
        except InputError as error:
            noticed.append(str(error))
        else:  # a byte that carries no content, such as a time stamp
            assert package.manifest.to_json() == whole
    assert len(noticed) > 6
    assert all("damaged.iavatar" in message for message in noticed)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_truncated_package_is_refused(exported, tmp_path, share):
    content = exported.path.read_bytes()
    path = tmp_path / "short.iavatar"
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match="truncated"):
        read_package(path)


@pytest.mark.parametrize(
    ("entry", "content", "said"),
    [
        ("player.onnx", None, r"player\.onnx is missing"),
        ("hq/skin_weights.bin", b"resealed", r"altered: hq/skin_weights\.bin"),
    ],
)
def test_a_missing_file_and_a_missing_or_another_entry_are_named(
    exported, tmp_path, entry, content, said
):
    with pytest.raises(InputError, match="no package"):
        read_package(tmp_path / "none.iavatar")

    def change(name, held):
        return content if name == entry else held

    path = rewritten(exported.path, tmp_path / "x.iavatar", change)
    with pytest.raises(InputError, match=said):
        read_package(path)


def with_directory_field(path, name, offset, content):
    """Writes bytes into an entry's line in the zip's list of entries."""
    package = bytearray(path.read_bytes())
    place = package.rfind(name.encode()) - 46
    assert package[place : place + 4] == b"PK\1\2"
    package[place + offset : place + offset + len(content)] = content
    path.write_bytes(package)


@pytest.mark.parametrize(
    ("offset", "value", "said"),
    [
        (8, b"\1\0", "truncated or altered"),  # encrypted
        (10, b"\x63\0", "truncated or altered"),  # compressed strangely
        (24, (1 << 30).to_bytes(4, "little"), "unpacks to 10"),  # refused unread
    ],
)
def test_entries_that_cannot_be_are_refused(exported, tmp_path, offset, value, said):
    path = tmp_path / "x.iavatar"
    path.write_bytes(exported.path.read_bytes())
    with_directory_field(path, "preview.png", offset, value)
    with pytest.raises(InputError, match=said):
        read_package(path)


@pytest.mark.parametrize(
    "change",
    [
        {"surfels": 10**9},
        {"brick_counts": [10**6, 10**6, 10**6]},
        {"bricks": -1},
        {"skin_nodes": 10**7},
        {"skin_counts": [10**6, 10**6, 1]},
    ],
)
def test_sizes_that_are_not_those_of_the_entries_are_refused(exported, tmp_path, change):
    with zipfile.ZipFile(exported.path) as archive:
        tiers = json.loads(archive.read("manifest.json"))["tiers"]
    tiers["hq"]["layout"] |= change
    path = rewritten(exported.path, tmp_path / "x.iavatar", with_manifest(tiers=tiers))
    with pytest.raises(InputError, match="is damaged"):
        read_package(path)


def test_a_package_of_the_format_before_is_read(exported, tmp_path):
    path = rewritten(exported.path, tmp_path / "x.iavatar", with_manifest(format=5))
    assert set(read_package(path).manifest.tiers) == set(read_package(exported.path).manifest.tiers)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 3}, "format 3"),
        ({"format": 7}, "x.iavatar: .*format 7"),
        ({"tiers": {"hq": {}}}, "x.iavatar: .*damaged: it has no 'layout'"),
        ({"rest_joints": [[float("nan")] * 3] * 24}, "damaged"),
        ({"parents": [-1] + [23] * 23}, "damaged"),
        ({"tiers": {}}, "damaged"),
    ],
)
def test_a_manifest_that_cannot_be_is_refused(exported, tmp_path, change, message):
    path = rewritten(exported.path, tmp_path / "x.iavatar", with_manifest(**change))
    with pytest.raises(InputError, match=message):
        read_package(path)


def test_a_tier_that_is_not_there_is_named(exported):
    with pytest.raises(InputError, match=r"no tier 'best'; it has: hq, lite"):
        Player.load(exported.path, tier="best")


@pytest.fixture
def export(stand_in, views, truth, coarse, tmp_path):
    """Exports the bent stand-in, or something else in its place."""

    def run(**changes):
        arguments = {
            "occupied": stand_in.occupied,
            "path": tmp_path / "a.iavatar",
            "views": [views["bent"]],
            "metrics": {},
            "renderer": lambda pose, camera: truth["bent"],
            "config": coarse,
        }
        *_, report = export_field(stand_in.field_at, stand_in.rig, **(arguments | changes))
        return report

    return run


@pytest.mark.slow
def test_a_player_that_differs_from_the_renderer_is_written_with_a_warning(export, truth):
    report = export(renderer=lambda pose, camera: np.roll(truth["bent"], 12, axis=1))
    assert report.psnr_to_renderer["hq"] < POOR_PSNR
    (warning,) = report.warnings
    assert read_package(report.path).manifest.metrics["warnings"] == [warning]


@pytest.mark.usefixtures("baked_already")
def test_a_graph_that_differs_from_its_rays_is_refused(export, tmp_path, monkeypatch):
    right = build.build_graph
    monkeypatch.setattr(
        build,
        "build_graph",
        lambda tables, settings: right(tables, replace(settings, max_segment_m=0.01)),
    )
    with pytest.raises(ExportRefused, match="dB from its rays"):
        export()
    assert list(tmp_path.iterdir()) == []


def test_an_avatar_of_nothing_is_refused(export, stand_in, tmp_path):
    with pytest.raises(ExportRefused, match="empty"):
        export(occupied=np.zeros_like(stand_in.occupied))
    assert list(tmp_path.iterdir()) == []


def test_voxels_follow_the_field_within_bounds():
    assert BakeConfig.for_sample_step(0.001).voxel_m == MIN_VOXEL_M
    assert MIN_VOXEL_M < BakeConfig.for_sample_step(0.009).voxel_m < MAX_VOXEL_M
    assert BakeConfig.for_sample_step(0.1).voxel_m == MAX_VOXEL_M


def test_a_full_disk_leaves_the_older_package(package, tmp_path, monkeypatch):
    path = tmp_path / "a.iavatar"
    path.write_bytes(b"older")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="space"):
        write_package(package, path)
    assert path.read_bytes() == b"older"
    assert [p.name for p in tmp_path.iterdir()] == ["a.iavatar"]


def test_a_stranger_with_numpy_reads_a_package_by_its_documentation(exported, tables):
    text = (Path(__file__).parents[3] / "docs" / "package-format.md").read_text()
    room: dict = {}
    exec(text.split("```python\n")[1].split("```")[0], room)
    manifest, bricks, weights, places = room["read"](exported.path)
    assert manifest["format"] == FORMAT_VERSION
    np.testing.assert_array_equal(bricks, tables.bricks.voxels[1:, :8, :8, :8])
    np.testing.assert_allclose(weights, tables.skinning.weights[1:], atol=1e-6)
    np.testing.assert_allclose(places, tables.surfels.positions, atol=1e-5)


def graph_of(nodes, tensors=()):
    output = helper.make_tensor_value_info("rgba", TensorProto.INT32, None)
    kinds = {"bones": (1, [24, 12]), "camera": (1, [4])}
    kinds |= dict.fromkeys(("height", "width", "samples"), (7, []))
    inputs = [helper.make_tensor_value_info(n, kind, shape) for n, (kind, shape) in kinds.items()]
    graph = helper.make_graph(nodes, "g", inputs, [output], tensors)
    imports = [helper.make_opsetid("", 18)]
    return helper.make_model(graph, opset_imports=imports, ir_version=9).SerializeToString()


def test_a_graph_that_reads_a_file_of_the_machine_is_refused(package, tmp_path, monkeypatch):
    (tmp_path / "secret").write_bytes(bytes(range(16)))
    monkeypatch.chdir(tmp_path)
    for place in ("secret", f"../{tmp_path.name}/secret", str(tmp_path / "secret")):
        stolen = TensorProto(name="stolen", data_type=TensorProto.INT32, dims=[4])
        stolen.data_location = TensorProto.EXTERNAL
        for key, value in (("location", place), ("offset", "0"), ("length", "16")):
            stolen.external_data.add(key=key, value=value)
        graph = graph_of([helper.make_node("Identity", ["stolen"], ["rgba"])], [stolen])
        with pytest.raises(InputError, match="does not run"):
            Player(replace(package, graphs={"hq": graph}))


def test_a_graph_with_a_wrong_or_too_large_output_is_refused(package, views):
    size = numpy_helper.from_array(np.array([1 << 20, 1 << 20, 4]), "size")
    endless = helper.make_node(
        "ConstantOfShape", ["size"], ["rgba"], value=helper.make_tensor("v", 6, [1], [7])
    )
    one = numpy_helper.from_array(np.zeros(1, dtype=np.int32), "one")
    small = helper.make_node("Identity", ["one"], ["rgba"])
    for graph, message in ((graph_of([endless], [size]), "cannot draw"),
                           (graph_of([small], [one]), "instead of one 32-bit number")):  # fmt: skip
        player = Player(replace(package, graphs={"hq": graph}))
        with pytest.raises(InputError, match=message):
            player.render(*views["bent"])
