"""The examples for users of bundles: C++ is built and run, what ROS 2 needs is parsed."""

import ast
import importlib.util
import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from rts2.model.arch import MEAN, STD
from rts2.model.data.images import read_rgb
from rts2.model.data.pfm import read_pfm

EXAMPLES = Path(__file__).parents[3] / "docs" / "examples"
ROS2 = EXAMPLES / "ros2"
Maker = Callable[..., Path]
CPU = ("cpu", "onnxruntime", "fp32")
PLACE = "samples/val-000000"


def expected(folder: Path) -> Any:
    return np.fromfile(folder / PLACE / "disparity.bin", "<f4").reshape(60, 90)


@pytest.fixture(scope="session")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The C++ example, built."""
    prefix = os.environ.get("ONNXRUNTIME_PREFIX")
    if not prefix or not shutil.which("cmake") or not shutil.which("g++"):
        pytest.skip("needs CMake, g++ and ONNXRUNTIME_PREFIX, ONNX Runtime's include/ and lib/")
    build = tmp_path_factory.mktemp("build")
    for words in (
        ["cmake", "-S", EXAMPLES / "cpp", "-B", build, f"-DCMAKE_PREFIX_PATH={prefix}"],
        ["cmake", "--build", build],
    ):
        ended = subprocess.run(words, capture_output=True, text=True, check=False)
        assert ended.returncode == 0, ended.stdout + ended.stderr
        assert "warning" not in (ended.stdout + ended.stderr).lower()
    return build / "stereo"


def ran(program: Path, *words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([program, *map(str, words)], capture_output=True, text=True, check=False)


def test_c_plus_plus_answers_as_the_bundle_expects(
    bundle: Maker, program: Path, tmp_path: Path
) -> None:
    folder = bundle(*CPU)
    pair = [folder / PLACE / name for name in ("left.ppm", "right.ppm")]
    ended = ran(program, folder / "model.onnx", *pair, tmp_path / "disparity.pfm", 1)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "FPS, median of 20 runs" in ended.stdout
    found = read_pfm(tmp_path / "disparity.pfm")
    assert np.abs(found - expected(folder)).max() < 1e-3


def test_c_plus_plus_tells_what_is_wrong_in_one_line(
    bundle: Maker, program: Path, tmp_path: Path
) -> None:
    folder = bundle(*CPU)
    left = folder / PLACE / "left.ppm"
    small, short = tmp_path / "small.ppm", tmp_path / "short.ppm"
    small.write_bytes(b"P6\n60 60\n255\n" + bytes(60 * 60 * 3))
    short.write_bytes(b"P6\n90 60\n255\n" + bytes(60))
    cases: list[tuple[str, tuple[Path, ...]]] = [
        ("the images must be of one size that pads to 96x64", (small, small)),
        ("the images must be of one size", (left, small)),
        (f"{short} ends too early", (short, left)),
        ("is no binary PPM of 8 bits", (folder / "model.onnx", left)),
        ("is no binary PPM of 8 bits", (tmp_path / "none.ppm", left)),
    ]
    for said, pair in cases:
        ended = ran(program, folder / "model.onnx", *pair, tmp_path / "out.pfm", 1)
        assert (ended.returncode, ended.stdout) == (1, "")
        assert said in ended.stderr
        assert ended.stderr.count("\n") == 1
    ended = ran(program, left, left, left, tmp_path / "out.pfm")
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ran(program).returncode == 2
    assert not (tmp_path / "out.pfm").exists()


def test_c_plus_plus_has_the_constants_of_every_bundle() -> None:
    text = (EXAMPLES / "cpp" / "stereo.cpp").read_text(encoding="utf-8")
    for name, values in (("kMean", MEAN), ("kStd", STD)):
        assert f"{name} = {{{', '.join(f'{value}f' for value in values)}}};" in text


def network(folder: Path) -> Any:
    """The half of the node that knows nothing of ROS, on a bundle."""
    spec = importlib.util.spec_from_file_location("network", ROS2 / "rts2_stereo" / "network.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Network(folder)


def test_the_network_of_the_ros_2_node_answers_as_the_bundle_expects(bundle: Maker) -> None:
    folder = bundle(*CPU)
    ours = network(folder)
    assert ours.size == (90, 60)
    left, right = (read_rgb(folder / PLACE / f"{name}.ppm") for name in ("left", "right"))
    assert np.abs(ours.disparity(left, right) - expected(folder)).max() < 1e-3
    with pytest.raises(ValueError, match="the images are 80x60, and the bundle is for 90x60"):
        ours.disparity(left[:, :80], right[:, :80])
    with pytest.raises(ValueError, match="runs on tensorrt; this node runs onnxruntime"):
        network(bundle("tx2", "tensorrt", "fp16"))


def test_the_ros_2_package_is_whole() -> None:
    """Its Python parses, its modules are listed as dependencies, its entry point exists."""
    imported = set()
    for path in ROS2.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 10))
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                imported |= {name.name.partition(".")[0] for name in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                imported.add(str(node.module).partition(".")[0])
    package = ElementTree.parse(ROS2 / "package.xml").getroot()
    depends = {str(entry.text) for entry in package.findall("exec_depend")}
    ros = {"rclpy", "cv_bridge", "message_filters", "sensor_msgs", "stereo_msgs", "launch_ros"}
    assert ros <= imported
    assert ros <= depends
    name = package.findtext("name")
    assert (ROS2 / "resource" / str(name)).is_file()
    node = ast.parse((ROS2 / "rts2_stereo" / "node.py").read_text(encoding="utf-8"))
    assert "main" in {each.name for each in node.body if isinstance(each, ast.FunctionDef)}
    assert "stereo = {NAME}.node:main" in (ROS2 / "setup.py").read_text(encoding="utf-8")


def test_the_examples_read_keys_that_a_bundle_has(bundle: Maker) -> None:
    known = json.loads((bundle(*CPU) / "deployment.json").read_text())
    assert {"runtime", "execution", "input"} <= known.keys()
    assert {"intra_op_threads", "inter_op_threads", "file", "provider"} <= known["execution"].keys()
