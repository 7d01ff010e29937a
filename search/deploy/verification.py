"""`rts2-deploy verify`: a bundle's hashes, then its own verify.py."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...model.bundle import CONFIGURATION, contents, require_unchanged
from ...model.errors import Rts2Error
from .bundle import VERIFY
from .configuration import read


@dataclass(frozen=True)
class Verified:
    """What verify.py printed, and why the bundle failed; None where it did not."""

    text: str
    failure: str | None


def verify(folder: Path, as_json: bool = False) -> Verified:
    """Checks the bundle in `folder`, and runs its verify.py in this Python.

    Raises:
        UsageError: the folder is no bundle.
        Rts2Error: the configuration is not what its schema tells, or a file is missing or was
            changed, or has weights in a file that is missing.
    """
    files = contents(folder)
    read(folder / CONFIGURATION)
    for file in files:
        path = require_unchanged(folder, file)
        if path.suffix == ".onnx":
            _require_weights(path)
    script = folder / VERIFY
    if not script.is_file():
        raise Rts2Error(f"{folder} holds no {VERIFY}; make the bundle again with rts2-deploy")
    words = [sys.executable, str(script), *(["--json"] if as_json else [])]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    failure = ended.stderr.strip() or f"{VERIFY} ended with {ended.returncode}"
    return Verified(ended.stdout, failure if ended.returncode else None)


def parsed(text: str) -> dict[str, Any]:
    """What verify.py said with --json; empty where it failed before it could."""
    found: dict[str, Any] = json.loads(text) if text.strip() else {}
    return found


def _require_weights(path: Path) -> None:
    """Raises `Rts2Error` where the graph keeps weights in another file that is not there."""
    from onnx.external_data_helper import ExternalDataInfo, uses_external_data

    from ...model.graph import load_graph

    for tensor in load_graph(path).graph.initializer:
        if uses_external_data(tensor):
            place = ExternalDataInfo(tensor).location
            if not (path.parent / place).is_file():
                raise Rts2Error(
                    f"{path} keeps weights in {place}, which is missing; copy the whole bundle"
                )
