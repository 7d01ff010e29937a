"""How fast the networks run on this machine, in every runtime and precision at hand.

    RTS2_DATA=DIR python benchmarks/runtime.py [--json]

Two networks at 1248×384 on all cores: the full RTS²Net with c = 8 (the weights in the box, three
stages, disparity and classes), and AnyNet with c = 1 (the released checkpoint, or random weights
without it). Every row has the same weights, and counts if its maps match PyTorch's on one pair: a
KITTI frame of RTS2_DATA, or a generated one. Times are taken run by run in turn with ONNX Runtime.

Eager is PyTorch as rts2-eval runs the network. AnyNet's is its straightforward form, as its release
has it: planes written one by one, and all of a residual volume warped by `grid_sample`; rts2's own
plain form has a row too. Against OpenCV's semi-global matching both go from the same 8-bit colour
images to maps; all else is the network alone. The roofline is the fastest product of two matrices
that any library here reaches.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any, Final

import cv2
import numpy as np
import onnx
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

from rts2.model.arch import RADIUS, UNTRAINED, Arch, Form, Precision
from rts2.model.box import named_model
from rts2.model.checkpoint import Network, build, save
from rts2.model.console import progress
from rts2.model.data.cache import Cached
from rts2.model.data.catalog import open_dataset
from rts2.model.data.scene import Scene
from rts2.model.export import Deployed
from rts2.model.graph import load_graph, save_graph
from rts2.model.machine import cores, processor
from rts2.model.ops import ops, padded
from rts2.model.predictor import OnnxPredictor, Predictor, TorchPredictor
from rts2.model.qdq import integers, usual
from rts2.model.volume import PLAIN
from rts2.profiles.runtimes import available, open_session, precisions
from rts2.profiles.timing import Reference, Timing, measure
from rts2.quant.calibration import calibrate
from rts2.quant.half import OpenVinoPredictor
from rts2.quant.intermediate import to_ir
from rts2.quant.race import Runner, race
from rts2.quant.source import Asked, Source, opened

RESOLUTION: Final = (1242, 375)
PAIRS: Final = 16
"""Generated scenes that calibrate integers."""

FORMS: Final[tuple[tuple[Form, ...], ...]] = (
    ("3d", "banded", "banded"),
    ("3d", "3d", "3d"),
    ("banded", "banded", "banded"),
)
"""In which a float graph is raced, for each runtime; integers take the last, all in 2D."""

APART_PX: Final[dict[Precision, float]] = {"fp32": 0.01, "fp16": 0.1, "bf16": 0.5, "int8": 0.5}
APART: Final = 0.05
"""How far maps may be from PyTorch's: the mean difference of disparities, the share of classes."""

PATIENCE: Final = 4.0
"""How many times as long as its least a timing may take."""

GRAPHS: Final = {"onnxruntime", "openvino"}
"""The runtimes that multiply matrices too."""

PROFILED: Final = 20
"""Runs whose kernels are timed for the roofline."""

SGBM: Final = {
    "numDisparities": 192,
    "blockSize": 5,
    "P1": 8 * 3 * 25,
    "P2": 32 * 3 * 25,
    "uniquenessRatio": 10,
    "speckleWindowSize": 100,
    "speckleRange": 2,
    "disp12MaxDiff": 1,
    "mode": cv2.StereoSGBM_MODE_SGBM_3WAY,
}
"""With the usual filters: 14.0% D1-all on the first three frames of KITTI 2015."""

SESSION: Final = """
from time import perf_counter
started = perf_counter()
import json, sys
import numpy as np
from rts2.model.session import StereoSession
session = StereoSession(sys.argv[1])
ready = perf_counter() - started
blank = np.zeros((375, 1242, 3), np.uint8)
for turn in range(30):
    session.predict(blank, blank, stages=1 + turn % 3)
assert "torch" not in sys.modules
lines = open("/proc/self/status", encoding="utf-8").read().splitlines()
peak, = [line.split()[1] for line in lines if line.startswith("VmHWM")]
print(json.dumps([int(peak) / 1024, ready, list(session.expected_ms.values())]))
"""
"""A fresh process with a session alone tells its peak in MB, its start in s, its times in ms."""


@dataclass(frozen=True)
class Contender:
    """A network as one runtime computes it."""

    title: str
    precision: Precision
    run: Callable[[], Any]
    """The network alone."""
    predictor: Predictor
    """From images to maps."""
    conv_ms: Callable[[], float] | None = None
    """What its convolutions take; None where the runtime does not tell."""


@dataclass(frozen=True)
class Row:
    """A contender that was held against PyTorch and against ONNX Runtime in fp32."""

    contender: Contender
    timing: Timing
    apart_px: float
    apart: float
    """The share of pixels whose class differs."""

    @property
    def matching(self) -> bool:
        return self.apart_px <= APART_PX[self.contender.precision] and self.apart <= APART

    @property
    def ratio(self) -> float:
        """Its latency over that of ONNX Runtime in fp32."""
        return self.timing.ratio


class Bench:
    """One network in everything that runs it."""

    def __init__(self, path: Path, folder: Path, pairs: Cached, scene: Scene) -> None:
        folder.mkdir()
        self._source = Source(path, Asked(resolution=RESOLUTION), folder)
        self._folder, self._pairs, self._scene = folder, pairs, scene
        self.network = self._source.network
        self.plain = self._graph("onnxruntime")
        self.reference = self._ort("ONNX Runtime fp32", self.plain, "fp32")

    def rows(self, baselines: Sequence[Contender]) -> Iterator[Row]:
        """Every contender in turn, the baselines first."""
        beside = Reference(self.reference.run, settle_s=0.0)
        wanted = TorchPredictor(self.network).predict(self._scene.left, self._scene.right)
        for each in (*baselines, self.reference, *self._others()):
            found = each.predictor.predict(self._scene.left, self._scene.right)
            apart = 0.0
            if found.semantic is not None and wanted.semantic is not None:
                apart = float((found.semantic != wanted.semantic).mean())
            apart_px = float(np.abs(found.disparity - wanted.disparity).mean())
            yield Row(each, measure(each.run, beside, patience=PATIENCE), apart_px, apart)

    def _others(self) -> Iterator[Contender]:
        yield self._ort("ONNX Runtime int8", self._integers("onnxruntime"), "int8")
        if "openvino" not in available():
            return
        graph, lowered = self._graph("openvino"), self._integers("openvino")
        yield self._openvino(graph, graph, "fp32")
        yield self._openvino(lowered, to_ir(lowered), "int8")
        compiled = to_ir(graph)
        for precision in precisions("openvino")[1:]:
            yield self._openvino(graph, compiled, precision)

    def _graph(self, runtime: str) -> Path:
        """The float graph in the forms that a runtime is fastest at."""
        paths = [self._source.graph(forms, runtime) for forms in FORMS]
        ratios = race([Runner(path, "fp32", runtime) for path in paths], cores())
        return paths[int(np.argmin(ratios))]

    def _integers(self, runtime: str) -> Path:
        """The usual layers in 8 bits."""
        model, header = opened(self._source.graph(FORMS[-1], runtime))
        known = calibrate(model, header, self._pairs, self._folder / f"{runtime}.npz")
        made = integers(model, usual(model), known.ranges("percentile"))
        path = self._folder / f"int8-{runtime}.onnx"
        save_graph(made, header.model_copy(update={"precision": "int8"}), path)
        return path

    def _ort(self, title: str, path: Path, precision: Precision) -> Contender:
        session = open_session("onnxruntime", path, precision, cores())
        told = _conv_ms(session, path)
        return Contender(title, precision, session.run, OnnxPredictor(path), told)

    def _openvino(self, graph: Path, compiled: Path, precision: Precision) -> Contender:
        from rts2.profiles.runtimes.ov import Session

        session = Session(compiled, precision, cores())
        predictor = OpenVinoPredictor(graph, compiled, precision, cores())
        told = _conv_ms(session, graph)
        return Contender(f"OpenVINO {precision}", precision, session.run, predictor, told)


def _conv_ms(session: Any, path: Path) -> Callable[[], float]:
    """What all convolutions take at their fastest."""

    def told() -> float:
        names = {node.name for node in load_graph(path).graph.node if node.op_type == "Conv"}
        times = session.node_times_ms(PROFILED)
        return sum(ms for name, ms in times.items() if name in names)

    return told


def eager(title: str, network: Network) -> Contender:
    """A network in PyTorch, as it stands."""
    deployed = Deployed(network).eval()
    size = padded(RESOLUTION, network.arch.multiple)
    left, right = torch.randn(2, 1, 3, *size, generator=torch.Generator().manual_seed(0))

    def run() -> None:
        with torch.inference_mode():
            deployed(left, right)

    return Contender(title, "fp32", run, TorchPredictor(network))


def straightforward(network: Network) -> Network:
    """A copy of AnyNet that builds its volumes as its release does."""
    copy: Any = deepcopy(network)
    copy.matching = PLAIN._replace(first_volume=plane_by_plane, residual_volume=sampled)
    return copy  # type: ignore[no-any-return]


def plane_by_plane(left: Tensor, right: Tensor, planes: int) -> Tensor:
    """`rts2.model.volume.first_volume`, every plane written into the volume."""
    batch, _, height, width = left.shape
    volume = left.new_zeros(batch, planes, height, width)
    for shift in range(planes):
        volume[:, shift, :, :shift] = left[..., :shift].abs().sum(1)
        seen = right[..., : width - shift]
        volume[:, shift, :, shift:] = (left[..., shift:] - seen).abs().sum(1)
    return volume


def sampled(left: Tensor, right: Tensor, disparity: Tensor) -> Tensor:
    """`rts2.model.volume.residual_volume`, one sampled image a plane."""
    batch, _, height, width = left.shape
    planes = torch.arange(-RADIUS, RADIUS + 1, dtype=left.dtype)
    around = disparity + planes.view(1, -1, 1, 1)
    x = torch.arange(width, dtype=left.dtype) - around.flatten(0, 1)
    y = torch.arange(height, dtype=left.dtype).view(1, -1, 1).expand_as(x)
    grid = torch.stack([2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1], 3)
    many = [image.repeat_interleave(len(planes), 0) for image in (left, right)]
    warped = F.grid_sample(many[1], grid, align_corners=True)
    return (many[0] - warped).abs().sum(1).view(batch, len(planes), height, width)


def semi_global(scene: Scene) -> Callable[[], Any]:
    """OpenCV's semi-global matching of a pair."""
    matcher = cv2.StereoSGBM.create(**SGBM)
    return lambda: matcher.compute(scene.left, scene.right)


@dataclass(frozen=True)
class Roofline:
    """The convolutions of a network against what the machine can do."""

    gflop: float
    gbytes: float
    gflops: float
    """Single precision, in the product of two large matrices."""
    gbytes_per_s: float
    """Of a copy, read and written."""
    floor_ms: float
    """Every convolution at the one or at the other, whichever is slower."""
    measured_ms: float
    runtime: str

    @property
    def fraction(self) -> float:
        """Of the rate of matrix products."""
        return self.gflop / (self.measured_ms / 1000) / self.gflops


def roofline(arch: Arch, rows: Sequence[Row]) -> Roofline:
    """That of the runtime whose convolutions in fp32 are the fastest; zeros count as no work."""
    told = {
        row.contender.title: row.contender.conv_ms()
        for row in rows
        if row.contender.precision == "fp32" and row.contender.conv_ms is not None
    }
    runtime = min(told, key=lambda title: told[title])
    convs = [op for op in ops(arch, RESOLUTION) if op.macs]
    rate, bandwidth = matrix_gflops(), copied_gbytes_per_s()
    work = [(2e-9 * op.macs, 1e-9 * op.bytes) for op in convs]
    return Roofline(
        gflop=sum(flop for flop, _ in work),
        gbytes=sum(size for _, size in work),
        gflops=rate,
        gbytes_per_s=bandwidth,
        floor_ms=1000 * sum(max(flop / rate, size / bandwidth) for flop, size in work),
        measured_ms=told[runtime],
        runtime=runtime,
    )


def matrix_gflops(side: int = 2048) -> float:
    """The fastest product of NumPy, PyTorch and the runtimes of graphs, at its fastest."""
    a, b = np.random.default_rng(0).standard_normal((2, side, side), dtype=np.float32)
    x, y = torch.from_numpy(a), torch.from_numpy(b)
    runs: list[Callable[[], Any]] = [lambda: a @ b, lambda: x @ y]
    with TemporaryDirectory() as folder:
        path = product(Path(folder) / "product.onnx", b)
        graphs = GRAPHS & {*available()}
        runs += [open_session(runtime, path, "fp32", cores()).run for runtime in graphs]
        return 2e-9 * side**3 / min(fastest_s(run) for run in runs)


def product(path: Path, right: NDArray[np.float32]) -> Path:
    """A graph that multiplies a matrix by this one."""
    ends = [helper.make_tensor_value_info(n, TensorProto.FLOAT, right.shape) for n in ("a", "c")]
    node = helper.make_node("MatMul", ["a", "b"], ["c"])
    weight = numpy_helper.from_array(right, "b")
    body = helper.make_graph([node], "product", ends[:1], ends[1:], [weight])
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(body, opset_imports=opset, ir_version=8), path)
    return path


def copied_gbytes_per_s(size: int = 2**28) -> float:
    """From memory to memory, far more than a cache holds."""
    source, target = torch.ones(size // 4), torch.zeros(size // 4)
    return 2e-9 * size / fastest_s(lambda: target.copy_(source))


def fastest_s(run: Callable[[], Any], runs: int = 15) -> float:
    """Of several runs the fastest: what the machine can do while nobody disturbs it."""
    times = []
    for _ in range(runs):
        started = perf_counter()
        run()
        times.append(perf_counter() - started)
    return min(times)


def session(graph: Path) -> tuple[float, float, list[float]]:
    """Peak MB, seconds of the start, and ms by stages of a session in a fresh process."""
    command = [sys.executable, "-c", SESSION, str(graph)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    peak_mb, start_s, stage_ms = json.loads(done.stdout)
    return peak_mb, start_s, stage_ms


def real(*parts: str) -> Path | None:
    """A place in the folder that RTS2_DATA names, if it is there."""
    path = Path(os.environ.get("RTS2_DATA", "."), *parts)
    return path if path.exists() else None


def anynet(folder: Path) -> Path:
    """The released checkpoint, or random weights."""
    released = real("anynet_official", "kitti2015.tar")
    if released is not None:
        return released
    path = folder / "anynet.safetensors"
    save(build(Arch(family="anynet", c=1)), path, UNTRAINED)
    return path


class Table:
    """Rows as they come, unless only ratios are asked for."""

    def __init__(self, quiet: bool) -> None:
        self._quiet = quiet

    def line(self, text: str) -> None:
        """One line."""
        if not self._quiet:
            print(text, flush=True)

    def row(self, row: Row, beside_ms: float) -> None:
        """A contender: its ms by its ratio to ONNX Runtime's, and how far its maps are apart."""
        ms = row.ratio * beside_ms
        note = "" if row.timing.reliable else "  the machine was busy"
        note += "" if row.matching else "  does not match"
        error = f"±{row.timing.error:.1%}"
        self.line(
            f"  {row.contender.title:34} {ms:8.1f} {error:>7} {1 / row.ratio:8.2f} ×"
            f"  {row.apart_px:8.4f} {row.apart:8.2%}{note}"
        )


def timed(name: str, bench: Bench, baselines: Sequence[Contender], table: Table) -> list[Row]:
    """The rows of one network."""
    table.line(f"{name:36} {'ms':>8} {'':>7} {'× ORT':>8}    {'px apart':>8} {'classes':>8}")
    rows = list(progress(bench.rows(baselines), name, None))
    for row in rows:
        table.row(row, rows[-1].timing.own_ms)  # ONNX Runtime's at its own speed
    return rows


def ratios(rows: Sequence[Row]) -> tuple[Row, float, float]:
    """The fastest that matches; its latency and ONNX Runtime's, each against the first row's."""
    first, *others = rows
    best = min((row for row in others if row.matching), key=lambda row: row.ratio)
    plain = next(row for row in others if row.contender.title == "ONNX Runtime fp32")
    return best, first.ratio / best.ratio, first.ratio / plain.ratio


def against_sgbm(best: Contender, scene: Scene, table: Table) -> float | None:
    """How many times as many frames a second the network gives, both from images to maps."""
    if real("kitti2015") is None:
        table.line("semi-global matching needs real images: set RTS2_DATA")
        return None
    beside = Reference(lambda: best.predictor.predict(scene.left, scene.right))
    found = measure(semi_global(scene), beside, patience=PATIENCE)
    table.line(
        f"from images to maps: StereoSGBM 3-way {found.ratio * found.reference_ms:.1f} ms, "
        f"{best.title} {found.reference_ms:.1f} ms: {found.ratio:.2f} × the frames"
    )
    return found.ratio


def main() -> None:
    """Measures and prints the tables, or one JSON object of ratios."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    table = Table(options.json)
    torch.set_num_threads(cores())
    table.line(f"{processor()}, {cores()} cores, 1248×384")
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        streets = open_dataset("streets", split="train", count=PAIRS, size=RESOLUTION)
        pairs = Cached(streets, folder / "scenes")
        kitti = real("kitti2015")
        scene = (pairs if kitti is None else open_dataset("kitti2015", kitti))[0].read()
        found = _measured(folder, pairs, scene, table)
    if options.json:
        print(json.dumps(found))


def _measured(folder: Path, pairs: Cached, scene: Scene, table: Table) -> dict[str, Any]:
    bench = Bench(named_model("c8"), folder / "c8", pairs, scene)
    rows = timed("RTS²Net c=8", bench, [eager("PyTorch eager", bench.network)], table)
    best, c8_best, c8_ort = ratios(rows)
    table.line(f"  {best.contender.title} {c8_best:.2f} ×, ONNX Runtime fp32 {c8_ort:.2f} × eager")
    sgbm = against_sgbm(best.contender, scene, table)
    roof = roofline(bench.network.arch, rows)
    table.line(
        f"convolutions, {roof.runtime}: {roof.gflop:.2f} GFLOP, {1000 * roof.gbytes:.0f} MB; "
        f"{roof.gflops:.0f} GFLOP/s, {roof.gbytes_per_s:.0f} GB/s; floor {roof.floor_ms:.1f} ms, "
        f"measured {roof.measured_ms:.1f} ms, {roof.fraction:.0%} of matrix products"
    )
    peak_mb, start_s, stage_ms = session(bench.plain)
    told = ", ".join(f"{ms:.0f}" for ms in stage_ms)
    table.line(f"session: peak {peak_mb:.0f} MB, start {start_s:.2f} s, ms by stages {told}")
    other = Bench(anynet(folder), folder / "anynet", pairs, scene)
    plain = other.network
    baselines = [
        eager("PyTorch eager, straightforward", straightforward(plain)),
        eager("PyTorch eager, rts2's", plain),
    ]
    rows = timed("AnyNet c=1", other, baselines, table)
    best, anynet_best, anynet_ort = ratios(rows)
    told = f"{best.contender.title} {anynet_best:.2f} ×, ONNX Runtime fp32 {anynet_ort:.2f} ×"
    table.line(f"  {told} the straightforward form")
    return {
        "c8_best_vs_eager": c8_best,
        "c8_ort_vs_eager": c8_ort,
        "anynet_best_vs_eager": anynet_best,
        "anynet_ort_vs_eager": anynet_ort,
        "c8_best_vs_sgbm3way": sgbm,
        "roofline_fraction": roof.fraction,
        "peak_mb": peak_mb,
    }


if __name__ == "__main__":
    main()
