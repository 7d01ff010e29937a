"""In the place of `trtexec`: its options, its output, and times that are planted or ONNX Runtime's.

Like the real one it ends with an error where it is given an option that its release does not know.

KIT_TIMES     JSON file of median ms by ONNX file name; without it the graph is run, on one thread
KIT_FAILS     ONNX files that no engine is made of, separated by commas
KIT_RELEASE   as `trtexec` prints it (default: 8201)
KIT_SPREAD    how far the percentiles lie above the median (default: 0.02)
KIT_CALLS     file that every call is noted in
"""

import json
import os
import sys
import time
from pathlib import Path
from statistics import median

RELEASE = os.environ.get("KIT_RELEASE", "8201")

ALWAYS = (
    "onnx saveEngine loadEngine timingCacheFile profilingVerbosity exportLayerInfo warmUp duration"
)
ALWAYS += " iterations loadInputs exportOutput exportTimes noDataTransfers"
SOME = {
    "workspace": ((8, 0), (9, 99)),
    "memPoolSize": ((8, 4), (99, 0)),
    "builderOptimizationLevel": ((8, 6), (99, 0)),
    "fp16": ((8, 0), (10, 99)),
    "int8": ((8, 0), (10, 99)),
    "precisionConstraints": ((8, 4), (10, 99)),
    "layerPrecisions": ((8, 4), (10, 99)),
}
"""Options by the first and the last release that takes them, from NVIDIA's guides to migration."""


def release() -> tuple[int, int]:
    base = 10000 if len(RELEASE) > 4 else 1000
    return int(RELEASE) // base, int(RELEASE) % base // (base // 100 if base == 10000 else 100)


def unknown(options: dict[str, str]) -> list[str]:
    known = {name for name, (first, last) in SOME.items() if first <= release() <= last}
    return [name for name in options if name not in known | set(ALWAYS.split())]


def inferred(graph: Path, options: dict[str, str]) -> None:
    """Writes what the graph says of the inputs that were given, as `trtexec` writes it."""
    import numpy as np
    import onnxruntime

    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    files = dict(pair.split(":") for pair in options["loadInputs"].split(","))
    inputs = {
        given.name: np.fromfile(files[given.name], "<f4").reshape(given.shape)
        for given in session.get_inputs()
    }
    rows = [
        {"name": output.name, "dimensions": "x".join(map(str, values.shape)), "values": values}
        for output, values in zip(session.get_outputs(), session.run(None, inputs), strict=True)
    ]
    for row in rows:
        row["values"] = row["values"].ravel().tolist()
    Path(options["exportOutput"]).write_text(json.dumps(rows))


def say(*lines: str) -> None:
    for line in lines:
        mark = "" if line.startswith("&&&&") else "[11/22/2026-10:00:00] [I] "
        sys.stdout.write(f"{mark}{line}\n")


def summary(name: str, ms: float, spread: float) -> str:
    values = {"min": 0.99 * ms, "max": (1 + 2 * spread) * ms, "mean": 1.001 * ms, "median": ms}
    ends = (90, 95, 99) if int(RELEASE) >= 8500 else (99,)
    values |= {f"percentile({end}%)": (1 + spread) * ms for end in ends}
    return f"{name}: " + ", ".join(f"{key} = {value:g} ms" for key, value in values.items())


def timed(graph: Path, seconds: float) -> float:
    """Median ms of the thread's own time: what others do on the machine is not in it."""
    import numpy as np
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    noise = np.random.default_rng(0)
    inputs = {
        given.name: noise.standard_normal(given.shape, dtype=np.float32)
        for given in session.get_inputs()
    }
    times: list[float] = []
    began = time.perf_counter()
    session.run(None, inputs)
    while len(times) < 10 or time.perf_counter() - began < seconds:
        before = time.thread_time()
        session.run(None, inputs)
        times.append(1000 * (time.thread_time() - before))
    return median(times)


def refusal(options: dict[str, str], graph: Path) -> str | None:
    """Why no engine is made or run."""
    if unknown(options):
        return f"Unknown option: --{unknown(options)[0]}"
    if graph.name in os.environ.get("KIT_FAILS", "").split(","):
        return "Error[10]: no implementation for a node"
    return None


def exported(options: dict[str, str], graph: Path, ms: float) -> None:
    """Writes the files that were asked for."""
    for made in ("timingCacheFile", "exportLayerInfo"):
        if made in options:
            Path(options[made]).touch()
    if "saveEngine" in options:
        Path(options["saveEngine"]).write_text(str(graph))
    if "exportOutput" in options:
        inferred(graph, options)
    if "exportTimes" in options:
        runs = [{"computeMs": ms, "latencyMs": 1.7 * ms}] * int(options["iterations"])
        Path(options["exportTimes"]).write_text(json.dumps(runs))


def main() -> int:
    words = [word for word in sys.argv[1:] if word.startswith("--")]
    options = dict(word[2:].partition("=")[::2] for word in words)
    told = f"TensorRT.trtexec [TensorRT v{RELEASE}] # trtexec {' '.join(sys.argv[1:])}"
    say(f"&&&& RUNNING {told}", "=== Model Options ===", "Format: ONNX")
    if "KIT_CALLS" in os.environ:
        with Path(os.environ["KIT_CALLS"]).open("a") as calls:
            calls.write(" ".join(sys.argv[1:]) + "\n")
    engine = options.get("loadEngine")
    graph = Path(options["onnx"] if engine is None else Path(engine).read_text())
    reason = refusal(options, graph)
    if reason is not None:
        sys.stdout.write(f"[11/22/2026-10:00:00] [E] {reason}\n")
        say(f"&&&& FAILED {told}")
        return 1
    assert graph.read_bytes()
    planted = os.environ.get("KIT_TIMES")
    known = json.loads(Path(planted).read_text()) if planted else {}
    ms = known[graph.name] if planted else timed(graph, float(options.get("duration", 3)))
    exported(options, graph, ms)
    spread = float(os.environ.get("KIT_SPREAD", "0.02"))
    say("=== Performance summary ===", f"Throughput: {900 / ms:g} qps")
    names = ["Latency", "End-to-End Host Latency", "Enqueue Time", "H2D Latency"]
    names = [name for name in names if int(RELEASE) < 8400 or "End" not in name]
    say(*(summary(name, 1.7 * ms, spread) for name in names))
    say(summary("GPU Compute Time", ms, spread), summary("D2H Latency", 0.1, spread))
    say("Total Host Walltime: 10.01 s", "Total GPU Compute Time: 10 s", "")
    say(f"&&&& PASSED {told}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
