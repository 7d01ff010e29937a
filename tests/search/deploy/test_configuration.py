"""deployment.json: what was searched, on what evidence, how an image becomes an input."""

import json
from pathlib import Path

import pytest

from rts2.model.arch import MEAN, STD, Arch
from rts2.model.errors import Rts2Error, UsageError
from rts2.profiles.parts import PartModel
from rts2.profiles.profile import load
from rts2.search.deploy.configuration import describe, of_arch, of_point, read
from rts2.search.deploy.schema import Deployment, json_schema
from rts2.search.exhaustive import Question, search
from rts2.search.result import Found
from rts2.search.sources import source
from rts2.search.space import Space


@pytest.fixture(scope="module")
def found() -> Found:
    """A search of a small part of the space."""
    profile = load("tx2")
    space = Space(c=(1, 8, 16), d_max=(12,), conv3d=((16,), (4,), (4,)))
    return search(Question(profile, target_fps=5), source("published"), space)


def test_a_point_becomes_its_configuration_number_by_number(found: Found) -> None:
    point = found.selected
    assert point is not None
    made = of_point(point, found, load("tx2"))
    assert (made.device, made.target_fps) == ("tx2", 5)
    assert (made.arch, made.precision, made.runtime) == (point.arch, point.precision, point.runtime)
    expected = made.expected
    assert expected is not None
    for name in ("fps", "fps_low", "fps_high", "latency_ms", "d1_all", "epe", "miou"):
        assert getattr(expected, name) == getattr(point, name)
    assert expected.evidence.model_dump() == point.evidence.model_dump()
    assert expected.judged_on is None
    assert expected.confidence == found.confidence
    assert expected.fps_low < expected.fps < expected.fps_high
    assert expected.fps >= 5
    assert expected.latency_ms == pytest.approx(1000 / expected.fps)
    assert (made.weights, made.check, made.files) == (None, None, ())
    assert (made.execution, made.layers, made.calibration.images) == (None, (), ())


def test_it_passes_through_its_file(found: Found, tmp_path: Path) -> None:
    assert found.selected is not None
    made = of_point(found.selected, found, load("tx2"))
    path = tmp_path / "deployment.json"
    path.write_text(json.dumps(made.model_dump(mode="json", by_alias=True)))
    assert read(path) == made
    assert json.loads(path.read_text())["schema"] == "rts2.deployment/1"


@pytest.mark.parametrize(
    ("arch", "resolution", "size"),
    [
        (Arch(c=1), (1242, 375), (384, 1248)),
        (Arch(c=1), (640, 192), (192, 640)),
        (Arch(c=1), (33, 32), (32, 64)),
        (Arch(family="anynet", c=1), (1242, 375), (384, 1248)),
        (Arch(family="anynet", c=1), (1232, 368), (368, 1232)),
    ],
)
def test_the_input_is_padded_to_what_the_family_needs(
    arch: Arch, resolution: tuple[int, int], size: tuple[int, int]
) -> None:
    made = of_arch(arch, load("cpu"), "fp32", "onnxruntime", resolution)
    assert made.input.resolution == resolution
    assert made.input.shape == (1, 3, *size)
    assert {output.shape for output in made.outputs} == {(1, *size)}
    assert (made.input.mean, made.input.std) == (MEAN, STD)
    assert made.input.scale * 255 == 1
    assert made.postprocessing.crop == resolution
    assert (made.expected, made.target_fps) == (None, None)


def test_the_outputs_are_those_of_the_branches() -> None:
    for semantic, names in ((True, ["disparity", "semantic"]), (False, ["disparity"])):
        arch = Arch(c=1, semantic=semantic, refinement=False)
        made = of_arch(arch, load("cpu"), "fp32", "onnxruntime", (96, 64))
        assert [output.name for output in made.outputs] == names
        assert [output.dtype for output in made.outputs] == ["float32", "int32"][: len(names)]
        assert made.postprocessing.classes[:2] == (("road", "sidewalk") if semantic else ())
        assert len(made.postprocessing.classes) == (19 if semantic else 0)


def test_a_file_is_described_by_its_bytes(tmp_path: Path) -> None:
    path = tmp_path / "triton" / "model.onnx"
    path.parent.mkdir()
    path.write_bytes(b"abc")
    told = describe(path, tmp_path)
    assert (told.name, told.size_bytes) == ("triton/model.onnx", 3)
    assert told.sha256 == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("schema", "rts2.deployment/2"),
        ("precision", "fp8"),
        ("runtime", "abacus"),
        ("arch", {"c": 0}),
        ("files", [{"name": "x", "size_bytes": -1, "sha256": "0" * 64}]),
        ("files", [{"name": "../x", "size_bytes": 1, "sha256": "0" * 64}]),
        ("execution", {"runtime": "abacus"}),
        ("layers", [{"layer": "x", "precision": "fp32"}]),
        ("triton", {"repository": "/srv", "name": "x"}),
        ("files", [{"name": "x", "size_bytes": 1, "sha256": "no"}]),
        ("more", 1),
    ],
)
def test_a_wrong_field_is_named(tmp_path: Path, field: str, value: object) -> None:
    made = of_arch(Arch(c=1), load("cpu"), "fp32", "onnxruntime", (96, 64))
    stored = made.model_dump(mode="json", by_alias=True) | {field: value}
    path = tmp_path / "deployment.json"
    path.write_text(json.dumps(stored))
    with pytest.raises(Rts2Error, match=field) as error:
        read(path)
    assert "\n" not in str(error.value)
    with pytest.raises(UsageError, match="no such file"):
        read(tmp_path / "none.json")


def test_a_configuration_never_changes() -> None:
    made = of_arch(Arch(c=1), load("cpu"), "fp32", "onnxruntime", (96, 64))
    assert Deployment.model_validate(made.model_dump(by_alias=True)) == made
    with pytest.raises(ValueError, match="frozen"):
        made.device = "other"  # type: ignore[misc]


def test_the_graph_holds_its_3d_convs_as_the_device_runs_them_fastest() -> None:
    """A profile in which banded 3D convs take no time at all, and none in which they were timed."""
    known = load("cpu")
    calibration = known.calibration("onnxruntime", "fp32")
    assert isinstance(calibration.model, PartModel)
    tables = {
        name: table
        for name, table in calibration.model.tables.items()
        if not name.startswith("banded.")
    }
    timed = tables["regularize.1"]
    free = timed.model_copy(update={"ms": tuple((1e-6,) * len(row) for row in timed.ms)})
    found = []
    for more in ({}, {"banded.1": free}):
        model = calibration.model.model_copy(update={"tables": tables | more})
        faster = calibration.model_copy(update={"model": model})
        profile = known.model_copy(update={"calibrations": (faster,)})
        found.append(of_arch(Arch(c=1), profile, "fp32", "onnxruntime", (1242, 375)).forms)
    assert found == [None, ("3d", "banded", "3d")]
    anynet = of_arch(Arch(family="anynet", c=1), known, "fp32", "onnxruntime", (1242, 375))
    assert anynet.forms is None


def test_the_published_schema_is_the_one_that_is_used() -> None:
    """It is `json_schema()`, indented by 2: write that there where the schema has changed."""
    path = Path(__file__).parents[3] / "docs" / "deployment.schema.json"
    assert json.loads(path.read_text(encoding="utf-8")) == json_schema()


def test_every_field_of_the_schema_is_documented() -> None:
    page = (Path(__file__).parents[3] / "docs" / "deployment.md").read_text(encoding="utf-8")
    told = json_schema()
    assert all(f"`{name}`" in page for name in told["properties"])
    for part in ("Check", "Sample", "LayerPrecision", "Calibration", "Postprocessing"):
        assert all(f"`{name}`" in page for name in told["$defs"][part]["properties"]), part
