"""Turns the logs of run.sh into kit-results.json. Needs Python 3.6 or newer, and no packages."""

import hashlib
import json
import os
import re
import sys

FOLDER = os.path.dirname(os.path.abspath(__file__))
RESULTS = "kit-results.json"
STEADY = 1.3
NUMBER = r"\s*=?\s*([0-9.eE+-]+)"


def path(*names):
    return os.path.join(FOLDER, *names)


def read(*names):
    with open(path(*names), "rb") as handle:
        return handle.read()


def version(log):
    """`v8201` is 8.2.1, and `v100300` is 10.3.0."""
    found = re.search(r"\[TensorRT v(\d+)\]", log)
    if not found:
        return None
    number, base = int(found.group(1)), 10000 if len(found.group(1)) > 4 else 1000
    major, rest = divmod(number, base)
    minor, patch = divmod(rest, base // 100 if base == 10000 else 100)
    return "{}.{}.{}".format(major, minor, patch)


def state(log):
    """The `# key: value` lines that run.sh wrote; values of one key are joined."""
    found = {}
    for line in log.splitlines():
        match = re.match(r"# ([^:]+): (.*)$", line)
        if match and match.group(1) != "ended":
            key, value = match.group(1).strip(), " ".join(match.group(2).split())
            found[key] = "; ".join([found[key], value]) if key in found else value
    return found


def timing(log):
    """Median and spread of the last summary of a log, or why there are none."""
    lines = [line for line in log.splitlines() if "GPU Compute Time: min" in line]
    if not lines or not re.search("^&&&& PASSED", log, re.MULTILINE):
        return None, "the log ends before trtexec passed"
    line = lines[-1]
    median = re.search("median" + NUMBER, line)
    spread = re.search(r"percentile\(95%\)" + NUMBER, line)
    spread = spread or re.search(r"percentile\(99%\)" + NUMBER, line)
    try:
        return (float(median.group(1)), float(spread.group(1))), None
    except (AttributeError, ValueError):
        return None, "no median in: " + line.strip()


def cause(log):
    """Why a run failed, as far as its log tells."""
    lines = [line.strip() for line in log.splitlines() if "[E]" in line or "rror" in line]
    return lines[0][:300] if lines else "the log names no error"


def row(kit, network, precision):
    """One network in one precision: timed, failed, or not run yet (None)."""
    job = "{}.{}".format(network["name"], precision)
    logs = "logs-" + kit
    found = {"network": network["name"], "sha256": network["sha256"], "precision": precision}
    if os.path.exists(path(logs, job + ".failed")):
        log = read(logs, job + ".failed").decode("utf-8", "replace")
        found.update(status="failed", reason=cause(log), state=state(log))
        return found
    if not os.path.exists(path(logs, job + ".log")):
        return None
    log = read(logs, job + ".log").decode("utf-8", "replace")
    times, reason = timing(log)
    if network["name"] + ".onnx" not in log:
        times, reason = None, "the log is of another network"
    found.update(state=state(log), version=version(log))
    if times is None:
        found.update(status="failed", reason=reason)
        return found
    found.update(status="timed", latency_ms=times[0], p95_ms=times[1])
    if os.path.exists(path(logs, job + ".reference.log")):
        beside = timing(read(logs, job + ".reference.log").decode("utf-8", "replace"))[0]
        if beside is not None:
            found.update(reference_ms=beside[0])
    return found


def checked():
    """The manifest, once every network is known to be the one that it names."""
    try:
        manifest = json.loads(read("manifest.json").decode("utf-8"))
        for network in manifest["networks"]:
            data = read(network["name"] + ".onnx")
            if hashlib.sha256(data).hexdigest() != network["sha256"]:
                sys.exit("{}.onnx has changed since the kit was made".format(network["name"]))
    except FileNotFoundError as error:
        sys.exit("{} is missing: copy the whole kit".format(os.path.basename(error.filename)))
    return manifest


def told(found):
    """A row as a line."""
    text = found.get("reason") or "{latency_ms:9.3f} ms".format(**found)
    if found["status"] == "timed" and found["p95_ms"] > STEADY * found["latency_ms"]:
        text += "  not steady: lock the clocks, delete its log, and run run.sh again"
    return "{network} {precision} {status:6} ".format(**found) + text


def main():
    manifest = checked()
    rows, missing = [], []
    for precision in manifest["precisions"]:
        for network in manifest["networks"]:
            found = row(manifest["kit"], network, precision)
            if found is None:
                missing.append("{} {}".format(network["name"], precision))
            else:
                rows.append(found)
    for found in rows:
        print(told(found))
    if missing:
        print("not run yet: " + ", ".join(missing) + " (sh run.sh)")
    if not rows:
        sys.exit("nothing was timed: run sh run.sh first")
    results = {"schema": "rts2.kit-results/1", "manifest": manifest, "rows": rows}
    with open(path(RESULTS + ".part"), "w", encoding="utf-8") as handle:
        json.dump(results, handle, indent=1, sort_keys=True)
    os.replace(path(RESULTS + ".part"), path(RESULTS))
    timed = [found for found in rows if found["status"] == "timed"]
    print("{} timed, {} failed: {}".format(len(timed), len(rows) - len(timed), RESULTS))


if __name__ == "__main__":
    main()
