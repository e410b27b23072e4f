"""Makes the networks in preprocess/tracking/weights from the published BlazePose models.

For developers only; using the project does not require it. From the project's root:

    npm pack @mediapipe/pose@0.5.1675469404
    pip install tflite==2.18.0
    python dev/make_blazepose.py mediapipe-pose-0.5.1675469404.tgz

`--landmarks lite full heavy` makes all sizes of the landmark network. Networks of these checksums
were compared with the runtime that they were made for (lab log, house, 2026-11-27).
"""

import argparse
import hashlib
import sys
import tarfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from dev.onnx_from_tflite import OnnxWriter  # noqa: E402 - a script
from dev.tflite_model import TfliteModel  # noqa: E402

PACKAGE_SHA256 = "8bb349a7b3a3ba699df23be804ddd3b3eab810b50b15406894be257859388a84"
"""Of mediapipe-pose-0.5.1675469404.tgz."""
WEIGHTS = ROOT / "preprocess/tracking/weights"
LANDMARK_OUTPUTS = {
    "Identity": "landmarks",
    "Identity_1": "presence",
    "Identity_2": "mask",
    "Identity_3": "heatmaps",
    "Identity_4": "world",
}


@dataclass(frozen=True, kw_only=True)
class Network:
    """One network of the package.

    Attributes:
        source: Its file in the package.
        source_sha256: Of that file.
        sha256: Of the ONNX file, written by onnx 1.23.2.
        outputs: Names of the outputs, by their names in the source.
    """

    source: str
    source_sha256: str
    sha256: str
    outputs: dict[str, str]


def landmark_network(size: str, source_sha256: str, sha256: str) -> Network:
    """The landmark network of one of three sizes."""
    return Network(
        source=f"package/pose_landmark_{size}.tflite",
        source_sha256=source_sha256,
        sha256=sha256,
        outputs=LANDMARK_OUTPUTS,
    )


NETWORKS = {
    "blazepose_detector": Network(
        source="package/pose_solution_packed_assets.data",  # holds the detector and nothing else
        source_sha256="a63c614bef30d35947f13be361820b1e4e3bec9cfeebf4d11216a18373108e85",
        sha256="785a098936d7e3f475c429c805cc7d2603f4b74f82e5fe0001f830d3bf93861d",
        outputs={"Identity": "boxes", "Identity_1": "scores"},
    ),
    "blazepose_landmarks_lite": landmark_network(
        "lite",
        "f17bfbecadb61c3be1baa8b8d851cc6619c870a87167b32848ad20db306b9d61",
        "26bbef94f6a47ed4ba8698062a87ac56da5ea0c2306528c6ceb38b1bbcd14bcb",
    ),
    "blazepose_landmarks_full": landmark_network(
        "full",
        "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
        "8f33f89e5f831c20f9b91b8522e38a1d74f38a1d5443687d0a545c418a962054",
    ),
    "blazepose_landmarks_heavy": landmark_network(
        "heavy",
        "59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe",
        "eeb38050d95b266100795d2e14aedefb76a43bf9e60cb602f2ebd177c1551df3",
    ),
}
"""Each ONNX file that can be made."""


def verified(data: bytes, sha256: str, what: str) -> bytes:
    """The data themselves; leaves the program if they are not the ones expected."""
    found = hashlib.sha256(data).hexdigest()
    if found != sha256:
        raise SystemExit(f"{what}: SHA-256 is {found}, expected {sha256}.")
    return data


def main() -> None:
    """Makes the networks."""
    parser = argparse.ArgumentParser(description="Makes the networks of the built-in tracker.")
    parser.add_argument("package", type=Path, help="mediapipe-pose-0.5.1675469404.tgz")
    parser.add_argument("--out", type=Path, default=WEIGHTS)
    parser.add_argument("--landmarks", nargs="+", default=["full"])
    arguments = parser.parse_args()
    verified(arguments.package.read_bytes(), PACKAGE_SHA256, arguments.package.name)
    names = [f"blazepose_landmarks_{size}" for size in arguments.landmarks]
    for name in ("blazepose_detector", *names):
        network = NETWORKS[name]
        with tarfile.open(arguments.package) as package:
            member = package.extractfile(network.source)
            assert member is not None
            source = verified(member.read(), network.source_sha256, network.source)
        written = OnnxWriter(TfliteModel(source)).write(network.outputs)
        data = written.SerializeToString(deterministic=True)
        path = arguments.out / f"{name}.onnx"
        path.write_bytes(verified(data, network.sha256, path.name))
        print(f"{path}: {len(data):,} bytes")  # noqa: T201


if __name__ == "__main__":
    main()
