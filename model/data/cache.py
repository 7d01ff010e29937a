"""Scenes that were slow to make or to decode, kept on disk as they are in memory.

A file is named by the fingerprint of its sample, so a changed file, option or generator never meets
an old scene. Many processes may share one folder: files appear whole, by a rename.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from math import prod
from pathlib import Path
from typing import Any, Final, Literal, overload

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from ..errors import Rts2Error
from ..files import output_folder, write_bytes
from .scene import Foreground, Sample, Scene, fingerprint

MAGIC: Final = b"rts2 scene 1\n"
"""Names the format; another number stands for another layout."""

ALIGNED: Final = 64
"""Arrays begin at multiples of this many bytes."""

MEMORY: Final[dict[str, str]] = {
    "left": "|u1",
    "right": "|u1",
    "truth": "<f4",
    "foreground": "|b1",
    "semantic": "|u1",
    "visible": "|b1",
    "instances": "<i4",
}
"""The fields of a scene with their types in memory."""

Field = Literal["left", "right", "truth", "foreground", "semantic", "visible", "instances"]


class Stored(BaseModel):
    """One array of the file; each begins where the one before it ends, aligned."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    field: Field
    shape: tuple[int, ...]
    dtype: Literal["|u1", "<u2", "<i4", "<f4", "bits"]

    @property
    def size(self) -> int:
        """In bytes, without what aligns the next one."""
        count = prod(self.shape)
        return -(-count // 8) if self.dtype == "bits" else count * np.dtype(self.dtype).itemsize


class Header(BaseModel):
    """What a file holds, and of which sample."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key: str
    name: str
    arrays: tuple[Stored, ...]


class Cached(Sequence[Sample]):
    """The same samples; the first read of each leaves its scene in `folder`, later ones load it.

    The samples, or the data set as a whole, must have a `fingerprint`: a text that changes when
    what is read does.

    Raises:
        Rts2Error: `folder` cannot be written, or the disk is full (also from a sample's `read`).
    """

    def __init__(self, samples: Sequence[Sample], folder: Path) -> None:
        self.samples = samples
        self.folder = _usable(folder.absolute())
        self.fingerprint = fingerprint(samples)
        """That of the data set behind it; None where only its samples have one."""

    def __len__(self) -> int:
        return len(self.samples)

    @overload
    def __getitem__(self, index: int) -> CachedSample: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[CachedSample, ...]: ...

    def __getitem__(self, index: int | slice) -> CachedSample | tuple[CachedSample, ...]:
        if isinstance(index, slice):
            return tuple(self._cached(i) for i in range(*index.indices(len(self))))
        return self._cached(range(len(self))[index])

    def _cached(self, index: int) -> CachedSample:
        whole = None if self.fingerprint is None else f"{self.fingerprint} {index}"
        return CachedSample(self.samples[index], self.folder, whole)


@dataclass(frozen=True)
class CachedSample:
    """A sample whose scene is kept in a folder."""

    sample: Sample
    folder: Path
    whole: str | None
    """The data set's fingerprint with the sample's place; None where only the sample has one."""

    @property
    def name(self) -> str:
        return self.sample.name

    @property
    def size(self) -> tuple[int, int]:
        return self.sample.size

    @property
    def foreground(self) -> Foreground | None:
        return self.sample.foreground

    @property
    def path(self) -> Path:
        """Where the scene is kept, once it was read."""
        return self._place(self._key())

    def read(self) -> Scene:
        """The scene, from the cache if it is there and whole."""
        key = self._key()
        path = self._place(key)
        kept = _load(path, key)
        if kept is not None:
            return kept
        scene = self.sample.read()
        self._keep(path, pack(scene, key))
        return scene

    def _key(self) -> str:
        own = fingerprint(self.sample)
        if own is None and self.whole is None:
            raise Rts2Error(f"a sample needs a fingerprint to be cached: {self.sample.name}")
        text = "\n".join((MAGIC.decode(), self.sample.name, own or "", self.whole or ""))
        return hashlib.sha256(text.encode()).hexdigest()[:32]

    def _place(self, key: str) -> Path:
        """Files lie in 256 folders, as some disks are slow with many in one."""
        return self.folder / key[:2] / f"{key}.scene"

    def _keep(self, path: Path, data: bytes) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, data)
        except (OSError, Rts2Error) as error:
            raise Rts2Error(
                f"the cache cannot keep {self.name}: {_reason(error)}; free space in "
                f"{self.folder}, or name another folder"
            ) from error


def _usable(folder: Path) -> Path:
    try:
        return output_folder(folder)
    except Rts2Error as error:
        raise Rts2Error(
            f"the cache cannot be kept in {folder}: {_reason(error)}; name another folder"
        ) from error


def _reason(error: Exception) -> str:
    """What the system said."""
    cause = error if isinstance(error, OSError) else error.__cause__
    return getattr(cause, "strerror", None) or str(error)


def pack(scene: Scene, key: str) -> bytes:
    """A scene as a file: a line, the header's length and text, and the arrays, bit by bit."""
    encoded = {name: _encoded(array) for name, array in scene.arrays().items()}
    stored = tuple(
        Stored.model_validate({"field": name, "shape": array.shape, "dtype": encoded[name][0]})
        for name, array in scene.arrays().items()
    )
    header = Header(key=key, name=scene.name, arrays=stored).model_dump_json().encode()
    head = MAGIC + struct.pack("<I", len(header)) + header
    parts = (head, *(data for _, data in encoded.values()))
    return b"".join(part + bytes(_aligned(len(part)) - len(part)) for part in parts)


def unpack(data: bytearray, key: str) -> Scene | None:
    """The scene of a file; None where it is none, a truncated one, or another sample's."""
    begin = len(MAGIC) + 4
    if len(data) < begin or not data.startswith(MAGIC):
        return None
    (length,) = struct.unpack_from("<I", data, len(MAGIC))
    try:
        header = Header.model_validate_json(bytes(data[begin : begin + length]))
        sizes = [_aligned(begin + length), *(_aligned(stored.size) for stored in header.arrays)]
        if header.key != key or sum(sizes) != len(data):
            return None
        places = zip(header.arrays, accumulate(sizes), strict=False)
        arrays: dict[str, Any] = {each.field: _decoded(data, at, each) for each, at in places}
        return Scene(name=header.name, **arrays)
    except (ValueError, TypeError, Rts2Error):
        return None


def _load(path: Path, key: str) -> Scene | None:
    try:
        with path.open("rb", buffering=0) as file:
            data = bytearray(path.stat().st_size)
            if file.readinto(data) != len(data):
                return None
    except OSError:
        return None
    return unpack(data, key)


def _encoded(array: NDArray[Any]) -> tuple[str, bytes]:
    """Booleans become bits, numbers of instances the smallest type that holds them."""
    if array.dtype == np.bool_:
        return "bits", np.packbits(array).tobytes()
    if array.dtype == np.int32:
        smallest = np.min_scalar_type(int(array.max(initial=0)))
        if array.min(initial=0) >= 0 and smallest.itemsize <= 2:
            array = array.astype(smallest)
    return array.dtype.str, np.ascontiguousarray(array).tobytes()


def _decoded(data: bytearray, start: int, stored: Stored) -> NDArray[Any]:
    """One array, in the type that it has in memory; it may be written to."""
    part = memoryview(data)[start : start + stored.size]
    if stored.dtype == "bits":
        bits = np.unpackbits(np.frombuffer(part, np.uint8), count=prod(stored.shape))
        return bits.view(np.bool_).reshape(stored.shape)
    values = np.frombuffer(part, stored.dtype).reshape(stored.shape)
    return values.astype(MEMORY[stored.field], copy=False)


def _aligned(size: int) -> int:
    return -(-size // ALIGNED) * ALIGNED
