"""The bundle that rts2-deploy writes, as far as those need it who run the network in it."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from .errors import Rts2Error, UsageError
from .files import read_json, sha256

CONFIGURATION: Final = "deployment.json"
MODEL: Final = "model.onnx"
"""The graph's name in every bundle."""


def _inside(name: str) -> str:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or str(path) != name or name == ".":
        raise ValueError("a file of a bundle must lie in its folder")
    return name


FileName = Annotated[str, AfterValidator(_inside)]
"""A file's path within the bundle, with slashes: it leads nowhere else."""


class BundleFile(BaseModel):
    """A file of a bundle as its configuration tells it."""

    model_config = ConfigDict(frozen=True)

    name: FileName
    sha256: str


class _Contents(BaseModel):
    """What a bundle's configuration says of its files; the rest is the target's."""

    model_config = ConfigDict(frozen=True)

    schema_: Literal["rts2.deployment/1"] = Field(alias="schema")
    files: tuple[BundleFile, ...]


def contents(folder: Path) -> tuple[BundleFile, ...]:
    """The files of the bundle in `folder`, as its configuration tells them.

    Raises:
        UsageError: the folder is no bundle.
        Rts2Error: its configuration is broken.
    """
    if not (folder / CONFIGURATION).is_file():
        why = f"a folder without {CONFIGURATION}" if folder.is_dir() else "no folder"
        raise UsageError(f"a bundle must be a folder that rts2-deploy wrote: {folder}: it is {why}")
    return read_json(folder / CONFIGURATION, _Contents, "a deployment configuration").files


def require_unchanged(folder: Path, file: BundleFile) -> Path:
    """The path of a bundle's file.

    Raises `Rts2Error` where it is missing, or not the one that the configuration was written with.
    """
    path = folder / file.name
    if not path.is_file():
        raise Rts2Error(f"{folder} holds no {file.name}; make the bundle again with rts2-deploy")
    if sha256(path) != file.sha256:
        raise Rts2Error(
            f"{path} is not the file that {CONFIGURATION} tells the hash of; "
            "make the bundle again with rts2-deploy"
        )
    return path


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
    for file in contents(path):
        if file.name == MODEL:
            return require_unchanged(path, file)
    raise Rts2Error(f"{path} holds no {MODEL}; make the bundle again with rts2-deploy")
