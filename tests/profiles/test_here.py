"""What the machine at hand is, and in what it is not a profile's."""

import platform
import subprocess
import sys
from datetime import date
from importlib.metadata import PackageNotFoundError
from typing import Any

import pytest

from rts2.profiles import here
from rts2.profiles.here import differences, this_machine
from rts2.profiles.profile import Machine


def test_the_machine_tells_what_a_timing_depends_on() -> None:
    import onnxruntime

    found = this_machine("onnxruntime", 3)
    assert found.threads == 3
    assert found.processor
    assert found.versions["onnxruntime"] == onnxruntime.__version__
    assert date.fromisoformat(found.date) <= date.today()
    assert found.versions.keys() == {"rts2", "python", "onnxruntime"}


@pytest.mark.parametrize("runtime", ["onnxruntime", "pytorch"])
def test_a_machine_does_not_differ_from_itself(runtime: str) -> None:
    assert differences(this_machine(runtime, 3), 3) == []


def machine(**others: Any) -> Machine:
    return this_machine("onnxruntime", 2).model_copy(update=others)


def test_each_difference_is_named_with_both_values() -> None:
    own = this_machine("onnxruntime", 2)
    changed = machine(
        processor="Pentium",
        versions={**own.versions, "onnxruntime": "0.1", "python": "3.0"},
    )
    assert differences(changed, 4) == [
        f"the profile is of Pentium; this is {own.processor}",
        "the profile is for 2 threads, not 4",
        f"the profile was fitted with onnxruntime 0.1, not {own.versions['onnxruntime']}",
        f"the profile was fitted with python 3.0, not {platform.python_version()}",
    ]


def test_a_package_that_is_gone_is_told_and_what_is_none_is_not_compared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def gone(name: str) -> str:
        raise PackageNotFoundError(name)

    versions = {"openvino": "2024.6", "cuda": "12.8", "gpu": "a large one"}
    before = machine(versions=versions)
    monkeypatch.setattr(here, "version", gone)
    assert differences(before, 2) == [
        "the profile was fitted with openvino 2024.6, which is not installed"
    ]


def test_the_label_of_a_build_is_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(here, "version", lambda _: "2.13.0")
    assert differences(machine(versions={"torch": "2.13.0+cpu"}), 2) == []
    assert differences(machine(versions={"torch": "2.12.1+cpu"}), 2) == [
        "the profile was fitted with torch 2.12.1+cpu, not 2.13.0"
    ]


def test_no_runtime_is_imported_to_compare() -> None:
    code = (
        "import sys; from rts2.profiles.here import differences;"
        "from rts2.profiles.profile import Machine;"
        "versions = dict.fromkeys(('onnxruntime', 'openvino', 'torch'), '0');"
        "told = differences(Machine(processor='x', threads=1, system='s', versions=versions,"
        " date='2026-01-01'), 1);"
        "assert len(told) == 4, told;"
        "sys.exit(str([n for n in (*versions, 'onnx', 'scipy') if n in sys.modules]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.stderr.strip() == "[]"
