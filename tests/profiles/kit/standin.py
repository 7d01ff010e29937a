"""In the place of `trtexec`: its options, its output, and times that are planted or ONNX Runtime's.

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
    if graph.name in os.environ.get("KIT_FAILS", "").split(","):
        sys.stdout.write("[11/22/2026-10:00:00] [E] Error[10]: no implementation for a node\n")
        say(f"&&&& FAILED {told}")
        return 1
    assert graph.read_bytes()
    if "saveEngine" in options:
        Path(options["saveEngine"]).write_text(str(graph))
    planted = os.environ.get("KIT_TIMES")
    known = json.loads(Path(planted).read_text()) if planted else {}
    ms = known[graph.name] if planted else timed(graph, float(options["duration"]))
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
