"""deployment.json of a point or an arch, before any file exists, and reading it back."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

from ...model.arch import Arch, Form, Precision
from ...model.box import Figures
from ...model.files import read_json, sha256
from ...model.ops import padded
from ...profiles.latency import fastest_forms
from ...profiles.profile import Profile, Resolution, Runtime
from ..result import Found
from ..result import Point as FrontPoint
from .schema import Deployment, Expected, ExpectedEvidence, File, Input, Output, Postprocessing


def of_point(point: FrontPoint, found: Found, profile: Profile) -> Deployment:
    """The configuration of a point of a front, before any file exists."""
    expected = Expected(
        runtime=point.runtime,
        fps=point.fps,
        fps_low=point.fps_low,
        fps_high=point.fps_high,
        confidence=found.confidence,
        latency_ms=point.latency_ms,
        d1_all=point.d1_all,
        epe=point.epe,
        miou=point.miou,
        evidence=ExpectedEvidence(**point.evidence.model_dump()),
    )
    return of_arch(
        point.arch, profile, point.precision, point.runtime, found.resolution
    ).model_copy(update={"target_fps": found.target_fps, "expected": expected})


def as_judged(expected: Expected, found: tuple[Figures, str] | None) -> Expected:
    """The same promise of speed, with the accuracies that the weights at hand were judged to have.

    Without such figures nothing is known of them.
    """
    figures, frames = found or (None, None)
    return expected.model_copy(
        update={
            "d1_all": figures and figures.d1_all,
            "epe": figures and figures.epe,
            "miou": figures and figures.miou,
            "judged_on": frames,
            "evidence": expected.evidence.model_copy(
                update={"accuracy": "measured" if figures else None}
            ),
        }
    )


def of_arch(
    arch: Arch, profile: Profile, precision: Precision, runtime: Runtime, resolution: Resolution
) -> Deployment:
    """The configuration of a network that no search promised anything of."""
    height, width = padded(resolution, arch.multiple)
    outputs = [
        Output(
            name="disparity",
            shape=(1, height, width),
            dtype="float32",
            meaning="pixels; the point lies at x − disparity in the right image",
        )
    ]
    if arch.semantic:
        outputs.append(
            Output(
                name="semantic",
                shape=(1, height, width),
                dtype="int32",
                meaning="Cityscapes train ids",
            )
        )
    return Deployment(
        device=profile.name,
        target_fps=None,
        arch=arch,
        precision=precision,
        runtime=runtime,
        forms=forms_of(arch, profile, precision, runtime, resolution),
        input=Input(resolution=resolution, shape=(1, 3, height, width)),
        outputs=tuple(outputs),
        postprocessing=Postprocessing(crop=resolution, classes=_class_names(arch)),
        expected=None,
        weights=None,
        files=(),
        versions={"rts2": version("rts2")},
    )


def forms_of(
    arch: Arch, profile: Profile, precision: Precision, runtime: Runtime, resolution: Resolution
) -> tuple[Form, ...] | None:
    """The forms that the device runs fastest, as far as both were timed there."""
    for known in profile.calibrations:
        same = (known.runtime, known.precision) == (runtime, precision)
        if same and arch.family == "rts2net":
            forms = fastest_forms(known.model, arch, resolution) or ()
            return forms if "banded" in forms else None
    return None


def _class_names(arch: Arch) -> tuple[str, ...]:
    """What the class ids mean; nobody knows it of another number of classes."""
    from ...model.data.labels import CLASS_NAMES

    return CLASS_NAMES if arch.semantic and arch.classes == len(CLASS_NAMES) else ()


def describe(path: Path, folder: Path) -> File:
    """A file's name within its bundle, its size and its hash."""
    name = path.relative_to(folder).as_posix()
    return File(name=name, size_bytes=path.stat().st_size, sha256=sha256(path))


def read(path: Path) -> Deployment:
    """A deployment.json. Errors name the first wrong field."""
    return read_json(path, Deployment, "a deployment configuration")
