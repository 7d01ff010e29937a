"""The README of a bundle: what an integrator reads first."""

from __future__ import annotations

from textwrap import fill
from typing import Final

from ...model.arch import UNTRAINED
from ...profiles.profile import Profile
from .schema import Deployment, TritonModel
from .target import Target

WIDTH: Final = 100


def readme(deployment: Deployment, profile: Profile, target: Target) -> str:
    """The text for a deployment whose files are complete."""
    width, height = deployment.input.resolution
    files = "\n".join(f"| `{name}` | {what} |" for name, what in _files(deployment))
    about = f"{deployment.precision} on {target.title}, images of {width}×{height}."
    weights = f"Weights: {deployment.weights}. {_warning(deployment)}"
    parts = (
        f"# {deployment.arch.label()} for {profile.title}",
        _filled(f"{_promise(deployment)} {about}"),
        _filled(weights),
        f"    {target.next_step}",
        _filled(_next(target)),
        "## In and out",
        _filled(_in_and_out(deployment)),
        _filled(target.notes),
        *_triton(deployment.triton),
        "## Files",
        f"| file | what it is |\n| --- | --- |\n{files}\n",
    )
    return "\n\n".join(parts)


def _filled(text: str) -> str:
    return fill(" ".join(text.split()), WIDTH, break_long_words=False, break_on_hyphens=False)


def _promise(deployment: Deployment) -> str:
    expected = deployment.expected
    if expected is None:
        return "No search promised a frame rate for it."
    text = (
        f"Expected: {expected.fps:.1f} FPS ({expected.fps_low:.1f} to "
        f"{expected.fps_high:.1f} at {expected.confidence:.0%}), {expected.evidence.latency}"
    )
    if expected.runtime != deployment.runtime:
        text += (
            f" for {expected.runtime}; what is built here runs on {deployment.runtime}, "
            "whose speed the check tells"
        )
    return f"{text}."


def _warning(deployment: Deployment) -> str:
    """What the weights do not promise."""
    if deployment.weights == UNTRAINED:
        return "They are random: the frame rate is real, the disparity means nothing."
    expected = deployment.expected
    if expected is None or expected.evidence.accuracy is None:
        return "What accuracy they reach is not known."
    if expected.judged_on is not None:
        return f"Accuracies in `deployment.json` are theirs, judged on {expected.judged_on}."
    return "Accuracies in `deployment.json` are those of the search's source, not of these weights."


def _next(target: Target) -> str:
    first = "" if target.next_step == "python3 verify.py" else "builds the engine, then "
    return f"""{first}checks the hash of every file, runs the two pairs in `samples/`, compares
    disparity and classes with what is expected, and prints the measured frame rate beside the
    promised one. It ends with 0 where all is well."""


def _in_and_out(deployment: Deployment) -> str:
    width, height = deployment.input.resolution
    _, _, rows, columns = deployment.input.shape
    text = f"""`left` and `right` are float32 (1, 3, {rows}, {columns}): RGB bytes times 1/255, less
    the mean and over the deviation that `input` tells, channels first, then zeros at the right and
    at the bottom up to {columns}×{rows}. `disparity` is float32 (1, {rows}, {columns}) in pixels:
    what lies at x in the left image lies at x − disparity in the right one. Of every output the
    top left {width}×{height} counts."""
    if deployment.arch.semantic:
        text += " `semantic` is int32 of the same shape: class ids, named in `postprocessing`."
    return f"{text} `verify.py` has all of that in numpy."


def _triton(known: TritonModel | None) -> tuple[str, ...]:
    if known is None:
        return ()
    place = f"{known.repository}/{known.name}/config.pbtxt"
    return (
        "## Triton",
        f"    tritonserver --model-repository={known.repository}",
        _filled(
            f"serves it as `{known.name}`, one pair a request, one instance; `instance_group` in "
            f"`{place}` sets how many run side by side. Nobody has started a server with it yet."
        ),
    )


def _files(deployment: Deployment) -> list[tuple[str, str]]:
    """The files by what they are for; samples are told once."""
    known = {
        "model.onnx": "the network",
        "model.xml": "the same in OpenVINO's own format, what carries disparities marked as fp32",
        "model.bin": "its weights",
        "deployment.json": "arch, precision of each layer, options of the runtime, what is "
        "expected, and the hash of every file",
        "build.sh": "builds the engine, then calls `verify.py`",
        "verify.py": "checks all of it here; needs Python 3.6 or newer, numpy and the runtime",
    }
    names = {file.name for file in deployment.files} | {"deployment.json"}
    told = [(name, what) for name, what in known.items() if name in names]
    told.append(("samples/*", "two pairs of images, and the answers expected of them"))
    if deployment.triton is not None:
        told.append((f"{deployment.triton.repository}/*", "a model repository for Triton"))
    return told
