"""What a target is: how a runtime gets from the graph to something that runs on the device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from ...model.arch import Precision
from ...profiles.profile import Profile, RuntimeSupport
from ...profiles.trtexec import Generation
from .schema import Calibration, Execution, LayerPrecision

NOT_CALIBRATED = Calibration()
"""What a graph without integers says."""


@dataclass(frozen=True)
class Tolerance:
    """How far a runtime may be from the answers that are expected."""

    mean_px: float
    """Of the disparity's difference; `percentile_px` is its 99th percentile."""
    percentile_px: float
    equal_classes: float
    """The share of pixels whose class must be the same."""


@dataclass(frozen=True)
class Order:
    """A graph that was checked against its network, and what is to become of it."""

    graph: Path
    """In fp32, in the bundle's folder; a target may lower it in its place."""
    precision: Precision
    profile: Profile
    support: RuntimeSupport
    generation: Generation | None = None
    """Of TensorRT; None stands for the device's usual one."""
    plan_to: str | None = None
    """Where within the bundle an engine is wanted too."""

    @property
    def folder(self) -> Path:
        return self.graph.parent


@dataclass(frozen=True)
class Made:
    """What became of an order, beside the files."""

    execution: Execution
    layers: tuple[LayerPrecision, ...]
    calibration: Calibration = NOT_CALIBRATED


@dataclass(frozen=True)
class Target:
    """One runtime that bundles are made for."""

    title: str
    tolerances: Mapping[Precision, Tolerance]
    """What it makes of a float graph, and how far each may be off."""
    make: Callable[[Order], Made]
    """Writes what the runtime needs beside the graph. Raises `UsageError` for what the device does
    not have, `Rts2Error` for a graph that it does not take."""
    next_step: str
    """The command that builds and checks a bundle on the device."""
    leaves: tuple[str, ...] = ()
    """What the scripts make on the device."""
    notes: str = ""
    """What an integrator should know of it, for the bundle's README."""
