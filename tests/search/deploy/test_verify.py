"""verify.py: what it says of a bundle that is well, and of one that is not, in one line."""

import ast
import json
import sys
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from rts2.search.deploy.bundle import script

Maker = Callable[..., Path]
CPU = ("cpu", "onnxruntime", "fp32")
OV = ("cpu", "openvino", "fp32")


def failed(ended: Any, *said: str) -> None:
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr.count("\n") == 1
    for text in said:
        assert text in ended.stderr


def test_the_script_is_python_3_6_and_needs_numpy_and_the_runtime_alone() -> None:
    """JetPack 4.6 has no other; and it imports nothing of rts2."""
    tree = ast.parse(script(), feature_version=(3, 6))
    imported = {
        name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names
    }
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert imported - set(sys.stdlib_module_names) == {"numpy", "onnxruntime", "openvino"}
    at_start = [name for node in tree.body if isinstance(node, ast.Import) for name in node.names]
    assert {name.name for name in at_start} <= set(sys.stdlib_module_names)
    folder = resources.files("rts2.search.deploy") / "scripts"
    assert [entry.name for entry in folder.iterdir() if entry.name.endswith(".py")] == ["verify.py"]


@pytest.mark.parametrize("precision", ["fp32", "int8"])
def test_a_bundle_that_is_well_is_told_with_both_frame_rates(
    copied: Maker, checked: Callable[..., Any], precision: str
) -> None:
    folder = copied("cpu", "onnxruntime", precision)
    ended = checked(folder)
    assert (ended.returncode, ended.stderr) == (0, "")
    lines = ended.stdout.splitlines()
    told = {line.split()[0]: line.split(maxsplit=1)[1:] for line in lines}
    assert told["runtime"][0].startswith("onnxruntime ")
    assert told["runtime"][0].endswith(f", {precision}")
    assert told["files"] == ["11, all as they were written"]
    assert [line.split(":")[0].split()[1] for line in lines if line.startswith("pair")] == [
        *("val-000000", "val-000001")
    ]
    assert float(told["measured"][0].split()[0]) > 0
    assert told["expected"] == ["25.0 FPS (21.5 to 29.0 at 90%) on onnxruntime, extrapolated"]
    assert lines[-1] == "ok"
    assert not list(folder.glob("*.log"))


def test_what_is_slower_than_promised_is_told(copied: Maker, checked: Callable[..., Any]) -> None:
    folder = copied("cpu", "onnxruntime", "fp32")
    path = folder / "deployment.json"
    known = json.loads(path.read_text())
    for low, slow in ((1e-3, False), (1e9, True)):
        known["expected"]["fps_low"] = low
        path.write_text(json.dumps(known))
        told = json.loads(checked(folder, "--json").stdout)
        assert told["ok"]
        assert any("slower than promised" in note for note in told["notes"]) is slow


def test_for_machines_it_is_one_object(copied: Maker, checked: Callable[..., Any]) -> None:
    ended = checked(copied(*CPU), "--json")
    assert (ended.returncode, ended.stderr, ended.stdout.count("\n")) == (0, "", 1)
    told = json.loads(ended.stdout)
    assert (told["schema"], told["ok"], told["notes"]) == ("rts2.verification/1", True, [])
    assert told["expected"]["fps_low"] == 21.5
    assert told["fps"] == pytest.approx(1000 / told["latency_ms"])
    assert told["runs"] >= 20
    for row in told["pairs"]:
        assert row["ok"]
        assert 0 <= row["mean_px"] <= row["percentile_px"] < 1e-3
        assert row["equal_classes"] > 0.999


def moved(folder: Path, name: str, by: Any) -> None:
    path = folder / name
    path.write_bytes((np.frombuffer(path.read_bytes(), "<f4") + np.float32(by)).tobytes())


@pytest.mark.parametrize("fault", ["mean", "percentile", "nan", "classes"])
def test_answers_that_are_too_far_off_fail(
    copied: Maker, checked: Callable[..., Any], rehashed: Callable[..., None], fault: str
) -> None:
    """Each tolerance alone: 0.01 px on average, 0.1 px at 99%, 99.9% of the classes."""
    folder = copied(*CPU)
    place = "samples/val-000001/disparity.bin"
    far = np.zeros(90 * 60, np.float32)
    if fault == "mean":
        moved(folder, place, 0.02)
    elif fault == "percentile":  # 1.1% of the pixels: 0.0033 px on average
        far[: len(far) * 11 // 1000] = 0.3
        moved(folder, place, far)
    elif fault == "nan":
        far[7] = np.nan
        moved(folder, place, far)
    else:
        path = folder / "samples/val-000001/semantic.bin"
        classes = np.frombuffer(path.read_bytes(), np.uint8).copy()
        classes[:20] = 200  # of 5400
        path.write_bytes(classes.tobytes())
    rehashed(folder)
    ended = checked(folder)
    assert ended.returncode == 1
    assert ended.stderr == "FAILED: the answers are too far off on val-000001\n"
    assert "ok" not in ended.stdout.split()
    told = json.loads(checked(folder, "--json").stdout)
    assert [row["ok"] for row in told["pairs"]] == [True, False]
    assert told["ok"] is False


@pytest.mark.parametrize("kind", [CPU, ("tx2", "tensorrt", "fp16")])
@pytest.mark.parametrize(
    "name", ["model.onnx", "samples/val-000001/left.ppm", "README.md", "verify.py"]
)
def test_a_changed_file_is_named(
    copied: Maker, checked: Callable[..., Any], kind: Any, name: str
) -> None:
    folder = copied(*kind)
    with (folder / name).open("ab") as file:
        file.write(b"#")
    failed(checked(folder), f"{name} has changed since it was written")


@pytest.mark.parametrize("name", ["model.onnx", "deployment.json", "samples/val-000000/right.ppm"])
def test_a_missing_file_is_named(copied: Maker, checked: Callable[..., Any], name: str) -> None:
    folder = copied(*CPU)
    (folder / name).unlink()
    failed(checked(folder), f"{name} is missing: copy the whole bundle")


@pytest.mark.parametrize("text", ["", "{", "{}", '{"schema": "rts2.deployment/1", "check": null}'])
def test_a_configuration_that_is_none_is_told(
    copied: Maker, checked: Callable[..., Any], text: str
) -> None:
    folder = copied(*CPU)
    (folder / "deployment.json").write_text(text)
    failed(checked(folder), "deployment.json is no")


@pytest.mark.parametrize("name", ["fps_low", "confidence"])
def test_a_configuration_that_lacks_something_is_told(
    copied: Maker, checked: Callable[..., Any], name: str
) -> None:
    """Told before the check of speed, or while it is printed."""
    folder = copied(*CPU)
    path = folder / "deployment.json"
    known = json.loads(path.read_text())
    del known["expected"][name]
    path.write_text(json.dumps(known))
    ended = checked(folder)
    assert ended.returncode == 1
    assert ended.stderr == f"deployment.json lacks '{name}': copy it again\n"


def externalize(folder: Path) -> None:
    """The graph's weights in a file of their own."""
    model = onnx.load(folder / "model.onnx")
    options = {"save_as_external_data": True, "location": "weights.bin", "size_threshold": 1000}
    onnx.save_model(model, folder / "model.onnx", **options)


@pytest.mark.parametrize("listed", [True, False])
def test_weights_that_are_missing_are_named(
    copied: Maker, checked: Callable[..., Any], rehashed: Callable[..., None], listed: bool
) -> None:
    folder = copied(*CPU)
    externalize(folder)
    rehashed(folder, *(["weights.bin"] if listed else []))
    assert checked(folder).returncode == 0
    (folder / "weights.bin").unlink()
    said = "weights.bin is missing" if listed else "model.onnx is not read by onnxruntime"
    failed(checked(folder), said, "weights.bin")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"P6\n80 60\n255\n" + bytes(80 * 60 * 3), "is 80x60, and the network takes 90x60"),
        (b"P6\n90 60\n255\n" + bytes(100), "ends too early"),
        (b"P6\n90 60\n65535\n" + bytes(90 * 60 * 6), "is no binary PPM of 8 bits"),
        (b"\x89PNG", "is no binary PPM of 8 bits"),
    ],
)
def test_images_of_another_size_or_type_are_told(
    copied: Maker,
    checked: Callable[..., Any],
    rehashed: Callable[..., None],
    data: bytes,
    said: str,
) -> None:
    folder = copied(*CPU)
    (folder / "samples/val-000000/left.ppm").write_bytes(data)
    rehashed(folder)
    failed(checked(folder), "samples/val-000000/left.ppm", said)


def test_expected_maps_of_another_size_are_told(
    copied: Maker, checked: Callable[..., Any], rehashed: Callable[..., None]
) -> None:
    folder = copied(*CPU)
    (folder / "samples/val-000000/disparity.bin").write_bytes(bytes(400))
    rehashed(folder)
    failed(checked(folder), "disparity.bin holds 100 values, not 60x90")


@pytest.mark.parametrize("kind", [CPU, OV])
def test_another_version_of_the_runtime_is_noted(
    copied: Maker, checked: Callable[..., Any], rehashed: Callable[..., None], kind: Any
) -> None:
    if kind is OV:
        pytest.importorskip("openvino", reason="needs OpenVINO: pip install 'rts2[openvino]'")
    folder = copied(*kind)
    runtime = kind[1]
    known = json.loads((folder / "deployment.json").read_text())["versions"]
    rehashed(folder, versions=known | {runtime: "1.2.3"})
    ended = checked(folder)
    assert (ended.returncode, ended.stderr) == (0, "")
    told = f"the bundle was written with {runtime} 1.2.3, and this is {runtime} {known[runtime]}"
    assert f"note      {told}\n" in ended.stdout


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino", "numpy"])
def test_a_package_that_is_missing_is_named(
    copied: Maker, checked: Callable[..., Any], runtime: str
) -> None:
    folder = copied(*(OV if runtime == "openvino" else CPU))
    ended = checked(folder, instead={runtime: "raise ImportError"})
    failed(ended, f"{runtime} is missing: python3 -m pip install {runtime} brings it")


OTHER_PRECISION = """
__version__ = "2026.4.1"

class Core:
    def compile_model(self, path, device, settings):
        assert settings["INFERENCE_PRECISION_HINT"] == "f32"
        return self

    def get_property(self, name):
        assert name == "INFERENCE_PRECISION_HINT"
        return self

    def get_type_name(self):
        return "bf16"
"""
"""An OpenVINO that takes bf16 whatever it was told."""


def test_another_precision_than_was_asked_for_is_told(
    copied: Maker, checked: Callable[..., Any]
) -> None:
    ended = checked(copied(*OV), instead={"openvino": OTHER_PRECISION})
    failed(ended, "OpenVINO computes in bf16 on this processor, not in f32")


def test_openvino_answers_in_every_precision_of_the_processor(
    copied: Maker, checked: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("openvino", reason="needs OpenVINO: pip install 'rts2[openvino]' brings it")
    from rts2.profiles.runtimes import ov

    for precision in (*ov.precisions("fp32"), "int8"):
        folder = copied("cpu", "openvino", precision)
        told = json.loads(checked(folder, "--json").stdout)
        assert told["ok"]
        assert told["precision"] == precision
        assert told["runtime"].startswith("openvino ")
        far = [row["mean_px"] for row in told["pairs"]]
        assert max(far) < 1e-3 if precision == "fp32" else 0 < max(far) < 1
        folder.rename(tmp_path / precision)


def test_an_optimized_graph_is_written_on_request_and_answers_the_same(
    copied: Maker, checked: Callable[..., Any]
) -> None:
    import onnxruntime

    folder = copied(*CPU)
    ended = checked(folder, "--save-optimized")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "note      optimized.onnx opens in" in ended.stdout
    inputs = {name: np.ones((1, 3, 64, 96), np.float32) for name in ("left", "right")}
    found = [
        onnxruntime.InferenceSession(folder / name, providers=["CPUExecutionProvider"]).run(
            ["disparity"], inputs
        )[0]
        for name in ("model.onnx", "optimized.onnx")
    ]
    assert np.abs(found[0] - found[1]).max() < 1e-4
    assert checked(folder).returncode == 0  # it is none of the bundle's files
    assert not list(folder.glob("*.part"))


def test_only_onnx_runtime_writes_an_optimized_graph(
    copied: Maker, checked: Callable[..., Any]
) -> None:
    ended = checked(copied("tx2", "tensorrt", "fp16"), "--save-optimized")
    failed(ended, "--save-optimized is for onnxruntime; this bundle runs on tensorrt")
