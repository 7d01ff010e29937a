"""The deployment bundle: what is in it, and that equal arguments give equal bytes."""

import hashlib
import json
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch

from rts2.model.arch import Arch
from rts2.model.bundle import CONFIGURATION, MODEL, graph_of
from rts2.model.checkpoint import build
from rts2.model.data.catalog import open_dataset
from rts2.model.errors import Rts2Error, UsageError
from rts2.model.export import Deployed
from rts2.model.graph import load_graph, read_header
from rts2.model.predictor import prepared
from rts2.profiles import opset
from rts2.profiles.opset import load_opset, operators, refuse_operators
from rts2.profiles.profile import Profile, load
from rts2.search.deploy.bundle import TARGETS, Source, runtime_of, stale, write
from rts2.search.deploy.configuration import read
from rts2.search.deploy.ov import between_integers
from rts2.search.deploy.schema import Deployment

SIZE = (90, 60)
SHAPE = (1, 3, 64, 96)
SMALL = Arch(c=1, stages=2, d_max=6, conv3d=(4, 2))
Maker = Callable[..., Path]
Kinds = tuple[Any, ...]

FLOAT: list[Kinds] = [
    ("tx2", "tensorrt", "fp16"),
    ("rtx2080ti", "pytorch", "fp32"),
    ("cpu", "onnxruntime", "fp32"),
]
"""What a front's pick runs on."""

ALL: list[Kinds] = [
    *FLOAT,
    ("cpu", "onnxruntime", "int8"),
    ("cpu", "openvino", "fp32"),
    ("cpu", "openvino", "bf16"),
    ("cpu", "openvino", "int8"),
    ("rtx2080ti", "tensorrt", "int8"),
    ("rtx2080ti", "tensorrt", "fp16", "11"),
    ("rtx2080ti", "tensorrt", "int8", "11"),
    ("cpu", "onnxruntime", "fp32", None, True),
    ("rtx2080ti", "tensorrt", "fp16", None, True),
]


def names(folder: Path) -> set[str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix() for path in files}


def expected_names(kind: Kinds) -> set[str]:
    device, runtime, precision, *more = kind
    found = {"README.md", "model.onnx", "verify.py", CONFIGURATION}
    for pair in ("val-000000", "val-000001"):
        files = ("left.ppm", "right.ppm", "disparity.bin", "semantic.bin")
        found |= {f"samples/{pair}/{name}" for name in files}
    if device != "cpu":
        found.add("build.sh")
    if runtime == "openvino" and precision != "fp32":
        found |= {"model.xml", "model.bin"}
    if more[1:] == [True]:
        found.add("triton/rts2net/config.pbtxt")
        found |= {"triton/rts2net/1/model.onnx"} if device == "cpu" else set()
    return found


def stored(folder: Path, name: str, kind: str) -> Any:
    return np.fromfile(folder / name, kind).reshape(SIZE[1], SIZE[0])


@pytest.mark.parametrize("kind", ALL)
def test_the_files_are_those_listed_with_their_sizes_and_hashes(bundle: Maker, kind: Kinds) -> None:
    folder = bundle(*kind)
    deployment = read(folder / CONFIGURATION)
    listed = {file.name: file for file in deployment.files}
    assert names(folder) == listed.keys() | {CONFIGURATION} == expected_names(kind)
    for name, file in listed.items():
        data = (folder / name).read_bytes()
        assert file.size_bytes == len(data)
        assert file.sha256 == hashlib.sha256(data).hexdigest()
    assert graph_of(folder) == folder / "model.onnx"
    readme = (folder / "README.md").read_text(encoding="utf-8")
    told = {name.partition("/")[0] for name in names(folder)} - {"README.md"}
    assert all(f"`{name}`" in readme or f"`{name}/*`" in readme for name in told)


@pytest.mark.parametrize("kind", FLOAT)
def test_the_configuration_promises_with_an_interval_and_its_evidence(
    bundle: Maker, kind: Kinds
) -> None:
    device, runtime, precision = kind
    folder = bundle(*kind)
    deployment = read(folder / CONFIGURATION)
    assert (deployment.device, deployment.arch) == (device, SMALL)
    assert deployment.runtime == runtime_of(load(device)).runtime
    assert (deployment.precision, deployment.weights) == (precision, "untrained")
    assert deployment.target_fps == 20
    expected = deployment.expected
    assert expected is not None
    assert expected.runtime == runtime
    assert (expected.fps_low, expected.fps, expected.fps_high) == (21.5, 25, 29)
    assert (expected.evidence.latency, expected.evidence.accuracy) == ("extrapolated", "published")
    assert expected.confidence == 0.9
    readme = " ".join((folder / "README.md").read_text(encoding="utf-8").split())
    assert "25.0 FPS (21.5 to 29.0 at 90%), extrapolated" in readme
    assert TARGETS[deployment.runtime].next_step in readme
    assert "random" in readme
    # The speed of PyTorch is promised, and TensorRT is what runs: said, not hidden.
    assert ("for pytorch; what is built here runs on tensorrt" in readme) == (device == "rtx2080ti")


@pytest.mark.parametrize("kind", ALL)
def test_the_graph_is_one_that_the_runtime_reads(bundle: Maker, kind: Kinds) -> None:
    path = bundle(*kind) / "model.onnx"
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    version, used = operators(path)
    assert version <= (17 if kind[0] == "cpu" else 13)
    assert used
    assert all(entry.domain in ("", "ai.onnx") for entry in model.opset_import)
    if kind[0] != "cpu":
        assert set(used) <= load_opset("tensorrt-8.2").operators.keys()
    deployment = read(path.with_name(CONFIGURATION))
    dims = {
        value.name: tuple(d.dim_value for d in value.type.tensor_type.shape.dim)
        for value in (*model.graph.input, *model.graph.output)
    }
    assert dims == {
        **dict.fromkeys(deployment.input.names, deployment.input.shape),
        **{output.name: output.shape for output in deployment.outputs},
    }
    assert deployment.input.shape == SHAPE
    header = read_header(path)
    assert (header.arch, header.resolution, header.origin) == (SMALL, SIZE, "untrained")


@pytest.mark.parametrize("kind", [kind for kind in ALL if kind[2] != "int8"])
def test_the_samples_are_scenes_and_what_pytorch_says_of_them(bundle: Maker, kind: Kinds) -> None:
    folder = bundle(*kind)
    deployment = read(folder / CONFIGURATION)
    assert deployment.check is not None
    torch.manual_seed(0)
    network = Deployed(build(SMALL)).eval()
    scenes = open_dataset("streets", split="val", count=2, size=SIZE)
    for sample, scene in zip(deployment.check.samples, scenes, strict=True):
        pair = scene.read()
        for name, image in zip(sample.images, (pair.left, pair.right), strict=True):
            assert (folder / name).read_bytes() == b"P6\n90 60\n255\n" + image.tobytes()
        inputs = [torch.from_numpy(prepared(image, 32)) for image in (pair.left, pair.right)]
        with torch.inference_mode():
            disparity, classes = (maps[0, : SIZE[1], : SIZE[0]] for maps in network(*inputs))
        found = stored(folder, sample.disparity, "<f4")
        assert np.abs(found - disparity.numpy()).max() < 1e-3
        assert found.std() > 0
        assert sample.semantic is not None
        assert (stored(folder, sample.semantic, "u1") == classes.numpy()).mean() > 0.999
    first, second = deployment.check.samples
    assert (folder / first.images[0]).read_bytes() != (folder / second.images[0]).read_bytes()


def test_without_classes_none_are_expected(
    order: Callable[..., tuple[Profile, Deployment]], tmp_path: Path
) -> None:
    arch = Arch(c=1, stages=1, d_max=6, conv3d=(4,), semantic=False)
    profile, deployment = order("cpu", "onnxruntime", "fp32")
    alone = deployment.model_copy(
        update={"arch": arch, "forms": None, "outputs": deployment.outputs[:1]}
    )
    made = write(Source(build(arch), "untrained"), alone, profile, tmp_path)
    assert made.check is not None
    assert [sample.semantic for sample in made.check.samples] == [None, None]
    assert not [name for name in names(tmp_path) if "semantic" in name]
    assert "semantic" not in (tmp_path / "README.md").read_text()


def test_integers_are_expected_to_say_what_they_say_themselves(bundle: Maker) -> None:
    """The float network is near, and not the same."""
    import onnxruntime

    folder, floats = (bundle("cpu", "onnxruntime", precision) for precision in ("int8", "fp32"))
    assert read_header(folder / "model.onnx").precision == "int8"
    assert {"QuantizeLinear", "DequantizeLinear"} <= set(operators(folder / "model.onnx")[1])
    session = onnxruntime.InferenceSession(
        folder / "model.onnx", providers=["CPUExecutionProvider"]
    )
    pair = open_dataset("streets", split="val", count=2, size=SIZE)[0].read()
    inputs = {"left": prepared(pair.left, 32), "right": prepared(pair.right, 32)}
    answer = session.run(["disparity"], inputs)[0][0, : SIZE[1], : SIZE[0]]
    own, other = (
        stored(each, "samples/val-000000/disparity.bin", "<f4") for each in (folder, floats)
    )
    assert np.abs(own - answer).max() < 1e-5
    assert 0 < np.abs(own - other).mean() < 5


def convolutions(folder: Path) -> list[str]:
    graph = onnx.load(folder / "model.onnx").graph
    return [node.name for node in graph.node if node.op_type == "Conv"]


@pytest.mark.parametrize(
    ("kind", "rest"),
    [
        (("cpu", "onnxruntime", "int8"), "fp32"),
        (("rtx2080ti", "tensorrt", "int8"), "fp16"),
        (("rtx2080ti", "tensorrt", "int8", "11"), "fp32"),
    ],
)
def test_every_layer_of_a_network_in_integers_has_its_precision_and_why(
    bundle: Maker, kind: Kinds, rest: str
) -> None:
    folder = bundle(*kind)
    rows = read(folder / CONFIGURATION).layers
    assert Counter(row.layer for row in rows) == Counter([*convolutions(folder), "*"])
    graph = onnx.load(folder / "model.onnx").graph
    quantized = {node.output[0] for node in graph.node if node.op_type == "DequantizeLinear"}
    in_integers = {
        node.name
        for node in graph.node
        if node.op_type == "Conv" and {node.input[0], node.input[1]} <= quantized
    }
    assert {row.layer for row in rows if row.precision == "int8"} == in_integers
    assert {row.precision for row in rows if row.layer not in in_integers} == {rest}
    assert all(row.reason for row in rows)
    told = {row.layer: row.reason for row in rows}
    known = "large maps" if kind[0] == "cpu" else "three channels"
    assert known in told["encoder.stem.0.0/Conv"]
    named = "large maps" if kind[0] == "cpu" else "3D convs"
    assert named in told["regularize.1.layers.0/Conv"]


def test_the_pairs_of_tensorrt_have_zero_points_of_zero(bundle: Maker) -> None:
    graph = onnx.load(bundle("rtx2080ti", "tensorrt", "int8") / "model.onnx").graph
    weights = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}
    points = [
        weights[node.input[2]]
        for node in graph.node
        if node.op_type in ("QuantizeLinear", "DequantizeLinear")
    ]
    assert points
    assert all(point.dtype == np.int8 and not point.any() for point in points)


def test_what_was_calibrated_on_is_told_and_nothing_where_nothing_was(bundle: Maker) -> None:
    for kind in ALL:
        told = read(bundle(*kind) / CONFIGURATION).calibration
        if kind[2] == "int8":
            assert told.images == tuple(f"0-{index:06d}" for index in range(16))
            assert (told.dataset, told.seed, told.method) == ("streets", 0, "percentile")
            assert told.fingerprint == "streets v3 seed 0 90x60 1/1/0"
        else:
            assert (told.images, told.fingerprint) == ((), None)


def test_float_is_one_line_and_half_precision_names_what_stays_float(bundle: Maker) -> None:
    (row,) = read(bundle("cpu", "onnxruntime", "fp32") / CONFIGURATION).layers
    assert (row.layer, row.precision) == ("*", "fp32")
    for kind in (("cpu", "openvino", "bf16"), ("rtx2080ti", "tensorrt", "fp16", "11")):
        first, *kept = read(bundle(*kind) / CONFIGURATION).layers
        assert (first.layer, first.precision) == ("*", kind[2])
        assert {row.precision for row in kept} == {"fp32"}
        assert any("soft-argmin" in row.reason for row in kept)
        assert not {row.layer for row in kept} & set(convolutions(bundle(*kind)))


def test_the_options_of_a_runtime_are_told(bundle: Maker) -> None:
    ort = read(bundle("cpu", "onnxruntime", "fp32") / CONFIGURATION).execution
    machine = load("cpu").machine
    assert ort is not None
    assert machine is not None
    assert ort.model_dump() == {
        "runtime": "onnxruntime",
        "file": "model.onnx",
        "provider": "CPUExecutionProvider",
        "intra_op_threads": machine.threads,
        "inter_op_threads": 1,
        "graph_optimization": "all",
        "execution_mode": "sequential",
    }
    for precision, hint, file in (
        ("fp32", "f32", "model.onnx"),
        ("bf16", "bf16", "model.xml"),
        ("int8", "bf16", "model.xml"),
    ):
        ov = read(bundle("cpu", "openvino", precision) / CONFIGURATION).execution
        assert ov is not None
        assert ov.runtime == "openvino"
        assert ov.file == file
        assert ov.properties["INFERENCE_PRECISION_HINT"] == hint
        assert ov.properties["INFERENCE_NUM_THREADS"] == machine.threads


def test_between_integers_openvino_is_told_what_the_device_was_timed_in() -> None:
    known = load("cpu")
    (first, *_) = known.calibrations
    assert between_integers(known.model_copy(update={"calibrations": (first,)})) == "fp32"
    half = first.model_copy(update={"runtime": "openvino", "precision": "bf16"})
    assert between_integers(known.model_copy(update={"calibrations": (first, half)})) == "bf16"


def test_a_graph_is_in_the_steps_that_suit_its_runtime(bundle: Callable[..., Path]) -> None:
    """OpenVINO sorts for an argmax."""
    for runtime, wanted in (("onnxruntime", True), ("openvino", False)):
        model = load_graph(bundle("cpu", runtime, "fp32") / MODEL)
        assert any(node.op_type == "ArgMax" for node in model.graph.node) is wanted


REPEATED = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import conftest
for name in sys.argv[3].split(","):
    words = [word or None for word in name.split("-")]
    words[4:] = [True] if words[4:] else []
    conftest.written(Path(sys.argv[2]) / name, conftest.Kind(*words))
"""


def test_two_processes_write_equal_bytes_whatever_they_made_before(tmp_path: Path) -> None:
    """In another order, into another folder."""
    made = ["cpu-onnxruntime-int8", "tx2-tensorrt-fp16", "rtx2080ti-tensorrt-int8-10-triton"]
    try:
        import openvino  # noqa: F401
    except ImportError:
        pass
    else:
        made += ["cpu-openvino-bf16", "cpu-openvino-int8"]
    here = str(Path(__file__).parent)
    for folder, order in (("a", made), ("b/deeper", made[::-1])):
        words = [sys.executable, "-c", REPEATED, here, str(tmp_path / folder), ",".join(order)]
        subprocess.run(words, check=True)
    for name in made:
        first, second = tmp_path / "a" / name, tmp_path / "b/deeper" / name
        assert names(first) == names(second)
        assert len(names(first)) >= 12
        for file in names(first):
            assert (first / file).read_bytes() == (second / file).read_bytes(), (name, file)
            assert str(tmp_path).encode() not in (first / file).read_bytes()


def test_a_bundle_is_made_for_the_runtime_that_was_asked_for_where_one_can_be(
    ort_alone: Profile,
) -> None:
    both = load("cpu")
    assert runtime_of(both).runtime == "onnxruntime"
    for runtime in ("onnxruntime", "openvino"):
        assert runtime_of(both, runtime).runtime == runtime
    assert runtime_of(ort_alone, "openvino").runtime == "onnxruntime"
    assert runtime_of(load("tx2"), "pytorch").runtime == "tensorrt"


def test_without_a_runtime_the_first_that_has_the_precision_is_taken(ort_alone: Profile) -> None:
    both = load("cpu")
    assert runtime_of(both, precision="int8").runtime == "onnxruntime"
    assert runtime_of(both, precision="bf16").runtime == "openvino"
    assert runtime_of(ort_alone, precision="bf16").runtime == "onnxruntime"


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (
            ("cpu", "onnxruntime", "bf16"),
            "runs fp32 or int8 on onnxruntime, not bf16; --runtime openvino has it",
        ),
        (("cpu", "onnxruntime", "fp16"), "not fp16; rts2-quantize makes such a graph"),
        (("tx2", "tensorrt", "int8"), "Jetson TX2 does not run int8: sm_62 has no DP4A"),
    ],
)
def test_a_precision_that_the_bundle_cannot_run_is_refused(
    order: Callable[..., tuple[Profile, Deployment]], tmp_path: Path, kind: Kinds, said: str
) -> None:
    profile, deployment = order(*kind)
    with pytest.raises(UsageError, match=said):
        write(Source(build(SMALL), "untrained"), deployment, profile, tmp_path)
    assert names(tmp_path) == set()


def test_operators_that_the_runtime_lacks_are_all_named(
    bundle: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    support = runtime_of(load("tx2"))
    path = bundle("tx2", "tensorrt", "fp16") / "model.onnx"
    refuse_operators(path, support)
    table = load_opset("tensorrt-8.2")
    few = {name: op for name, op in table.operators.items() if name not in ("Conv", "Exp")}
    monkeypatch.setattr(opset, "load_opset", lambda _: table.model_copy(update={"operators": few}))
    with pytest.raises(Rts2Error, match="the graph needs Conv, Exp") as error:
        refuse_operators(path, support)
    assert error.value.exit_code == 1
    monkeypatch.setattr(opset, "load_opset", lambda _: table.model_copy(update={"max_opset": 12}))
    with pytest.raises(Rts2Error, match=r"opset 12 at most .* needs opset 13"):
        refuse_operators(path, support)


def test_a_device_without_a_runtime_of_ours_is_refused() -> None:
    profile = load("tx2")
    only = tuple(support for support in profile.runtimes if support.runtime == "pytorch")
    with pytest.raises(UsageError, match="no runtime that a bundle can be made for"):
        runtime_of(profile.model_copy(update={"runtimes": only}))


@pytest.mark.parametrize("difference_px", [2e-3, float("nan")])
def test_a_graph_that_is_not_its_network_is_refused(
    order: Callable[..., tuple[Profile, Deployment]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    difference_px: float,
) -> None:
    from rts2.model import export

    monkeypatch.setattr(export, "parity", lambda *_: export.Parity(difference_px, None))
    profile, deployment = order("cpu", "onnxruntime", "fp32")
    with pytest.raises(Rts2Error, match="differs from its network") as error:
        write(Source(build(SMALL), "trained"), deployment, profile, tmp_path)
    assert error.value.exit_code == 1


def test_what_an_earlier_bundle_left_is_known_of_earlier_versions_too(tmp_path: Path) -> None:
    assert stale(tmp_path) == ()
    known = {"schema": "rts2.deployment/1", "check": {"inputs": ["a", "b"]}}
    known["files"] = [{"name": name, "sha256": "0" * 64} for name in ("check.py", "model.onnx")]
    (tmp_path / CONFIGURATION).write_text(json.dumps(known))
    found = {path.name for path in stale(tmp_path)}
    assert {"check.py", "model.onnx", "model.plan", "optimized.onnx", "layers.json"} <= found
    known["files"] = []
    (tmp_path / CONFIGURATION).write_text(json.dumps(known))
    assert stale(tmp_path) == ()


def test_a_copy_runs_wherever_it_lies(bundle: Maker, tmp_path: Path) -> None:
    """Nothing in a bundle points out of it."""
    folder = bundle("cpu", "onnxruntime", "fp32")
    place = shutil.copytree(folder, tmp_path / "a folder" / "büro")
    ended = subprocess.run(
        [sys.executable, "verify.py"], cwd=place, capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stderr) == (0, "")
