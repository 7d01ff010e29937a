"""The graph of a checkpoint for one size of images: exported once, then kept on disk.

A kept file is named by all that makes it: the weights, the size, the code and the versions. Any
other weights or code never meet it; it can be deleted at any time.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

from .errors import Rts2Error
from .files import output_folder, write_bytes
from .graph import header_of, load_graph

if TYPE_CHECKING:
    from onnx import ModelProto

    from .arch import Form

MOST: Final = 24
"""How many graphs are kept; those that were not used for the longest time go first."""

FORMS: Final[tuple[Form, ...]] = ("3d", "banded", "banded")
"""How such a graph holds the 3D convs of its stages: what ONNX Runtime was measured fastest at for
c8, c1 and AnyNet, by 2 to 13%. `rts2-deploy` decides by the profile of the device."""


def exported(checkpoint: Path, resolution: tuple[int, int]) -> ModelProto:
    """The graph of a checkpoint for images of this width and height, all its stages in it.

    Raises as `checkpoint.load` does. A folder that cannot be written to costs the time of an
    export in every process, and nothing else.
    """
    kept = folder() / f"{_name(checkpoint, resolution)}.onnx"
    with suppress(Rts2Error, OSError):
        model = load_graph(kept)
        header_of(model, kept)
        kept.touch()
        return model
    content = _export(checkpoint, resolution)
    with suppress(Rts2Error, OSError):
        output_folder(kept.parent)
        write_bytes(kept, content)
        _forget(kept.parent)
    from onnx import load_model_from_string

    return load_model_from_string(content)


def folder() -> Path:
    """Where graphs are kept."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "rts2"


def _export(checkpoint: Path, resolution: tuple[int, int]) -> bytes:
    from .checkpoint import load
    from .export import export

    network, header = load(checkpoint)
    forms = FORMS[: network.arch.stages]
    with TemporaryDirectory() as temporary:
        path = Path(temporary) / "network.onnx"
        export(network, path, resolution, header.origin, forms=forms)
        return path.read_bytes()


def _name(checkpoint: Path, resolution: tuple[int, int]) -> str:
    """A hash of everything that the graph is made of."""
    told = sha256(repr((checkpoint.name, resolution)).encode())
    for package in ("rts2", "torch", "onnx", "onnxruntime"):
        told.update(version(package).encode())
    for path in (checkpoint, *_sources()):
        told.update(sha256(path.read_bytes()).digest())
    return told.hexdigest()


def _sources() -> Iterator[Path]:
    """The code of the networks and of their export."""
    here = Path(__file__).parent
    yield from sorted((*here.glob("*.py"), *(here / "forms").glob("*.py")))


def _forget(kept: Path) -> None:
    """Deletes all but the newest."""
    graphs = sorted(kept.glob("*.onnx"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in graphs[MOST:]:
        path.unlink(missing_ok=True)
