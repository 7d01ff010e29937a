"""Bundles of a small network, written once, copies to be spoiled, and how a target runs them."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch

from rts2.model.arch import Arch, Precision
from rts2.model.checkpoint import build
from rts2.profiles.profile import Profile, Runtime, load
from rts2.profiles.trtexec import Generation
from rts2.search.deploy.bundle import Source, write
from rts2.search.deploy.configuration import of_point
from rts2.search.deploy.schema import Deployment
from rts2.search.result import Coverage, Found, Point, PointEvidence

SIZE = (90, 60)
SMALL = Arch(c=1, stages=2, d_max=6, conv3d=(4, 2))
STANDIN = Path(__file__).parents[2] / "profiles" / "kit" / "standin.py"


class Kind(NamedTuple):
    """What a bundle is made for."""

    device: str
    runtime: Runtime
    precision: Precision
    generation: Generation | None = None
    triton: bool = False


def asked(known: Profile, kind: Kind) -> Deployment:
    """What a front would ask for; the numbers are made up."""
    point = Point(
        arch=SMALL,
        precision=kind.precision,
        runtime=kind.runtime,
        latency_ms=40,
        fps=25,
        fps_low=21.5,
        fps_high=29,
        d1_all=5.5,
        epe=None,
        miou=None,
        pacc=None,
        params=1,
        size_bytes=4,
        macs=1,
        evidence=PointEvidence(latency="extrapolated", accuracy="published"),
    )
    found = Found(
        device=known.name,
        target_fps=20,
        resolution=SIZE,
        task="semantic-stereo",
        objective="d1_all",
        confidence=0.9,
        space=Coverage(size=1, evaluated=1, exhaustive=True),
        front=(point,),
        selected=point,
        prospect=point,
        nearest=None,
        left_out=(),
        elapsed_s=0,
    )
    return of_point(point, found, known)


def written(folder: Path, kind: Kind) -> Path:
    """A bundle of random weights that are always the same."""
    folder.mkdir(parents=True)
    if kind.runtime == "openvino" and kind.precision != "fp32":
        pytest.importorskip("openvino", reason="needs OpenVINO: pip install 'rts2[openvino]'")
    known = load(kind.device)
    torch.manual_seed(0)
    source = Source(build(SMALL), "untrained")
    write(source, asked(known, kind), known, folder, kind.generation, kind.triton)
    return folder


Maker = Callable[..., Path]


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Maker:
    """Of `Kind`'s fields; each is written once, and must stay as it is."""
    made: dict[Kind, Path] = {}

    def of(*fields: Any, **more: Any) -> Path:
        kind = Kind(*fields, **more)
        if kind not in made:
            made[kind] = written(tmp_path_factory.mktemp("bundles") / "bundle", kind)
        return made[kind]

    return of


@pytest.fixture
def copied(bundle: Maker, tmp_path: Path) -> Maker:
    """The same, to be spoiled."""

    def of(*fields: Any, **more: Any) -> Path:
        return Path(shutil.copytree(bundle(*fields, **more), tmp_path / "device" / "bundle"))

    return of


@pytest.fixture
def write_bundle() -> Callable[[Path, Kind], Path]:
    return written


@pytest.fixture
def order() -> Callable[..., tuple[Profile, Deployment]]:
    """A profile, and what a front asks of it."""

    def of(*fields: Any) -> tuple[Profile, Deployment]:
        kind = Kind(*fields)
        known = load(kind.device)
        return known, asked(known, kind)

    return of


Ended = subprocess.CompletedProcess[str]


@pytest.fixture
def checked() -> Callable[..., Ended]:
    """verify.py as the target runs it: from elsewhere, and without rts2 on the path.

    `instead` has the text of modules that stand in for those which are installed.
    """

    def run(
        folder: Path,
        *words: str,
        instead: Mapping[str, str] | None = None,
        given: Mapping[str, str] | None = None,
    ) -> Ended:
        modules = folder.parent / "instead"
        modules.mkdir(exist_ok=True)
        for name, text in (instead or {}).items():
            (modules / f"{name}.py").write_text(text)
        command = [sys.executable, str(folder / "verify.py"), *words]
        return ended(command, folder, {"PYTHONPATH": str(modules), **(given or {})})

    return run


def ended(command: list[str], folder: Path, given: Mapping[str, str]) -> Ended:
    found = subprocess.run(
        command,
        capture_output=True,
        text=True,
        cwd=folder.parent,
        env=os.environ | given,
        check=False,
    )
    assert "Traceback" not in found.stderr, found.stderr
    return found


@pytest.fixture
def built(tmp_path: Path) -> Callable[..., Ended]:
    """build.sh, with a `trtexec` of a release: it takes that release's options alone, and answers
    as the graph does.
    """

    def run(folder: Path, release: str, **given: str) -> Ended:
        program = tmp_path / "trtexec"
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -I "{STANDIN}" "$@"\n')
        program.chmod(0o755)
        times = tmp_path / "times.json"
        times.write_text(json.dumps({"model.onnx": 20.0}))
        known = {
            "TRTEXEC": str(program),
            "KIT_RELEASE": release,
            "KIT_TIMES": str(times),
            "KIT_CALLS": str(tmp_path / "calls.txt"),
        }
        return ended(["sh", str(folder / "build.sh")], folder, known | given)

    return run


@pytest.fixture
def rehashed() -> Callable[..., None]:
    """Makes deployment.json agree with what a test has done to the files; `more` are new ones."""

    def run(folder: Path, *more: str, **changes: Any) -> None:
        path = folder / "deployment.json"
        known = json.loads(path.read_text()) | changes
        known["files"] += [{"name": name} for name in more]
        for entry in known["files"]:
            data = (folder / entry["name"]).read_bytes()
            entry |= {"size_bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        path.write_text(json.dumps(known))

    return run
