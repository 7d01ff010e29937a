"""Results that cannot be what they say are refused in one line."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rts2.model.errors import Rts2Error
from rts2.profiles.cli import profile
from rts2.profiles.kit.manifest import Manifest
from rts2.profiles.kit.results import MIN_POINTS, Results, timings
from rts2.profiles.latency import predict_ms
from rts2.profiles.profile import load

from .conftest import truth

Edit = Callable[[dict[str, Any]], Any]


@pytest.fixture
def results(kit: tuple[Path, Manifest]) -> dict[str, Any]:
    """What the collector writes, the times planted."""
    manifest = kit[1]
    rows = [
        {
            "network": network.name,
            "sha256": network.sha256,
            "precision": precision,
            "status": "timed",
            "latency_ms": (ms := predict_ms(truth(), network.arch, network.resolution)),
            "p95_ms": 1.02 * ms,
            "reference_ms": 5.0,
            "version": "8.2.1",
            "state": {"date": "2026-11-22T10:00:00Z", "power mode": "MAXN 0"},
        }
        for precision in ("fp32", "fp16")
        for network in manifest.networks
    ]
    return {
        "schema": "rts2.kit-results/1",
        "manifest": manifest.model_dump(mode="json", by_alias=True),
        "rows": rows,
    }


def read(found: dict[str, Any]) -> Results:
    return Results.model_validate_json(json.dumps(found))


def test_a_drift_of_the_device_cancels(results: dict[str, Any]) -> None:
    before = timings(read(results), load("tx2")).points["fp32"]
    for index, row in enumerate(results["rows"]):
        slower = 1 + index % 12 / 20
        row["latency_ms"] *= slower
        row["p95_ms"] *= slower
        row["reference_ms"] *= slower
    told = timings(read(results), load("tx2"))
    ratios = [a.fps / b.fps for a, b in zip(told.points["fp32"], before, strict=True)]
    assert ratios == pytest.approx([ratios[0]] * 12)
    assert any("drifted by 55%" in note for note in told.notes)


def test_where_and_how_stands_in_every_point(results: dict[str, Any]) -> None:
    told = timings(read(results), load("tx2"))
    for point in told.points["fp16"]:
        assert point.source == "trtexec of TensorRT 8.2.1, power mode MAXN 0, 2026-11-22"
    assert told.facts["power mode"] == "MAXN 0"
    assert told.notes == ()


def test_unsteady_networks_are_left_out_by_name(results: dict[str, Any]) -> None:
    results["rows"][3]["p95_ms"] = 1.5 * results["rows"][3]["latency_ms"]
    told = timings(read(results), load("tx2"))
    assert len(told.points["fp32"]) == 11
    assert told.notes == (
        "network-04 fp32 is left out as unreliable: the 95th percentile is 50% above the median; "
        "lock the clocks",
    )


def test_another_tensorrt_than_the_profiles_is_told(results: dict[str, Any]) -> None:
    for row in results["rows"]:
        row["version"] = "8.4.1"
    told = timings(read(results), load("tx2"))
    assert told.notes == ("the device runs TensorRT 8.4.1, and the profile is of 8.2.1",)


@pytest.mark.parametrize("count", [MIN_POINTS - 1, MIN_POINTS])
def test_nine_networks_are_enough(results: dict[str, Any], count: int) -> None:
    results["rows"] = results["rows"][:count]
    if count < MIN_POINTS:
        with pytest.raises(Rts2Error, match="8 networks were timed in fp32, and 9 are needed"):
            timings(read(results), load("tx2"))
    else:
        assert len(timings(read(results), load("tx2")).points["fp32"]) == count


def row(index: int, **values: Any) -> Edit:
    return lambda found: found["rows"][index].update(values)


def fail(found: dict[str, Any]) -> None:
    for entry in found["rows"][:4]:
        entry.update(status="failed", reason="out of memory", latency_ms=None, p95_ms=None)


WRONG: dict[str, tuple[Edit, str]] = {
    "zero": (row(2, latency_ms=0), "rows.2.latency_ms"),
    "negative": (row(2, latency_ms=-1.5), "rows.2.latency_ms"),
    "nan": (row(2, latency_ms=float("nan")), "rows.2.latency_ms"),
    "infinite": (row(2, p95_ms=float("inf")), "rows.2.p95_ms"),
    "text": (row(2, latency_ms="fast"), "rows.2.latency_ms"),
    "no time": (row(2, latency_ms=None), "network-03 fp32 is called timed and has no time"),
    "twice": (lambda f: f["rows"].append(f["rows"][5]), "network-06 fp32 occurs twice"),
    "foreign": (row(0, network="network-99"), "network-99 is no network of this kit"),
    "other file": (row(0, sha256="0" * 64), "network-01 is no network of this kit"),
    "int8": (row(0, precision="int8"), "network-01 int8: the kit times fp32 and fp16 only"),
    "arch edited": (
        lambda f: f["manifest"]["networks"][0]["arch"].update(c=2),
        "was changed after it was made",
    ),
    "failed": (
        fail,
        "8 networks were timed in fp32, and 9 are needed (network-01 fp32, network-02 fp32",
    ),
    "none": (lambda f: f.update(rows=[]), "0 networks were timed"),
    "power mode": (
        row(7, state={"power mode": "MAXQ 1"}),
        "the power mode changed between the timings (MAXN 0 | MAXQ 1)",
    ),
    "versions": (row(7, version="8.4.0"), "the TensorRT changed between the timings"),
    "schema": (lambda f: f.update(schema="rts2.search/1"), "schema"),
    "no manifest": (lambda f: f.pop("manifest"), "manifest"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_results_are_one_line_and_write_nothing(
    results: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: str
) -> None:
    edit, said = WRONG[wrong]
    edit(results)
    assert refusal(json.dumps(results), tmp_path, capsys, "tx2", 1).count(said) == 1


@pytest.mark.parametrize("text", ["", "{", "timed", "[]", "\x00"])
def test_what_is_no_json_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    assert "a kit's results" in refusal(text, tmp_path, capsys, "tx2", 1)


def test_the_kit_of_another_device_is_wrong_use(
    results: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refusal(json.dumps(results), tmp_path, capsys, "rtx2080ti", 2)
    assert "the kit was made for tx2, not rtx2080ti; import it with --device tx2" in said


def refusal(
    text: str, folder: Path, capsys: pytest.CaptureFixture[str], device: str, code: int
) -> str:
    path = folder / "kit-results.json"
    path.write_text(text)
    words = ["import", str(path), "--device", device, "--out", str(folder / "mine.json")]
    assert profile(words) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert not (folder / "mine.json").exists()
    return printed.err
