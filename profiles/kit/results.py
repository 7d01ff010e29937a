"""What comes back from a device: a kit's results, refused where they cannot be what they say."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from ...model.arch import Precision
from ...model.errors import Rts2Error, UsageError
from ..profile import Frozen, Point, Profile
from .manifest import Manifest, Sha256

Milliseconds = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]

MIN_POINTS = 9
"""So many timings bound a new one at 90% confidence; fewer bound nothing."""

STEADY = 1.3
"""How far the 95th percentile may lie above the median; the scripts on the device hold it too."""

DRIFT = 0.1
"""How much the reference may wander before it is told."""


class Row(Frozen):
    """One network in one precision, as the collector read it from its log."""

    network: str
    sha256: Sha256
    precision: Precision
    status: Literal["timed", "failed"]
    latency_ms: Milliseconds | None = None
    """Median time of the GPU's computing, without transfers."""
    p95_ms: Milliseconds | None = None
    """The 95th percentile, or the 99th where TensorRT tells no other."""
    reference_ms: Milliseconds | None = None
    """What the kit's reference network took right after."""
    version: str | None = None
    """Of TensorRT, as `trtexec` says."""
    reason: str | None = None
    state: dict[str, str] = Field(default_factory=dict)
    """Date, power mode, clocks and what else the device says of itself."""

    @property
    def job(self) -> str:
        return f"{self.network} {self.precision}"


class Results(Frozen):
    """kit-results.json."""

    schema_: Literal["rts2.kit-results/1"] = Field(alias="schema")
    manifest: Manifest
    rows: tuple[Row, ...]


class Timings(NamedTuple):
    """The points of each precision, and what a person should know of them."""

    points: dict[Precision, tuple[Point, ...]]
    facts: dict[str, str]
    notes: tuple[str, ...]


def timings(results: Results, profile: Profile) -> Timings:
    """The timings of `results` as points of `profile`'s device.

    Raises:
        UsageError: the kit was made for another device.
        Rts2Error: the kit was changed; a row is of no network of it, or occurs twice; the power
            mode or TensorRT changed in between; too few networks were timed.
    """
    _refuse_foreign(results, profile)
    timed = _steady(results.rows)
    _refuse_few(results, timed)
    facts = _facts(timed)
    points = {
        precision: _points([row for row in timed if row.precision == precision], results, facts)
        for precision in results.manifest.precisions
        if any(row.precision == precision for row in timed)
    }
    return Timings(
        points, facts, (*_left_out(results), *_drifts(timed), *_versions(timed, results))
    )


def _refuse_foreign(results: Results, profile: Profile) -> None:
    manifest = results.manifest
    if manifest.kit != manifest.identity():
        raise Rts2Error(
            f"the kit {manifest.kit} was changed after it was made (it should be "
            f"{manifest.identity()}); collect again in the kit's own folder"
        )
    if manifest.device != profile.name:
        raise UsageError(
            f"the kit was made for {manifest.device}, not {profile.name}; "
            f"import it with --device {manifest.device}"
        )
    jobs: set[str] = set()
    for row in results.rows:
        network = manifest.network(row.network)
        if network is None or row.sha256 != network.sha256:
            raise Rts2Error(f"{row.network} is no network of this kit; collect again on the device")
        if row.precision not in manifest.precisions:
            raise Rts2Error(f"{row.job}: the kit times {' and '.join(manifest.precisions)} only")
        if row.job in jobs:
            raise Rts2Error(f"{row.job} occurs twice; collect again on the device")
        if row.status == "timed" and (row.latency_ms is None or row.p95_ms is None):
            raise Rts2Error(f"{row.job} is called timed and has no time; collect again")
        jobs.add(row.job)


def _steady(rows: Sequence[Row]) -> list[Row]:
    """The rows to rely on."""
    return [row for row in rows if row.status == "timed" and not _wide(row)]


def _wide(row: Row) -> bool:
    known = row.latency_ms is not None and row.p95_ms is not None
    return known and (row.p95_ms or 0) > STEADY * (row.latency_ms or 0)


def _refuse_few(results: Results, timed: Sequence[Row]) -> None:
    counts = {
        precision: sum(row.precision == precision for row in timed)
        for precision in results.manifest.precisions
    }
    some = {precision: count for precision, count in counts.items() if count} or counts
    precision, least = min(some.items(), key=lambda entry: entry[1])
    if least >= MIN_POINTS:
        return
    bad = [row.job for row in results.rows if row not in timed and row.precision == precision]
    told = f" ({', '.join(bad)} failed or were not steady)" if bad else ""
    raise Rts2Error(
        f"{least} networks were timed in {precision}, and {MIN_POINTS} are needed{told}; "
        "run run.sh again on the device, which goes on where it stopped"
    )


def _facts(timed: Sequence[Row]) -> dict[str, str]:
    """What the device said of itself; `Rts2Error` where that changed and must not."""
    found: dict[str, list[str]] = {}
    for row in timed:
        told = row.state | ({"TensorRT": row.version} if row.version else {})
        for key, value in told.items():
            found.setdefault(key, []).append(value)
    for key in ("power mode", "TensorRT", "board"):
        values = sorted(set(found.get(key, [])))
        if len(values) > 1:
            raise Rts2Error(
                f"the {key} changed between the timings ({' | '.join(values)}); "
                "delete the kit's logs and run it again"
            )
    facts = {key: max(set(values), key=values.count) for key, values in sorted(found.items())}
    if "date" in found:
        facts["date"] = max(found["date"])[:10]
    return facts


def _points(rows: Sequence[Row], results: Results, facts: dict[str, str]) -> tuple[Point, ...]:
    """Each timing, its reference divided out where every row has one."""
    references = [row.reference_ms for row in rows if row.reference_ms is not None]
    usual = median(references) if len(references) == len(rows) else None
    told = [f"trtexec of TensorRT {facts.get('TensorRT', results.manifest.version)}"]
    told += [f"{key} {facts[key]}" for key in sorted(facts) if key.startswith(("power", "clock"))]
    told += [facts[key] for key in ("date",) if key in facts]
    points = []
    for row in rows:
        network = results.manifest.network(row.network)
        if network is None or row.latency_ms is None:  # refused before
            continue
        drift = row.reference_ms / usual if usual and row.reference_ms else 1.0
        points.append(
            Point(
                arch=network.arch,
                runtime=results.manifest.runtime,
                precision=row.precision,
                resolution=network.resolution,
                fps=1000 * drift / row.latency_ms,
                evidence="measured",
                source=", ".join(told),
            )
        )
    return tuple(points)


def _left_out(results: Results) -> list[str]:
    failed = [
        f"{row.job} failed on the device: {row.reason or 'no reason is known'}"
        for row in results.rows
        if row.status == "failed"
    ]
    wide = [
        f"{row.job} is left out as unreliable: the 95th percentile is "
        f"{(row.p95_ms or 0) / (row.latency_ms or 1) - 1:.0%} above the median; lock the clocks"
        for row in results.rows
        if row.status == "timed" and _wide(row)
    ]
    ran = {row.precision for row in results.rows if row.status == "timed"}
    none = [
        f"nothing was timed in {precision}: its latency stays what the profile derives"
        for precision in results.manifest.precisions
        if precision not in ran
    ]
    return [*failed, *wide, *none]


def _drifts(timed: Sequence[Row]) -> list[str]:
    found = []
    for precision in dict.fromkeys(row.precision for row in timed):
        times = [row.reference_ms for row in timed if row.precision == precision]
        known = [ms for ms in times if ms is not None]
        if len(known) > 1 and max(known) / min(known) - 1 > DRIFT:
            found.append(
                f"the device drifted by {max(known) / min(known) - 1:.0%} while it was timed in "
                f"{precision}, which is divided out; lock the clocks for better"
            )
    return found


def _versions(timed: Sequence[Row], results: Results) -> list[str]:
    found = {row.version for row in timed} - {None, results.manifest.version}
    return [
        f"the device runs TensorRT {version}, and the profile is of {results.manifest.version}"
        for version in sorted(version for version in found if version)
    ]
