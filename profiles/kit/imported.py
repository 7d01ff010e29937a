"""The profile of a device that a kit was run on."""

from __future__ import annotations

from collections.abc import Mapping

from ..profile import Fact, Point, Profile
from .fewshot import calibrated
from .prior import prior
from .results import Timings


def profile_of(timings: Timings, profile: Profile, name: str) -> Profile:
    """`profile` with what was timed in the place of what was derived, as a profile called `name`.

    All that the kit did not time stays as it was. The result is validated like any other.
    """
    found = profile
    for points in timings.points.values():
        found = _with(found, points, profile)
    stored = found.model_dump(by_alias=True) | {
        "name": name,
        "hardware": _hardware(profile, timings.facts),
    }
    return Profile.model_validate(stored)


def _with(profile: Profile, points: tuple[Point, ...], before: Profile) -> Profile:
    """`profile` calibrated to the points of one runtime and precision."""
    key = (points[0].runtime, points[0].precision)
    known = prior(before, *key)
    source = (
        f"{len(points)} timings, {points[0].source}; what is likeliest once {known.source} is "
        "the prior"
    )
    others = tuple(c for c in profile.calibrations if (c.runtime, c.precision) != key)
    return profile.model_copy(
        update={
            "calibrations": (*others, calibrated(points, known.model, source)),
            "derivations": tuple(d for d in profile.derivations if (d.runtime, d.precision) != key),
            "points": (*(p for p in profile.points if (p.runtime, p.precision) != key), *points),
        }
    )


def _hardware(profile: Profile, facts: Mapping[str, str]) -> tuple[Fact, ...]:
    """The profile's facts, and what the device said of itself while it was timed."""
    told = {f"{name} when timed": value for name, value in facts.items()}
    kept = (fact for fact in profile.hardware if fact.name not in told)
    new = (Fact(name=name, value=value, source="the device") for name, value in told.items())
    return (*kept, *new)
