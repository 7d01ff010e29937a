"""What the machine at hand is."""

from __future__ import annotations

import ctypes
import os
import platform
from pathlib import Path


def cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor() -> str:
    """The processor's name and, where the system tells them, its family and model."""
    known: dict[str, str] = {}
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            name, _, value = line.partition(":")
            known.setdefault(name.strip(), value.strip())
    title = known.get("model name") or platform.processor() or platform.machine()
    family, model = known.get("cpu family"), known.get("model")
    return f"{title}, family {family}, model {model}" if family and model else title


def features() -> frozenset[str]:
    """What the processor says that it can do, in the system's words; empty where it is not told."""
    cpuinfo = Path("/proc/cpuinfo")
    if not cpuinfo.exists():
        return frozenset()
    for line in cpuinfo.read_text(encoding="utf-8").splitlines():
        name, _, value = line.partition(":")
        if name.strip() in ("flags", "Features"):
            return frozenset(value.split())
    return frozenset()


def release_memory() -> None:
    """Gives back to the system what was freed, where the C library keeps it and can (glibc).

    Exports free some hundred MB in pieces, of which it keeps more with every one.
    """
    if platform.system() != "Linux":
        return
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(ctypes.c_size_t(0))
