"""Several runtimes in one profile of a machine: fitted one by one, at one reference speed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, TypeVar

from .here import changed, elsewhere
from .profile import (
    Calibration,
    Machine,
    Point,
    PrecisionSupport,
    Profile,
    Runtime,
    RuntimeSupport,
)

FITTED: Final[tuple[Runtime, ...]] = ("onnxruntime", "openvino")
"""What a profile of the machine at hand may hold, in the order in which it holds them."""

OURS: Final = "rts2-profile"
"""The source of what was found on the machine and stands in no data sheet."""

OfRuntime = TypeVar("OfRuntime", Calibration, Point, RuntimeSupport)


def others(profile: Profile, runtime: Runtime) -> tuple[Runtime, ...]:
    """The runtimes besides `runtime` that the profile is calibrated for."""
    known = dict.fromkeys(calibration.runtime for calibration in profile.calibrations)
    return tuple(name for name in known if name != runtime)


def apart(profile: Profile, threads: int) -> str | None:
    """Why what is timed here cannot stand beside the profile's times; None where it can.

    All times of a profile are ratios to the reference, at one speed of it. On another machine, on
    other threads, in another ONNX Runtime, in which it runs, the reference has another.
    """
    machine = profile.machine
    if machine is None or machine.reference_ms is None:
        return "the profile does not tell how fast its reference ran"
    told = [*elsewhere(machine, threads), changed(machine, "onnxruntime")]
    return "; ".join(filter(None, told)) or None


def blank(template: Profile) -> Profile:
    """`template` with the precisions and runtimes of data sheets alone, not of its machine."""
    return template.model_copy(
        update={
            "precisions": tuple(p for p in template.precisions if p.source != OURS),
            "runtimes": tuple(r for r in template.runtimes if r.source != OURS),
        }
    )


def joined(own: Profile, known: Profile) -> Profile:
    """`own`, of one runtime and at the speed of `known`'s reference, with `known`'s other runtimes.

    Calibrations, points and runtimes go by `FITTED`; within a runtime they stay as they were.
    """
    (runtime,) = {calibration.runtime for calibration in own.calibrations}
    kept = others(known, runtime)
    calibrations = _with(own.calibrations, known.calibrations, kept)
    assert own.machine is not None
    assert known.machine is not None
    return own.model_copy(
        update={
            "precisions": precision_support(blank(known), calibrations),
            "runtimes": _with(own.runtimes, known.runtimes, kept),
            "calibrations": calibrations,
            "points": _with(own.points, known.points, kept),
            "machine": _merged(own.machine, known.machine),
        }
    )


def _with(
    own: Sequence[OfRuntime], known: Sequence[OfRuntime], kept: Sequence[Runtime]
) -> tuple[OfRuntime, ...]:
    """`known`'s entries of the runtimes `kept`, and all others of `own`, by `FITTED`."""
    found = [entry for entry in known if entry.runtime in kept]
    found += [entry for entry in own if entry.runtime not in kept]
    return tuple(sorted(found, key=lambda entry: _place(entry.runtime)))


def _place(runtime: Runtime) -> int:
    return FITTED.index(runtime) if runtime in FITTED else len(FITTED)


def _merged(own: Machine, known: Machine) -> Machine:
    """The machine now, with the versions that the kept runtimes had.

    The date stays that of the reference's speed: nothing in the profile is older.
    """
    return own.model_copy(
        update={
            "versions": known.versions | own.versions,
            "date": known.date,
            "reference_ms": known.reference_ms,
        }
    )


def precision_support(
    template: Profile, calibrations: Sequence[Calibration]
) -> tuple[PrecisionSupport, ...]:
    """Each precision that any runtime was timed in, then what `template` says of the others.

    What a template refuses for one runtime does not stand against another that runs it.
    """
    timed: dict[str, PrecisionSupport] = {}
    for known in calibrations:
        names = [titled(c.runtime) for c in calibrations if c.precision == known.precision]
        timed[known.precision] = PrecisionSupport(
            precision=known.precision,
            supported=True,
            reason=f"timed in {' and '.join(names)}",
            source=OURS,
        )
    told = (known for known in template.precisions if known.precision not in timed)
    return (*timed.values(), *told)


def runtime_support(
    template: Profile, runtime: Runtime, version: str
) -> tuple[RuntimeSupport, ...]:
    """The template's, and the one that was timed."""
    if runtime in {known.runtime for known in template.runtimes}:
        return template.runtimes
    return (*template.runtimes, RuntimeSupport(runtime=runtime, version=version, source=OURS))


def titled(runtime: str) -> str:
    """A runtime's own name."""
    from .runtimes import RUNTIMES

    return RUNTIMES[runtime].title
