"""The machine at hand, and in what it differs from the one that a profile was made on."""

from __future__ import annotations

import platform
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from typing import Final

from ..model.machine import processor
from .profile import Machine

MISSING: Final = "none"
"""The version of a package that is not installed."""

PACKAGES: Final = ("rts2", "onnxruntime", "openvino", "torch")
"""What a machine's versions name that is installed, or not; other names are no packages."""


def this_machine(runtime: str, threads: int) -> Machine:
    """What the machine at hand is, with versions and date."""
    from .runtimes import versions

    own = {"rts2": version("rts2"), "python": platform.python_version()}
    return Machine(
        processor=processor(),
        threads=threads,
        system=f"{platform.system()} {platform.machine()}",
        versions=own | versions(runtime),
        date=date.today().isoformat(),
    )


def differences(machine: Machine, threads: int) -> list[str]:
    """What has changed on this machine since a profile was made here, or that it is another.

    No runtime is imported for it.
    """
    told = (changed(machine, name) for name in sorted(machine.versions))
    return [*elsewhere(machine, threads), *filter(None, told)]


def elsewhere(machine: Machine, threads: int) -> list[str]:
    """That this is another machine than a profile's, or of other threads; empty where it is not."""
    told = []
    here = processor()
    if here != machine.processor:
        told.append(f"the profile is of {machine.processor}; this is {here}")
    if threads != machine.threads:
        told.append(f"the profile is for {machine.threads} threads, not {threads}")
    return told


def changed(machine: Machine, name: str) -> str | None:
    """That a profile was fitted with another version of `name`; None where it was not, or where
    one of the two is not known.
    """
    then, now = machine.versions.get(name), installed(name)
    if then is None or now is None or _public(now) == _public(then):
        return None
    instead = "which is not installed" if now == MISSING else f"not {now}"
    return f"the profile was fitted with {name} {then}, {instead}"


def installed(name: str) -> str | None:
    """A version here, "none" for a package that is missing, None for what is no package."""
    if name == "python":
        return platform.python_version()
    if name not in PACKAGES:
        return None
    try:
        return version(name)
    except PackageNotFoundError:
        return MISSING


def _public(number: str) -> str:
    """A version without the label of its build, which a package tells and its metadata may not."""
    return number.partition("+")[0]
