"""Checks this bundle on this device: its files, its answers, its speed.

Needs Python 3.6 or newer, numpy, and the runtime that deployment.json names: onnxruntime, openvino,
or NVIDIA's trtexec. Ends with 0 where all is well, else with 1 and one line that says why.
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time

try:
    import numpy as np
except ImportError:
    sys.exit("numpy is missing: python3 -m pip install numpy brings it")

FOLDER = os.path.dirname(os.path.abspath(__file__))
OPTIMIZED = "optimized.onnx"
LOG = "trtexec.log"

RUNS, SECONDS = 10, 1.0
"""At least so many runs of each pair, for at least so long."""


class Fault(Exception):
    """Why the bundle is not what it says, or does not run here."""


def path(name):
    return os.path.join(FOLDER, *name.split("/"))


def read(name):
    try:
        with open(path(name), "rb") as handle:
            return handle.read()
    except FileNotFoundError as error:
        raise Fault("{} is missing: copy the whole bundle".format(name)) from error
    except OSError as error:
        raise Fault("{} cannot be read: {}".format(name, error.strerror)) from error


def one_line(error):
    return " ".join(str(error).replace(FOLDER + os.sep, "").split())[:300]


def configuration():
    """deployment.json, once every file is known to be the one that it tells."""
    try:
        found = json.loads(read("deployment.json").decode("utf-8"))
    except ValueError as error:
        raise Fault("deployment.json is no JSON: copy it again") from error
    if found.get("schema") != "rts2.deployment/1" or not found.get("check"):
        raise Fault("deployment.json is not that of a bundle: rts2-deploy makes one")
    for entry in found["files"]:
        if hashlib.sha256(read(entry["name"])).hexdigest() != entry["sha256"]:
            raise Fault("{} has changed since it was written".format(entry["name"]))
    return found


def image(name, size):
    """(H, W, 3) bytes from a binary PPM, if it is of the size (width, height)."""
    data = read(name)
    head = re.match(rb"P6\s+(\d+)\s+(\d+)\s+255\s", data)
    if not head:
        raise Fault("{} is no binary PPM of 8 bits".format(name))
    width, height = int(head.group(1)), int(head.group(2))
    if [width, height] != size:
        told = "{} is {}x{}, and the network takes {}x{}"
        raise Fault(told.format(name, width, height, size[0], size[1]))
    pixels = np.frombuffer(data, np.uint8, offset=head.end())
    if pixels.size != 3 * width * height:
        raise Fault("{} ends too early".format(name))
    return pixels.reshape(height, width, 3)


def prepared(pixels, given):
    """(H, W, 3) bytes -> (1, 3, H', W'): normalised, then padded."""
    tensor = np.zeros(given["shape"], np.float32)
    mean, std = np.array(given["mean"], np.float32), np.array(given["std"], np.float32)
    normal = (pixels.astype(np.float32) * np.float32(given["scale"]) - mean) / std
    tensor[0, :, : pixels.shape[0], : pixels.shape[1]] = normal.transpose(2, 0, 1)
    return tensor


def stored(name, kind, size):
    """A map of the bundle, (H, W)."""
    values = np.frombuffer(read(name), kind)
    if values.size != size[0] * size[1]:
        raise Fault("{} holds {} values, not {}x{}".format(name, values.size, size[1], size[0]))
    return values.reshape(size[1], size[0])


def timed(call):
    """The latency of each run in ms."""
    latencies_ms, started = [], time.perf_counter()
    while len(latencies_ms) < RUNS or time.perf_counter() - started < SECONDS:
        before = time.perf_counter()
        call()
        latencies_ms.append(1000 * (time.perf_counter() - before))
    return latencies_ms


class OnnxRuntime:
    """The graph in ONNX Runtime, with the options of deployment.json."""

    def __init__(self, deployment):
        try:
            import onnxruntime
        except ImportError as error:
            raise Fault(
                "onnxruntime is missing: python3 -m pip install onnxruntime brings it"
            ) from error
        self.runtime = onnxruntime
        self.execution = deployment["execution"]
        self.version = onnxruntime.__version__
        self.session = self.opened(self.execution["file"], self.options())

    def options(self):
        runtime, execution = self.runtime, self.execution
        levels = {"all": runtime.GraphOptimizationLevel.ORT_ENABLE_ALL}
        modes = {"sequential": runtime.ExecutionMode.ORT_SEQUENTIAL}
        options = runtime.SessionOptions()
        options.log_severity_level = 4
        options.intra_op_num_threads = execution["intra_op_threads"]
        options.inter_op_num_threads = execution["inter_op_threads"]
        options.graph_optimization_level = levels[execution["graph_optimization"]]
        options.execution_mode = modes[execution["execution_mode"]]
        return options

    def opened(self, name, options):
        providers = [self.execution["provider"]]
        try:
            return self.runtime.InferenceSession(path(name), options, providers=providers)
        except Exception as error:
            told = "{} is not read by onnxruntime {}: {}"
            raise Fault(told.format(name, self.version, one_line(error))) from error

    def run(self, inputs):
        """The outputs by name, and the latency of each run in ms."""
        names = [output.name for output in self.session.get_outputs()]
        try:
            found = self.session.run(names, inputs)
        except Exception as error:
            raise Fault("onnxruntime {} fails: {}".format(self.version, one_line(error))) from error
        return dict(zip(names, found)), timed(lambda: self.session.run(names, inputs))

    def save_optimized(self):
        """Writes the graph as it is optimized here; returns how it opens, in a sentence."""
        options = self.options()
        options.optimized_model_filepath = path(OPTIMIZED + ".part")
        before = time.perf_counter()
        self.opened(self.execution["file"], options)
        os.replace(path(OPTIMIZED + ".part"), path(OPTIMIZED))
        middle = time.perf_counter()
        self.opened(OPTIMIZED, self.options())
        times = middle - before, time.perf_counter() - middle
        return "{} opens in {:.2f} s, the graph in {:.2f} s".format(OPTIMIZED, times[1], times[0])


class OpenVino:
    """The graph in OpenVINO on the CPU, with the properties of deployment.json."""

    def __init__(self, deployment):
        try:
            import openvino
        except ImportError as error:
            raise Fault("openvino is missing: python3 -m pip install openvino brings it") from error
        self.runtime, execution = openvino, deployment["execution"]
        self.version = openvino.__version__.partition("-")[0]
        try:
            compiled = openvino.Core().compile_model(
                path(execution["file"]), execution["device"], execution["properties"]
            )
        except Exception as error:
            told = "{} is not read by openvino {}: {}"
            raise Fault(told.format(execution["file"], self.version, one_line(error))) from error
        wanted = execution["properties"]["INFERENCE_PRECISION_HINT"]
        taken = compiled.get_property("INFERENCE_PRECISION_HINT").get_type_name()
        if taken != wanted:
            told = "OpenVINO computes in {} on this processor, not in {}"
            raise Fault(told.format(taken, wanted))
        self.names = [output["name"] for output in deployment["outputs"]]
        self.request = compiled.create_infer_request()

    def run(self, inputs):
        """The outputs by name, and the latency of each run in ms."""
        for name, values in inputs.items():
            self.request.set_tensor(name, self.runtime.Tensor(values))
        self.request.infer()
        found = {name: self.request.get_tensor(name).data.copy() for name in self.names}
        return found, timed(self.request.infer)


class TensorRt:
    """The engine that build.sh made, run by trtexec."""

    version = None

    def __init__(self, deployment):
        self.execution, self.outputs = deployment["execution"], deployment["outputs"]
        asked = os.environ.get("TRTEXEC", self.execution["program"])
        self.program = shutil.which(asked) or shutil.which("trtexec")
        if self.program is None:
            told = "trtexec is not at {}: this bundle runs on {} with TensorRT {}; set TRTEXEC"
            raise Fault(told.format(asked, deployment["device"], self.execution["generation"]))
        if not os.path.exists(path(self.execution["file"])):
            raise Fault("{} is missing: run build.sh first".format(self.execution["file"]))

    def run(self, inputs):
        """The outputs by name, and the latency of each run in ms."""
        folder = tempfile.mkdtemp()
        try:
            return self.ran(inputs, folder)
        finally:
            shutil.rmtree(folder)

    def ran(self, inputs, folder):
        output, times = os.path.join(folder, "output.json"), os.path.join(folder, "times.json")
        given = []
        for name, values in inputs.items():
            values.astype("<f4").tofile(os.path.join(folder, name))
            given.append("{}:{}".format(name, os.path.join(folder, name)))
        words = [self.program, "--loadEngine=" + self.execution["file"]] + self.execution["run"]
        words += ["--loadInputs=" + ",".join(given)]
        words += ["--exportOutput=" + output, "--exportTimes=" + times]
        with open(path(LOG), "wb") as log:
            code = subprocess.call(words, cwd=FOLDER, stdout=log, stderr=subprocess.STDOUT)
        log = read(LOG).decode("utf-8", "replace")
        self.version = (re.findall(r"\[TensorRT v(\d+)\]", log) or [None])[0]
        if code or not (os.path.exists(output) and os.path.exists(times)):
            lines = [line for line in log.splitlines() if "[E]" in line] or ["see " + LOG]
            raise Fault("trtexec fails: " + one_line(lines[0]))
        with open(output, encoding="utf-8") as handle:
            found = {entry["name"]: entry["values"] for entry in json.load(handle)}
        with open(times, encoding="utf-8") as handle:
            latencies_ms = [entry["computeMs"] for entry in json.load(handle)]
        if not latencies_ms:
            raise Fault("trtexec ran no pair: see " + LOG)
        return self.shaped(found), latencies_ms

    def shaped(self, found):
        shaped = {}
        for output in self.outputs:
            name, shape = output["name"], output["shape"]
            values = np.array(found.get(name, ()), output["dtype"])
            if values.size != np.prod(shape):
                told = "trtexec gives {} values as {}, not {}"
                raise Fault(told.format(values.size, name, np.prod(shape)))
            shaped[name] = values.reshape(shape)
        return shaped


RUNTIMES = {"onnxruntime": OnnxRuntime, "openvino": OpenVino, "tensorrt": TensorRt}


def other_version(deployment, runner):
    """What to know where the runtime here is not the one that the bundle was made with."""
    runtime, generation = deployment["runtime"], deployment["execution"].get("generation")
    if generation is not None:
        same = (runner.version or "").startswith(generation.replace(".", ""))
        told = "built for TensorRT {}, and this is v{}".format(generation, runner.version)
    else:
        written = deployment["versions"].get(runtime, runner.version)
        same = written == runner.version
        told = "written with {0} {1}, and this is {0} {2}".format(runtime, written, runner.version)
    return [] if same else ["the bundle was " + told]


def compared(deployment, sample, runner):
    """One pair: how far its answers are from what is expected, and the latency of each run."""
    given, check = deployment["input"], deployment["check"]
    size = given["resolution"]
    pair = [prepared(image(name, size), given) for name in sample["images"]]
    found, latencies_ms = runner.run(dict(zip(given["names"], pair)))
    width, height = deployment["postprocessing"]["crop"]
    cut = {name: values[0, :height, :width] for name, values in found.items()}
    off = np.abs(cut["disparity"] - stored(sample["disparity"], "<f4", size))
    row = {
        "name": sample["name"],
        "mean_px": float(off.mean()),
        "percentile_px": float(np.percentile(off, check["percentile"])),
        "equal_classes": None,
    }
    ok = row["mean_px"] <= check["tolerance_px"] and row["percentile_px"] <= check["percentile_px"]
    if sample["semantic"] is not None:
        same = cut["semantic"] == stored(sample["semantic"], np.uint8, size)
        row["equal_classes"] = float(same.mean())
        ok = ok and row["equal_classes"] >= check["equal_classes"]
    # NaN is no number of JSON, and never within a tolerance.
    row.update({k: None for k, v in row.items() if isinstance(v, float) and not np.isfinite(v)})
    row["ok"] = bool(ok)
    return row, latencies_ms


def verified(save_optimized):
    """All that is to be told of the bundle."""
    deployment = configuration()
    runtime = deployment["runtime"]
    if save_optimized and runtime != "onnxruntime":
        raise Fault("--save-optimized is for onnxruntime; this bundle runs on " + runtime)
    runner = RUNTIMES[runtime](deployment)
    rows, latencies_ms = [], []
    for sample in deployment["check"]["samples"]:
        row, more = compared(deployment, sample, runner)
        rows.append(row)
        latencies_ms += more
    notes = other_version(deployment, runner)
    if save_optimized:
        notes.append(runner.save_optimized())
    latency_ms = float(np.median(latencies_ms))
    expected = deployment["expected"]
    if expected and 1000 / latency_ms < expected["fps_low"]:
        notes.append("slower than promised: if other programs ran, stop them and verify again")
    return {
        "schema": "rts2.verification/1",
        "device": deployment["device"],
        "precision": deployment["precision"],
        "runtime": "{} {}".format(runtime, runner.version),
        "files": len(deployment["files"]),
        "pairs": rows,
        "check": {k: v for k, v in deployment["check"].items() if k != "samples"},
        "latency_ms": latency_ms,
        "fps": 1000 / latency_ms,
        "runs": len(latencies_ms),
        "expected": expected,
        "notes": notes,
        "ok": all(row["ok"] for row in rows),
    }


def show(told):
    check = told["check"]
    print("runtime   {runtime}, {precision}".format(**told))
    print("files     {files}, all as they were written".format(**told))
    for row in told["pairs"]:
        line = "pair      {}: disparity {} px off on average ({:g} allowed), {} px at {:g}% ({:g})"
        far = [row[key] for key in ("mean_px", "percentile_px")]
        far = ["not finite" if value is None else "{:.2g}".format(value) for value in far]
        allowed = check["tolerance_px"], check["percentile"], check["percentile_px"]
        line = line.format(row["name"], far[0], allowed[0], far[1], allowed[1], allowed[2])
        if row["equal_classes"] is not None:
            told_share = ", classes equal in {:.2%} ({:.1%} needed)"
            line += told_share.format(row["equal_classes"], check["equal_classes"])
        print(line)
    print("measured  {fps:.1f} FPS, {latency_ms:.2f} ms, median of {runs} runs".format(**told))
    expected = told["expected"]
    if expected:
        text = "expected  {fps:.1f} FPS ({fps_low:.1f} to {fps_high:.1f} at {confidence:.0%}) on "
        print((text + "{runtime}").format(**expected) + ", " + expected["evidence"]["latency"])
    for note in told["notes"]:
        print("note      " + note)


def main():
    options = argparse.ArgumentParser(description="Checks this bundle on this device.")
    options.add_argument("--json", action="store_true", help="one JSON object on stdout")
    text = "write {}, for this processor and this ONNX Runtime alone".format(OPTIMIZED)
    options.add_argument("--save-optimized", action="store_true", help=text)
    asked = options.parse_args()
    try:
        told = verified(asked.save_optimized)
        if asked.json:
            print(json.dumps(told))
        else:
            show(told)
    except Fault as fault:
        sys.exit(str(fault))
    except KeyError as missing:
        sys.exit("deployment.json lacks {}: copy it again".format(missing))
    if not told["ok"]:
        far = ", ".join(row["name"] for row in told["pairs"] if not row["ok"])
        sys.exit("FAILED: the answers are too far off on " + far)
    if not asked.json:
        print("ok")


if __name__ == "__main__":
    main()
