"""A kit of small networks, and a `trtexec` that tells planted times."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rts2.model import export
from rts2.model.arch import Arch
from rts2.profiles.kit import folder
from rts2.profiles.kit.folder import write
from rts2.profiles.kit.manifest import Manifest
from rts2.profiles.kit.prior import prior
from rts2.profiles.latency import LatencyModel, predict_ms
from rts2.profiles.plan import VARIANTS, Candidate
from rts2.profiles.profile import load

STANDIN = Path(__file__).with_name("standin.py")


def small() -> list[Candidate]:
    """Twelve networks that export in no time."""
    found = []
    for index in range(12):
        stages = 1 + index % 3
        semantic, refinement = VARIANTS[index // 3 % 3]
        arch = Arch(
            c=1 + index // 2,
            stages=stages,
            d_max=6 + index % 4,
            conv3d=(4, 2, 2)[:stages],
            semantic=semantic,
            refinement=refinement,
        )
        found.append((arch, (96, 64) if index % 2 else (160, 96)))
    return found


def truth() -> LatencyModel:
    """A device that is not what its profile derives: launches cost a third, the work 0.8 of it."""
    known = prior(load("tx2"), "tensorrt", "fp32").model
    per = {name: 0.8 * ms for name, ms in known.ms_per.items()}
    return known.model_copy(update={"start_ms": known.start_ms / 3, "ms_per": per})


class Device:
    """A copy of a kit on a device that is made up."""

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        self.folder, self.manifest = folder, manifest
        self.logs = folder / f"logs-{manifest.kit}"
        self.calls = folder.parent / "calls.txt"
        self.calls.touch()
        times = {
            network.file: predict_ms(truth(), network.arch, network.resolution)
            for network in manifest.networks
        }
        (folder.parent / "times.json").write_text(json.dumps(times))
        program = folder.parent / "trtexec"
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -I -S "{STANDIN}" "$@"\n')
        program.chmod(0o755)
        self.given = {
            "TRTEXEC": str(program),
            "KIT_TIMES": str(folder.parent / "times.json"),
            "KIT_CALLS": str(self.calls),
        }

    def run(self, **given: str) -> subprocess.CompletedProcess[str]:
        return self._ended(["sh", str(self.folder / "run.sh")], given)

    def collect(self) -> subprocess.CompletedProcess[str]:
        return self._ended([sys.executable, str(self.folder / "collect.py")], {})

    def keep(self, count: int) -> None:
        """Lets run.sh time the first networks alone."""
        script = self.folder / "run.sh"
        text = script.read_text()
        for network in self.manifest.networks[count:]:
            if network.name != self.manifest.reference:
                text = text.replace(f" {network.name}", "")
        script.write_text(text)

    def results(self) -> dict[str, Any]:
        assert self.collect().returncode == 0
        found: dict[str, Any] = json.loads((self.folder / "kit-results.json").read_text())
        return found

    def called(self) -> list[str]:
        return self.calls.read_text().splitlines()

    def _ended(self, words: list[str], given: dict[str, str]) -> subprocess.CompletedProcess[str]:
        """From another folder, and without rts2 on the path."""
        ended = subprocess.run(
            words,
            capture_output=True,
            text=True,
            cwd=self.folder.parent,
            env=os.environ | self.given | given,
            check=False,
        )
        assert "Traceback" not in ended.stderr, ended.stderr
        return ended


def named(network: Any, path: Path, *given: Any, **more: Any) -> None:
    """In the place of an export, where the graph does not matter."""
    path.write_text(f"{network.arch.label()} {given}")


@pytest.fixture(scope="session")
def kit(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Manifest]:
    path = tmp_path_factory.mktemp("kits") / "kit"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "export", named)
        patch.setattr(folder, "refuse_operators", lambda *_: None)
        return path, write(load("tx2"), ("fp32", "fp16"), path, small())


@pytest.fixture
def device(kit: tuple[Path, Manifest], tmp_path: Path) -> Device:
    """The kit, copied and not run yet."""
    path, manifest = kit
    shutil.copytree(path, tmp_path / "device" / "kit")
    return Device(tmp_path / "device" / "kit", manifest)


@pytest.fixture(scope="session")
def _ran(kit: tuple[Path, Manifest], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ran") / "kit"
    shutil.copytree(kit[0], path)
    ended = Device(path, kit[1]).run()
    assert (ended.returncode, ended.stderr) == (0, "")
    return path


@pytest.fixture
def ran(_ran: Path, kit: tuple[Path, Manifest], tmp_path: Path) -> Device:
    """The kit after run.sh."""
    shutil.copytree(_ran, tmp_path / "ran" / "kit")
    return Device(tmp_path / "ran" / "kit", kit[1])
