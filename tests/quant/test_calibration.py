"""Calibration: histograms against numpy, ranges, and what survives an interruption."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rts2.model.data.scene import Scene
from rts2.model.errors import Rts2Error, UsageError
from rts2.model.graph import header_of, load_graph
from rts2.quant.calibration import BINS, Calibration, Histogram, calibrate

SIZE = (96, 64)


@dataclass(frozen=True)
class Made:
    """A pair of noise."""

    number: int
    size: tuple[int, int] = SIZE
    broken: bool = False
    foreground: None = None

    @property
    def name(self) -> str:
        return f"pair {self.number}"

    @property
    def fingerprint(self) -> str:
        return f"{self.number} {self.size}"

    def read(self) -> Scene:
        if self.broken:
            raise Rts2Error("left.png is truncated")
        width, height = self.size
        pixels = np.random.default_rng(self.number).integers(0, 256, (2, height, width, 3))
        left, right = pixels.astype(np.uint8)
        return Scene(self.name, left, right, np.full((height, width), np.nan, np.float32))


@pytest.fixture
def calibrated(graph: Path, tmp_path: Path):  # type: ignore[no-untyped-def]
    model = load_graph(graph)

    def run(samples: Sequence[Made], cache: str = "cache.npz") -> Calibration:
        return calibrate(model, header_of(model, graph), samples, tmp_path / cache)

    return run


def test_a_histogram_counts_what_numpy_does() -> None:
    chance = np.random.default_rng(0)
    batches = [chance.standard_normal(500).astype(np.float32) * scale for scale in (1, 9, 0.1, 80)]
    known = Histogram()
    for batch in batches:
        known.add(batch)
    whole = np.concatenate(batches)
    assert (known.low, known.high) == (whole.min(), whole.max())
    assert known.limit == 2.0 ** np.ceil(np.log2(np.abs(whole).max()))
    expected, _ = np.histogram(whole, BINS, (-known.limit, known.limit))
    np.testing.assert_array_equal(known.counts, expected)


def test_percentile_cuts_the_tails_and_minmax_does_not() -> None:
    known = Histogram()
    values = np.random.default_rng(0).uniform(-1, 1, 400_000).astype(np.float32)
    known.add(np.concatenate([values, np.float32([50, -30])]))
    assert known.range("minmax") == (-30, 50)
    low, high = known.range("percentile")
    assert -1.1 < low < -0.9
    assert 0.9 < high < 1.1


def test_entropy_keeps_a_uniform_value_whole_and_cuts_a_long_tail() -> None:
    uniform, tailed = Histogram(), Histogram()
    chance = np.random.default_rng(0)
    uniform.add(chance.uniform(-1, 1, 60_000).astype(np.float32))
    tailed.add(np.append(chance.normal(0, 1, 60_000), 100.0).astype(np.float32))
    assert uniform.range("entropy") == pytest.approx((-1, 1), abs=0.02)
    assert 2 < tailed.range("entropy")[1] < 50


@pytest.mark.parametrize("method", ["minmax", "percentile", "entropy"])
def test_no_range_exceeds_what_was_seen(method: str, calibrated) -> None:  # type: ignore[no-untyped-def]
    known = calibrated([Made(0), Made(1)])
    for name, (low, high) in known.ranges(method).items():
        assert known.histograms[name].low <= low <= high <= known.histograms[name].high


def test_means_are_those_of_the_inputs(calibrated) -> None:  # type: ignore[no-untyped-def]
    from rts2.model.predictor import prepared

    samples = [Made(0), Made(1)]
    known = calibrated(samples)
    scenes = [sample.read() for sample in samples]
    both = np.concatenate([prepared(i, 32) for s in scenes for i in (s.left, s.right)])
    np.testing.assert_allclose(known.mean("encoder/Concat:0"), both.mean((0, 2, 3)), rtol=1e-5)


def test_an_interrupted_calibration_goes_on_where_it_stopped(calibrated, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    samples = [Made(0), Made(1), Made(2)]
    whole = calibrated(samples, "whole.npz")
    read: list[int] = []
    honest = Made.read

    def stopping(self: Made) -> Scene:
        if self.number == 2 and len(read) < 3:
            read.append(self.number)
            raise KeyboardInterrupt
        read.append(self.number)
        return honest(self)

    monkeypatch.setattr(Made, "read", stopping)
    with pytest.raises(KeyboardInterrupt):
        calibrated(samples)
    found = calibrated(samples)
    assert read == [0, 1, 2, 2]
    assert found.pairs == whole.pairs
    assert found.ranges("percentile") == whole.ranges("percentile")
    again = calibrated(samples)
    assert read == [0, 1, 2, 2]
    assert again.ranges("minmax") == whole.ranges("minmax")


def test_other_pairs_are_calibrated_anew(calibrated) -> None:  # type: ignore[no-untyped-def]
    first = calibrated([Made(0), Made(1)])
    other = calibrated([Made(2), Made(3)])
    assert other.pairs == ["pair 2", "pair 3"]
    assert other.ranges("minmax") != first.ranges("minmax")


def test_what_cannot_be_read_or_does_not_fit_is_named_and_skipped(calibrated, caplog) -> None:  # type: ignore[no-untyped-def]
    with caplog.at_level(logging.WARNING):
        known = calibrated([Made(0), Made(1, broken=True), Made(2, (128, 64)), Made(3)])
    assert known.pairs == ["pair 0", "pair 3"]
    assert known.skipped == [
        "pair 1: left.png is truncated",
        "pair 2: it is 128x64, the graph is for 96x64",
    ]
    assert [record.getMessage() for record in caplog.records] == [
        f"note: skipped {line}" for line in known.skipped
    ]


def test_one_pair_is_too_few(calibrated) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(UsageError, match=r"2 pairs of 96x64 at least and has 1; 32 are usual"):
        calibrated([Made(0), Made(1, broken=True)])


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 broken"])
def test_a_cache_that_is_none(calibrated, tmp_path: Path, content: bytes) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "cache.npz").write_bytes(content)
    with pytest.raises(Rts2Error, match=r"cache\.npz is no calibration of rts2: .*; delete it"):
        calibrated([Made(0), Made(1)])
