"""Bundles for TensorRT, with a stand-in for `trtexec` that knows which release takes what."""

import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rts2.model.errors import UsageError
from rts2.profiles.profile import load
from rts2.profiles.trtexec import GENERATIONS
from rts2.search.deploy.configuration import read
from rts2.search.deploy.trt import generation_of

Maker = Callable[..., Path]
RELEASES = {"8.2": "8201", "8.6": "8601", "10": "101600", "11": "110400"}
"""As `trtexec` prints them."""


@pytest.mark.parametrize("generation", GENERATIONS)
@pytest.mark.parametrize("precision", ["fp32", "fp16", "int8"])
def test_each_generation_builds_runs_and_answers(
    copied: Maker, built: Callable[..., Any], generation: str, precision: str
) -> None:
    folder = copied("rtx2080ti", "tensorrt", precision, generation)
    ended = built(folder, RELEASES[generation])
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.endswith("ok\n")
    assert "measured  50.0 FPS, 20.00 ms, median of 100 runs" in ended.stdout
    assert f"runtime   tensorrt {RELEASES[generation]}, {precision}" in ended.stdout
    assert "note" not in ended.stdout
    assert {"model.plan", "timing.cache", "layers.json"} <= {path.name for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("generation", "release", "option"),
    [("8.2", "101600", "workspace"), ("10", "110400", "fp16"), ("8.6", "8201", "memPoolSize")],
)
def test_a_bundle_of_another_generation_does_not_build(
    copied: Maker, built: Callable[..., Any], generation: str, release: str, option: str
) -> None:
    """That is why bundles are made for one; and the stand-in is no yes-man."""
    ended = built(copied("rtx2080ti", "tensorrt", "fp16", generation), release)
    assert ended.returncode == 1
    assert f"Unknown option: --{option}" in ended.stdout


def test_a_release_of_another_generation_that_builds_is_noted(
    copied: Maker, built: Callable[..., Any]
) -> None:
    ended = built(copied("rtx2080ti", "tensorrt", "fp16", "8.6"), "101600")
    assert ended.returncode == 0
    assert "note      the bundle was built for TensorRT 8.6, and this is v101600\n" in ended.stdout


def test_the_calls_are_one_that_builds_and_one_a_pair(
    copied: Maker, built: Callable[..., Any], tmp_path: Path
) -> None:
    folder = copied("tx2", "tensorrt", "fp16")
    built(folder, "8201")
    first, *pairs = (tmp_path / "calls.txt").read_text().splitlines()
    assert first.split() == [
        *("--onnx=model.onnx", "--saveEngine=model.plan", "--workspace=1024", "--fp16"),
        *("--timingCacheFile=timing.cache", "--profilingVerbosity=detailed"),
        "--exportLayerInfo=layers.json",
    ]
    assert len(pairs) == 2
    for call in pairs:
        assert call.startswith("--loadEngine=model.plan --warmUp=500 --duration=5 --iterations=50 ")
        assert "--loadInputs=left:" in call
    told = read(folder / "deployment.json").execution
    assert told is not None
    assert told.runtime == "tensorrt"
    assert list(told.build) == first.split()[2:]


def test_what_carries_a_disparity_stays_fp32_where_flags_can_say_so(bundle: Maker) -> None:
    for generation in GENERATIONS:
        folder = bundle("rtx2080ti", "tensorrt", "fp16", generation)
        known = read(folder / "deployment.json")
        kept = {row.layer for row in known.layers if row.precision == "fp32"}
        script = (folder / "build.sh").read_text()
        subprocess.run(["sh", "-n", str(folder / "build.sh")], check=True)
        asked = [line for line in script.splitlines() if "--layerPrecisions=" in line]
        if generation in ("8.6", "10"):
            (line,) = asked
            names = line.strip(" \\'").partition("=")[2].split(",")
            assert {name.removesuffix(":fp32") for name in names} == kept
            assert all(name.endswith(":fp32") for name in names)
            assert kept
        else:
            assert asked == []
            assert bool(kept) == (generation == "11")


def test_the_script_may_run_and_is_a_shell_script(bundle: Maker) -> None:
    script = bundle("tx2", "tensorrt", "fp16") / "build.sh"
    assert os.access(script, os.X_OK)
    assert script.read_text().startswith("#!/bin/sh\n")


def test_an_engine_is_put_into_the_model_repository_too(
    copied: Maker, built: Callable[..., Any]
) -> None:
    folder = copied("rtx2080ti", "tensorrt", "fp16", None, True)
    assert not (folder / "triton/rts2net/1").exists()
    assert built(folder, "8201").returncode == 0
    placed = folder / "triton/rts2net/1/model.plan"
    assert placed.read_bytes() == (folder / "model.plan").read_bytes()


def test_a_failed_build_is_a_failure(copied: Maker, built: Callable[..., Any]) -> None:
    folder = copied("tx2", "tensorrt", "fp16")
    ended = built(folder, "8201", KIT_FAILS="model.onnx")
    assert ended.returncode == 1
    assert "ok" not in ended.stdout.split()
    assert not (folder / "model.plan").exists()


def test_without_trtexec_the_bundle_says_whose_it_is(
    copied: Maker, checked: Callable[..., Any], built: Callable[..., Any]
) -> None:
    folder = copied("tx2", "tensorrt", "fp16")
    ended = checked(folder, given={"TRTEXEC": "/none/trtexec", "PATH": "/none"})
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr == (
        "trtexec is not at /none/trtexec: this bundle runs on tx2 with TensorRT 8.2; set TRTEXEC\n"
    )
    ended = built(folder, "8201", TRTEXEC="/none/trtexec", PATH="/usr/bin:/bin")
    assert ended.returncode == 1
    assert ended.stderr == "trtexec is not at /none/trtexec; set TRTEXEC to where it is\n"


def fake(tmp_path: Path, body: str) -> dict[str, str]:
    program = tmp_path / "trtexec"
    program.write_text(f"#!/bin/sh\n{body}\n")
    program.chmod(0o755)
    return {"TRTEXEC": str(program)}


def test_without_an_engine_the_check_says_so(
    copied: Maker, checked: Callable[..., Any], tmp_path: Path
) -> None:
    ended = checked(copied("tx2", "tensorrt", "fp16"), given=fake(tmp_path, "exit 0"))
    assert (ended.returncode, ended.stderr) == (1, "model.plan is missing: run build.sh first\n")


ENGINE_OF_ANOTHER = """
echo '[11/22/2026-10:00:00] [I] === Device Information ==='
echo '[11/22/2026-10:00:00] [E] Error Code 6: The engine plan file is generated on another device'
exit 1
"""

WRONG = """
for word in "$@"; do
    case $word in
    --exportOutput=*) echo 'OUTPUT' >"${word#*=}" ;;
    --exportTimes=*) echo 'TIMES' >"${word#*=}" ;;
    esac
done
"""
FEW = json.dumps([{"name": "disparity", "values": [1.0, 2.0]}])


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (ENGINE_OF_ANOTHER, "Error Code 6: The engine plan file is generated on another device"),
        ("exit 3", "trtexec fails: see trtexec.log"),
        ("exit 0", "trtexec fails: see trtexec.log"),
        (WRONG.replace("OUTPUT", FEW).replace("TIMES", "[]"), "trtexec ran no pair"),
        (
            WRONG.replace("OUTPUT", FEW).replace("TIMES", '[{"computeMs": 1.0}]'),
            "trtexec gives 2 values as disparity, not 6144",
        ),
    ],
)
def test_what_trtexec_does_not_do_is_one_line(
    copied: Maker, checked: Callable[..., Any], tmp_path: Path, body: str, said: str
) -> None:
    folder = copied("tx2", "tensorrt", "fp16")
    (folder / "model.plan").write_bytes(b"engine")
    ended = checked(folder, given=fake(tmp_path, body))
    assert (ended.returncode, ended.stdout) == (1, "")
    assert said in ended.stderr
    assert ended.stderr.count("\n") == 1


def test_a_device_has_its_generations_and_no_other() -> None:
    tx2, rtx = load("tx2"), load("rtx2080ti")
    (known,) = (support for support in tx2.runtimes if support.runtime == "tensorrt")
    (many,) = (support for support in rtx.runtimes if support.runtime == "tensorrt")
    assert generation_of(tx2, known, None) == generation_of(tx2, known, "8.2") == "8.2"
    assert generation_of(rtx, many, None) == "8.2"
    assert [generation_of(rtx, many, each) for each in GENERATIONS] == list(GENERATIONS)
    with pytest.raises(UsageError, match=r"Jetson TX2 runs TensorRT 8\.2, not 10; leave"):
        generation_of(tx2, known, "10")
    other = known.model_copy(update={"version": "10.3.0"})
    assert generation_of(tx2, other, None) == "10"
