"""What a kit is made of, and which kit it is: the import must know what each timing is of."""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ...model.arch import Arch, Precision
from ...model.ops import ops
from ..profile import Frozen, Resolution

Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

MANIFEST = "manifest.json"


class KitNetwork(Frozen):
    """One network of a kit."""

    name: Annotated[str, Field(pattern=r"^network-\d+$")]
    sha256: Sha256
    """Of its ONNX file."""
    arch: Arch
    resolution: Resolution

    @property
    def file(self) -> str:
        return f"{self.name}.onnx"

    @property
    def work(self) -> int:
        """Its multiply-adds."""
        return sum(op.macs for op in ops(self.arch, self.resolution))


class Manifest(Frozen):
    """A kit: for which device, and its networks."""

    schema_: Literal["rts2.kit/1"] = Field(default="rts2.kit/1", alias="schema")
    kit: str = ""
    """Tells this kit from every other: the hash of all that follows."""
    device: str
    """The name of the profile that it was made from."""
    runtime: Literal["tensorrt"] = "tensorrt"
    version: str
    """Of the runtime, as the profile has it."""
    precisions: tuple[Precision, ...]
    reference: str
    """The network that is timed beside every other, so that a drift of the device cancels."""
    networks: tuple[KitNetwork, ...]
    rts2: str

    @model_validator(mode="after")
    def _whole(self) -> Manifest:
        names = [network.name for network in self.networks]
        repeated = [name for name in names if names.count(name) > 1]
        if repeated:
            raise ValueError(f"{repeated[0]} occurs twice among the networks")
        if self.reference not in names:
            raise ValueError(f"the reference {self.reference} is none of the networks")
        return self

    def identity(self) -> str:
        """What `kit` must be."""
        content = self.model_dump(mode="json", by_alias=True, exclude={"kit"})
        text = json.dumps(content, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def identified(self) -> Manifest:
        """The same with `kit` filled in."""
        return self.model_copy(update={"kit": self.identity()})

    def network(self, name: str) -> KitNetwork | None:
        """The network of that name, if there is one."""
        return next((network for network in self.networks if network.name == name), None)
