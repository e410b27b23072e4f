"""Makes the networks in preprocess/tracking/weights from the published BlazePose models.

For developers only; using the project does not require it. From the project's root:

    npm pack @mediapipe/pose@0.5.1675469404
    python dev/make_blazepose.py mediapipe-pose-0.5.1675469404.tgz

`--check` compares each network with the runtime that it was made for, on random pictures or on
one that is given (of a person who fills a square); it needs `pip install ai-edge-litert==2.3.0`.
`--landmarks lite full heavy` makes all sizes of the landmark network.
"""

import argparse
import hashlib
import sys
import tarfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

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
        picture_range: Smallest and largest value of a picture.
    """

    source: str
    source_sha256: str
    sha256: str
    outputs: dict[str, str]
    picture_range: tuple[float, float]


def landmark_network(size: str, source_sha256: str, sha256: str) -> Network:
    """The landmark network of one of three sizes."""
    return Network(
        source=f"package/pose_landmark_{size}.tflite",
        source_sha256=source_sha256,
        sha256=sha256,
        outputs=LANDMARK_OUTPUTS,
        picture_range=(0.0, 1.0),
    )


NETWORKS = {
    "blazepose_detector": Network(
        source="package/pose_solution_packed_assets.data",  # holds the detector and nothing else
        source_sha256="a63c614bef30d35947f13be361820b1e4e3bec9cfeebf4d11216a18373108e85",
        sha256="785a098936d7e3f475c429c805cc7d2603f4b74f82e5fe0001f830d3bf93861d",
        outputs={"Identity": "boxes", "Identity_1": "scores"},
        picture_range=(-1.0, 1.0),
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


def worst_errors(
    source: bytes, written: bytes, pictures: list[Float32[np.ndarray, "1 rows columns 3"]]
) -> dict[str, tuple[float, float]]:
    """Largest difference to the original runtime and largest value, by the output's name there."""
    import onnxruntime
    from ai_edge_litert.interpreter import (  # pyright: ignore[reportMissingImports] - see above
        Interpreter,
    )

    original = Interpreter(model_content=source, num_threads=1)
    original.allocate_tensors()
    session = onnxruntime.InferenceSession(written, providers=["CPUExecutionProvider"])
    worst: dict[str, tuple[float, float]] = {}
    for picture in pictures:
        original.set_tensor(original.get_input_details()[0]["index"], picture)
        original.invoke()
        details = sorted(original.get_output_details(), key=lambda each: each["name"])
        outputs = session.run(None, {"image": picture})
        names = [output.name for output in session.get_outputs()]
        for detail in details:
            expected = original.get_tensor(detail["index"])
            suffix = detail["name"].split(":")[-1]
            index = int(suffix) if suffix.isdigit() else details.index(detail)
            ours = np.asarray(outputs[index])
            ours = ours.transpose(0, 2, 3, 1) if ours.ndim == 4 else ours
            error, size = worst.get(names[index], (0.0, 0.0))
            worst[names[index]] = (
                max(error, float(np.abs(ours - expected).max())),
                max(size, float(np.abs(expected).max())),
            )
    return worst


def check_pictures(
    network: Network, size: int, picture: Path | None
) -> list[Float32[np.ndarray, "1 rows columns 3"]]:
    """Three pictures of noise, smooth and rough; instead of them the one that is given."""
    import cv2

    if picture is None:
        rng = np.random.default_rng(0)
        noise = [rng.random((cells, cells, 3), np.float32) for cells in (4, 32, size)]
        pictures = [cv2.resize(each, (size, size)) for each in noise]
    else:
        rgb = cv2.cvtColor(cv2.imread(str(picture)), cv2.COLOR_BGR2RGB)
        pictures = [cv2.resize(rgb, (size, size)).astype(np.float32) / 255]
    low, high = network.picture_range
    return [(low + (high - low) * each[None]).astype(np.float32) for each in pictures]


def main() -> None:
    """Makes the networks."""
    parser = argparse.ArgumentParser(description="Makes the networks of the built-in tracker.")
    parser.add_argument("package", type=Path, help="mediapipe-pose-0.5.1675469404.tgz")
    parser.add_argument("--out", type=Path, default=WEIGHTS)
    parser.add_argument("--landmarks", nargs="+", default=["full"])
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--picture", type=Path, help="for --check: a picture of a person")
    arguments = parser.parse_args()
    verified(arguments.package.read_bytes(), PACKAGE_SHA256, arguments.package.name)
    names = [f"blazepose_landmarks_{size}" for size in arguments.landmarks]
    for name in ("blazepose_detector", *names):
        network = NETWORKS[name]
        with tarfile.open(arguments.package) as package:
            member = package.extractfile(network.source)
            assert member is not None
            source = verified(member.read(), network.source_sha256, network.source)
        model = TfliteModel(source)
        written = OnnxWriter(model).write(network.outputs).SerializeToString(deterministic=True)
        path = arguments.out / f"{name}.onnx"
        path.write_bytes(verified(written, network.sha256, path.name))
        print(f"{path}: {len(written):,} bytes")  # noqa: T201
        if arguments.check:
            pictures = check_pictures(network, model.shapes[model.inputs[0]][1], arguments.picture)
            for output, (error, size) in worst_errors(source, written, pictures).items():
                print(f"  {output}: off by {error:.2g} at most, values up to {size:.3g}")  # noqa: T201


if __name__ == "__main__":
    main()
