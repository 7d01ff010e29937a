"""What every test may use."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from rts2.profiles.profile import Profile, load

from .browser import Browser

# Tests run side by side, one a core; torch reads this when it is first imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real samples that RTS2_DATA names; without it the test is skipped."""
    folder = os.environ.get("RTS2_DATA")
    if not folder:
        pytest.skip("needs real images: set RTS2_DATA to their folder (see CONTRIBUTING.md)")
    path = Path(folder)
    assert path.is_dir(), f"RTS2_DATA names no folder: {path}"
    return path


@pytest.fixture(scope="session")
def ort_alone() -> Profile:
    """The CPU's profile before anyone fitted OpenVINO beside ONNX Runtime."""
    known = load("cpu")
    kept: dict[str, object] = {
        name: tuple(each for each in getattr(known, name) if each.runtime == "onnxruntime")
        for name in ("calibrations", "points", "runtimes")
    }
    timed = {calibration.precision for calibration in known.calibrations}
    own = {each.precision for each in known.calibrations if each.runtime == "onnxruntime"}
    kept["precisions"] = tuple(p for p in known.precisions if p.precision not in timed - own)
    return known.model_copy(update=kept)


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Browser:
    """A browser; without one the test is skipped."""
    found = Browser.found(tmp_path_factory.mktemp("browser"))
    if found is None:
        pytest.skip("needs a browser: install chromium")
    return found


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Graphs that are kept between runs are kept for the tests alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True)
def _one_seed() -> None:
    """Random weights are the same in every run; torch is seeded only where it is in use."""
    import sys

    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)
