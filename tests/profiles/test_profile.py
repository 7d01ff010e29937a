"""Profiles at the door: what is shipped loads, what is broken is refused by the field's name."""

import json
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from rts2.model.errors import Rts2Error, UsageError
from rts2.profiles.latency import LatencyModel
from rts2.profiles.profile import Derivation, load, names

Document = dict[str, Any]
NAN = float("nan")


@pytest.fixture
def document() -> Document:
    """The TX2's profile as JSON values."""
    text = (resources.files("rts2.profiles") / "devices" / "tx2.json").read_text("utf-8")
    found: Document = json.loads(text)
    return found


def written(document: Document, folder: Path) -> str:
    path = folder / "device.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    return str(path)


def test_the_shipped_devices() -> None:
    assert names() == sorted(names())
    assert {"tx2", "rtx2080ti"} <= set(names())
    for name in names():
        assert load(name).name == name


def test_shipped_profiles_say_where_everything_comes_from() -> None:
    for profile in map(load, names()):
        facts = (*profile.hardware, *profile.precisions, *profile.runtimes)
        sourced = (*facts, *profile.calibrations, *profile.derivations, *profile.points)
        assert all(entry.source.strip() for entry in sourced)
        half = {"bf16"} if profile.name == "cpu" else set()
        assert {entry.precision for entry in profile.precisions} == {"fp32", "fp16", "int8"} | half
        known = {entry.runtime for entry in profile.runtimes}
        assert {entry.runtime for entry in (*profile.calibrations, *profile.derivations)} <= known


def test_the_tx2_refuses_int8_and_says_what_instead() -> None:
    refusal = load("tx2").refusal("int8")
    assert refusal is not None
    assert "DP4A" in refusal.reason
    assert "fp16" in refusal.reason
    assert load("tx2").refusal("fp32") is None
    assert load("rtx2080ti").refusal("int8") is None


def test_a_precision_that_a_profile_does_not_list_is_refused(
    document: Document, tmp_path: Path
) -> None:
    del document["precisions"][2]
    refusal = load(written(document, tmp_path)).refusal("int8")
    assert refusal is not None
    assert refusal.reason == "the profile does not list it"


def test_a_profile_given_as_a_file_equals_the_shipped_one(
    document: Document, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert load(written(document, tmp_path)) == load("tx2")
    monkeypatch.chdir(tmp_path)
    assert load("device.json") == load("./device.json") == load("tx2")


def test_a_profile_survives_being_written(tmp_path: Path) -> None:
    for profile in map(load, names()):
        again = written(profile.model_dump(mode="json", by_alias=True), tmp_path)
        assert load(again) == profile


@pytest.mark.parametrize("device", ["tx1", "", "TX2", "tx2 ", "tx2.jsonl"])
def test_an_unknown_device_lists_the_known_ones(device: str) -> None:
    with pytest.raises(UsageError) as refusal:
        load(device)
    assert repr(device) in str(refusal.value)
    assert all(name in str(refusal.value) for name in names())


@pytest.mark.parametrize("device", ["nowhere.json", "tx2.json", "folder/tx2", "./tx2", "/"])
def test_a_path_to_nothing_is_named(
    device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        UsageError, match=r"must be a file: .*(no such file|is a folder)"
    ) as refusal:
        load(device)
    assert str(Path(device)) in str(refusal.value)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "nonsense", '{"a": 1} {"b": 2}', "\x00"])
def test_what_is_no_json_object_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "broken.json"
    path.write_text(text)
    with pytest.raises(Rts2Error, match="the document") as refusal:
        load(str(path))
    assert str(path) in str(refusal.value)
    assert refusal.value.exit_code == 1


@pytest.mark.parametrize("data", [b"\xff\xfe{}", b"\x80\x04\x95"])
def test_what_is_no_text_is_refused(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "binary.json"
    path.write_bytes(data)
    with pytest.raises(Rts2Error, match="cannot be read"):
        load(str(path))


def test_another_documents_json_names_what_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "front.json"
    path.write_text('{"schema": "rts2.search/1", "device": "tx2"}')
    with pytest.raises(Rts2Error, match=r"schema: .*'rts2\.profile/1'"):
        load(str(path))


def _set(*path: str | int, to: object) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        at: Any = document
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = to

    return change


def _drop(*path: str | int) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        at: Any = document
        for key in path[:-1]:
            at = at[key]
        del at[path[-1]]

    return change


def _repeat(*path: str | int) -> Callable[[Document], None]:
    """Appends an entry of a list once more."""

    def change(document: Document) -> None:
        document[str(path[0])].append(document[str(path[0])][path[1]])

    return change


MODEL = ("calibrations", 0, "model")
BROKEN: dict[str, tuple[Callable[[Document], None], str]] = {
    "wrong schema": (_set("schema", to="rts2.profile/2"), "schema"),
    "no schema": (_drop("schema"), "schema"),
    "name with spaces": (_set("name", to="Jetson TX2"), "name"),
    "missing title": (_drop("title"), "title"),
    "extra field": (_set("colour", to="green"), "colour"),
    "extra field inside": (_set(*MODEL, "slope", to=1.0), "calibrations.0.model.steps.slope"),
    "fact without source": (_drop("hardware", 0, "source"), "hardware.0.source"),
    "no calibrations": (_set("calibrations", to=[]), "calibrations"),
    "negative start": (_set(*MODEL, "start_ms", to=-0.1), "calibrations.0.model.steps.start_ms"),
    "negative coefficient": (
        _set(*MODEL, "ms_per", "gbyte", to=-1),
        "calibrations.0.model.steps.ms_per.gbyte",
    ),
    "NaN coefficient": (
        _set(*MODEL, "ms_per", "gmac_2d", to=NAN),
        "calibrations.0.model.steps.ms_per.gmac_2d",
    ),
    "infinite coefficient": (_set(*MODEL, "start_ms", to=float("inf")), "start_ms"),
    "coefficient beyond any device": (_set(*MODEL, "start_ms", to=1e308), "start_ms"),
    "unknown feature": (_set(*MODEL, "ms_per", "gmac_4d", to=1.0), "gmac_4d is no feature"),
    "unknown combination": (_set(*MODEL, "combine", to="product"), "model.steps.combine"),
    "unknown folded kind": (_set(*MODEL, "folded", to=["nrom"]), "model.steps.folded.0"),
    "unknown precision": (_set("precisions", 0, "precision", to="int4"), "precisions.0.precision"),
    "unknown runtime": (_set("runtimes", 1, "runtime", to="tflite"), "runtimes.1.runtime"),
    "opset of the future": (_set("runtimes", 1, "opset", to=99), "runtimes.1.opset"),
    "one residual too few": (_drop("calibrations", 0, "residuals", 0), "14 residuals"),
    "one point too few": (_drop("points", 0), "14 points and 15 residuals"),
    "NaN residual": (_set("calibrations", 0, "residuals", 3, to=NAN), "calibrations.0.residuals.3"),
    "infinite residual": (
        _set("calibrations", 0, "residuals", 0, to=float("inf")),
        "calibrations.0.residuals.0",
    ),
    "residual of e to the 900": (
        _set("calibrations", 0, "residuals", 0, to=900.0),
        "calibrations.0.residuals.0",
    ),
    "derivation on nothing": (
        _set("derivations", 0, "base", to=["openvino", "fp32"]),
        "pytorch fp16 derives from no calibration",
    ),
    "derivation of what is calibrated": (
        _set("derivations", 0, "precision", to="fp32"),
        "pytorch fp32",
    ),
    "derivation twice": (_repeat("derivations", 2), "tensorrt fp16"),
    "calibration twice": (_repeat("calibrations", 0), "pytorch fp32"),
    "precision told twice": (_repeat("precisions", 0), "fp32"),
    "factor on nothing": (
        _set("derivations", 0, "factors", "gmacs", to=0.5),
        "gmacs is no coefficient",
    ),
    "factor of zero": (
        _set("derivations", 0, "factors", "gbyte", to=0),
        "derivations.0.factors.gbyte",
    ),
    "fps of zero": (_set("points", 0, "fps", to=0), "points.0.fps"),
    "NaN fps": (_set("points", 0, "fps", to=NAN), "points.0.fps"),
    "evidence of another kind": (
        _set("points", 0, "evidence", to="interpolated"),
        "points.0.evidence",
    ),
    "resolution of one side": (_set("points", 0, "resolution", to=[1242]), "points.0.resolution"),
    "resolution too small": (_set("points", 0, "resolution", 1, to=8), "points.0.resolution.1"),
    "arch without a width": (_set("points", 0, "arch", "conv3d", to=[16, 4]), "points.0.arch"),
    "arch with refinement alone": (
        _set("points", 0, "arch", "refinement", to=True),
        "points.0.arch",
    ),
    "machine without threads": (
        _set("machine", to={"processor": "x", "system": "y", "versions": {}, "date": "z"}),
        "machine.threads",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_profile_names_the_field(name: str, document: Document, tmp_path: Path) -> None:
    breaking, field = BROKEN[name]
    breaking(document)
    path = written(document, tmp_path)
    with pytest.raises(Rts2Error) as refusal:
        load(path)
    message = str(refusal.value)
    assert field in message
    assert message.startswith(f"a device profile {path}: ")
    assert "\n" not in message
    assert refusal.value.exit_code == 1


def test_a_model_that_costs_nothing_is_refused(document: Document, tmp_path: Path) -> None:
    """No network takes no time: such a profile would promise infinite frame rates."""
    document["calibrations"][0]["model"].update(start_ms=0, ms_per={"gmac_2d": 0})
    with pytest.raises(Rts2Error, match="calibrations"):
        load(written(document, tmp_path))


def test_points_and_calibrations_are_found_by_runtime_and_precision() -> None:
    profile = load("tx2")
    assert profile.points_of("pytorch", "fp32") == profile.points
    assert profile.points_of("tensorrt", "fp16") == ()
    assert profile.calibration("pytorch", "fp32") is profile.calibrations[0]
    with pytest.raises(UsageError, match=r"not calibrated for fp16 on tensorrt.*fp32 on pytorch"):
        profile.calibration("tensorrt", "fp16")


def test_a_derivation_scales_by_name_and_folds() -> None:
    model = LatencyModel(
        combine="sum",
        starts="kernels",
        folded=("relu",),
        start_ms=0.5,
        ms_per={"gmac_2d": 4.0, "gbyte": 40.0},
    )
    scaled = Derivation(
        runtime="tensorrt",
        precision="fp16",
        base=("pytorch", "fp32"),
        factors={"start": 0.1, "gmac_2d": 0.25, "gmac_3d": 0.25},
        folded=("norm", "relu"),
        source="by hand",
    ).scale(model)
    assert scaled.start_ms == pytest.approx(0.05)
    assert scaled.ms_per == {"gmac_2d": 1.0, "gbyte": 40.0}
    assert set(scaled.folded) == {"norm", "relu"}
    assert (scaled.combine, scaled.starts) == ("sum", "kernels")


@pytest.mark.parametrize("device", ["tx2", "rtx2080ti"])
def test_shipped_factors_scale_what_the_base_has(device: str) -> None:
    """A factor on a coefficient that the base lacks would say something and do nothing."""
    profile = load(device)
    for derived in profile.derivations:
        model = profile.calibration(*derived.base).model
        assert set(derived.factors) <= {"start", *model.ms_per}


def test_profiles_are_frozen() -> None:
    profile = load("tx2")
    with pytest.raises(ValidationError, match="frozen"):
        profile.title = "another"  # type: ignore[misc]
