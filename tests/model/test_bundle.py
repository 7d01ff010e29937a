"""The graph in a bundle, found by those who know nothing of bundles but that."""

import json
from hashlib import sha256
from pathlib import Path

import pytest

from rts2.model.bundle import CONFIGURATION, MODEL, contents, graph_of
from rts2.model.errors import Rts2Error, UsageError


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    (tmp_path / MODEL).write_bytes(b"graph")
    described = {"name": MODEL, "size_bytes": 5, "sha256": sha256(b"graph").hexdigest()}
    known = {"schema": "rts2.deployment/1", "device": "x", "files": [described]}
    (tmp_path / CONFIGURATION).write_text(json.dumps(known))
    return tmp_path


def test_a_bundle_is_its_graph_and_a_file_is_itself(bundle: Path) -> None:
    assert graph_of(bundle) == bundle / MODEL
    assert graph_of(bundle / MODEL) == bundle / MODEL
    assert graph_of(bundle / "none.onnx") == bundle / "none.onnx"


def test_a_folder_without_configuration_is_no_bundle(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"it is a folder without deployment\.json") as error:
        graph_of(tmp_path)
    assert str(tmp_path) in str(error.value)


def test_a_graph_that_was_changed_is_refused(bundle: Path) -> None:
    (bundle / MODEL).write_bytes(b"other")
    with pytest.raises(Rts2Error, match=r"model\.onnx is not the file .* make the bundle again"):
        graph_of(bundle)


def test_a_bundle_without_its_graph_is_refused(bundle: Path) -> None:
    (bundle / MODEL).unlink()
    with pytest.raises(Rts2Error, match=r"holds no model\.onnx; make the bundle again"):
        graph_of(bundle)


@pytest.mark.parametrize("text", ["", "{}", '{"schema": "rts2.deployment/1", "files": [{}]}'])
def test_a_broken_configuration_is_one_line(bundle: Path, text: str) -> None:
    (bundle / CONFIGURATION).write_text(text)
    with pytest.raises(Rts2Error, match="a deployment configuration") as error:
        graph_of(bundle)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["/etc/passwd", "../x", "a/../../x", "", ".", "a//b", "./a"])
def test_a_file_outside_of_the_bundle_is_refused(bundle: Path, name: str) -> None:
    known = {"schema": "rts2.deployment/1", "files": [{"name": name, "sha256": "0" * 64}]}
    (bundle / CONFIGURATION).write_text(json.dumps(known))
    with pytest.raises(Rts2Error, match=r"files\.0\.name: a file of a bundle must lie"):
        contents(bundle)


def test_what_is_no_bundle_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"it is a folder without"):
        contents(tmp_path)
    with pytest.raises(UsageError, match=r"it is no folder"):
        contents(tmp_path / "none")
