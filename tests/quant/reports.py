"""A report as rts2-quantize writes it, in which every answer can be counted."""

from typing import Any

ROW: dict[str, Any] = {
    "layer": "encoder.stem.0.0/Conv",
    "precision": "int8",
    "reason": None,
    "float_kernels": ["Conv"],
    "quantized_kernels": ["QLinearConcat", "QLinearConv"],
    "float_ms": 2.5,
    "quantized_ms": 1.5,
    "sqnr_db": 40.0,
    "d1_change": 0.01,
    "epe_change": -0.002,
    "miou_change": 0.0,
    "error": 0.13,
}
NOTHING: dict[str, Any] = {
    key: None for key in ROW if key not in ("layer", "precision", "reason")
} | {"float_kernels": [], "quantized_kernels": []}
"""Of a layer that nobody looked at."""

SLOWER: dict[str, Any] = {
    "precision": "fp32",
    "reason": "slower in integers: 0.40 → 0.60 ms",
    "float_ms": 0.4,
    "quantized_ms": 0.6,
}
LAYERS = [
    ROW,
    ROW | SLOWER | {"layer": "classify.2/Conv"},
    ROW | NOTHING | {"layer": "disparity.levels.2.0.0/Conv"},
    ROW | {"layer": "encoder.stem.1.0/Conv", "float_ms": 10.0, "quantized_ms": 5.0},
]
REPORT: dict[str, Any] = {
    "schema": "rts2.quantize/1",
    "network": "c=8, 3 stages, full · 1242×375 · trained on streets",
    "precision": "int8",
    "outcome": "int8",
    "why": "int8 is 1.31 times as fast as fp32 (±0.8%) and within the accuracy budget",
    "device": "cpu",
    "runtime": "onnxruntime",
    "evidence": "measured",
    "machine": "AMD EPYC, 2 threads, ONNX Runtime 1.31.1, 2026-11-28",
    "measured_on": "20 frames of streets",
    "calibration": {
        "method": "percentile",
        "pairs": 32,
        "skipped": ["000007: the right image is cut short"],
        "source": "streets",
        "names": ["000000", "000001"],
    },
    "forms": {"float": ["banded", "banded", "3d"], "quantized": ["2d", "banded", "3d"]},
    "budget": {"max_d1_drop": 0.3, "max_miou_drop": 0.5},
    "float": {
        "latency_ms": 50.0,
        "d1_all": 13.0,
        "epe": 1.871,
        "miou": 15.0,
        "size_bytes": 1_400_000,
        "sqnr_db": None,
    },
    "quantized": {
        "latency_ms": 40.0,
        "d1_all": 13.2,
        "epe": 1.871,
        "miou": 14.0,
        "size_bytes": 500_000,
        "sqnr_db": 31.4,
    },
    "speedup": 1.31,
    "speedup_error": 0.008,
    "kept_float": [{"layer": "classify.2/Conv", "reason": SLOWER["reason"]}],
    "layers": LAYERS,
    "trials": [
        {
            "what": "cheapest cut",
            "layers": 3,
            "latency_ratio": 0.76,
            "d1_all": 13.2,
            "miou": 14.0,
            "kept": True,
        },
        {
            "what": "everything",
            "layers": 4,
            "latency_ratio": 0.93,
            "d1_all": None,
            "miou": None,
            "kept": False,
        },
    ],
    "files": ["fp32.onnx", "int8.onnx", "quantize.json", "report.html", "audit.png"],
}
UNKNOWN: dict[str, Any] = REPORT | {
    "device": None,
    "runtime": None,
    "evidence": "rules",
    "machine": None,
    "calibration": None,
    "forms": None,
    "float": dict.fromkeys(REPORT["float"]),
    "quantized": dict.fromkeys(REPORT["quantized"]),
    "speedup": None,
    "speedup_error": None,
    "layers": [row | NOTHING for row in LAYERS],
    "trials": [REPORT["trials"][0] | {"latency_ratio": None, "d1_all": None, "miou": None}],
}
"""The same with nothing measured."""
