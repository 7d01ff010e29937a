"""The bundle that rts2-deploy writes, as far as those need it who run the network in it."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from .errors import Rts2Error, UsageError
from .files import read_json, sha256

CONFIGURATION: Final = "deployment.json"
MODEL: Final = "model.onnx"
"""The graph's name in every bundle."""


class _File(BaseModel):
    model_config = ConfigDict(frozen=True)

    name: str
    sha256: str


class _Contents(BaseModel):
    """What a bundle's configuration says of its files; the rest is the target's."""

    model_config = ConfigDict(frozen=True)

    schema_: Literal["rts2.deployment/1"] = Field(alias="schema")
    files: tuple[_File, ...]


def graph_of(path: Path) -> Path:
    """The graph in the bundle at `path`; any path that is no folder, as it is.

    Raises:
        UsageError: the folder is no bundle.
        Rts2Error: its graph is missing, or not the one that its configuration was written with.
    """
    if not path.is_dir():
        return path
    if not (path / CONFIGURATION).is_file():
        raise UsageError(
            f"a model must be a file or a bundle: {path}: it is a folder without {CONFIGURATION}"
        )
    known = read_json(path / CONFIGURATION, _Contents, "a deployment configuration")
    graph = path / MODEL
    hashes = [file.sha256 for file in known.files if file.name == MODEL]
    if not hashes or not graph.is_file():
        raise Rts2Error(f"{path} holds no {MODEL}; make the bundle again with rts2-deploy")
    if sha256(graph) != hashes[0]:
        raise Rts2Error(
            f"{graph} is not the file that {CONFIGURATION} tells the hash of; "
            "make the bundle again with rts2-deploy"
        )
    return graph
