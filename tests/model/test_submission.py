"""A submission is what the servers take, or says what it lacks."""

from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from PIL import Image

from rts2.model.data.labels import LABEL_IDS
from rts2.model.errors import Rts2Error, UsageError
from rts2.model.predictor import Estimate
from rts2.model.submission import FRAMES, finish, new_folder, write_frame

SIZE = (6, 4)


def estimate(disparity: float = 5.0, semantic: bool = True) -> Estimate:
    labels = (np.arange(24, dtype=np.uint8) % 19).reshape(4, 6)
    return Estimate(np.full((4, 6), disparity, np.float32), labels if semantic else None, 0.0, 3)


def stored(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path))


def test_names_are_the_servers() -> None:
    assert (len(FRAMES), FRAMES[0], FRAMES[-1]) == (200, "000000_10", "000199_10")


def test_complete_submission_is_zipped_by_benchmark(tmp_path: Path) -> None:
    folder = new_folder(tmp_path / "new" / "folder")
    for name in FRAMES:
        write_frame(folder, name, estimate())
    parts = finish(folder, dict.fromkeys(FRAMES, SIZE))
    assert [part.told() for part in parts] == [
        "disp_0/ has 200 of 200 frames, checked: stereo.zip",
        "semantic/ has 200 of 200 frames, checked: semantic.zip",
    ]
    for archive, inside in (("stereo.zip", "disp_0"), ("semantic.zip", "semantic")):
        with ZipFile(folder / archive) as opened:
            assert opened.namelist() == [f"{inside}/{name}.png" for name in FRAMES]
            file = f"{inside}/000007_10.png"
            assert opened.read(file) == (folder / file).read_bytes()


def test_files_hold_what_the_servers_read(tmp_path: Path) -> None:
    said = estimate()
    said.disparity[0] = [0.0, -3.0, 0.5, 300.0, np.nan, 2.0]
    write_frame(tmp_path, "000000_10", said)
    disparity = stored(tmp_path / "disp_0" / "000000_10.png")
    assert disparity.dtype == np.uint16
    # Steps of 1/256 px, 1 at least; the hole takes the lesser of its neighbours.
    assert disparity[0].tolist() == [1, 1, 128, 65535, 512, 512]
    semantic = Image.open(tmp_path / "semantic" / "000000_10.png")
    assert semantic.mode == "L"
    assert np.asarray(semantic).ravel()[:19].tolist() == list(LABEL_IDS)


def test_rows_without_any_estimate_stay_dense(tmp_path: Path) -> None:
    said = estimate(semantic=False)
    said.disparity[1:3] = np.nan
    write_frame(tmp_path, "000000_10", said)
    assert stored(tmp_path / "disp_0" / "000000_10.png")[1:3].tolist() == [[1] * 6] * 2
    (part,) = finish(tmp_path, {"000000_10": SIZE})
    assert part.to_json()["folder"] == "disp_0"


def test_incomplete_submission_says_so_and_is_not_zipped(tmp_path: Path) -> None:
    for name in FRAMES[:3]:
        write_frame(tmp_path, name, estimate(semantic=False))
    (part,) = finish(tmp_path, dict.fromkeys(FRAMES, SIZE))
    assert part.told() == (
        "disp_0/ has 3 of 200 frames, incomplete: first missing 000003_10.png; no zip is written"
    )
    assert part.to_json() == {
        "folder": "disp_0",
        "frames": 3,
        "expected": 200,
        "first_missing": "000003_10",
        "zip": None,
    }
    assert [path.name for path in tmp_path.iterdir()] == ["disp_0"]


@pytest.mark.parametrize(
    ("file", "pixels", "words"),
    [
        ("disp_0", np.zeros((4, 6), np.uint16), "24 pixels are 0"),
        ("disp_0", np.ones((4, 6), np.uint8), "must be a 16-bit disparity PNG"),
        ("disp_0", np.ones((4, 5), np.uint16), "it is 5x4"),
        ("semantic", np.zeros((4, 6), np.uint8), "0 is no label id that is scored"),
        ("semantic", np.full((4, 6), 7, np.uint16), "not 8 bits of one channel"),
        ("semantic", np.full((4, 6, 3), 7, np.uint8), "not 8 bits of one channel"),
    ],
)
def test_file_that_the_server_would_refuse(
    tmp_path: Path, file: str, pixels: np.ndarray, words: str
) -> None:
    write_frame(tmp_path, "000000_10", estimate())
    Image.fromarray(pixels).save(tmp_path / file / "000000_10.png")
    with pytest.raises(Rts2Error, match=words):
        finish(tmp_path, {"000000_10": SIZE})


def test_folder_in_use_is_refused(tmp_path: Path) -> None:
    assert new_folder(tmp_path) == tmp_path
    (tmp_path / "disp_0").mkdir()
    with pytest.raises(UsageError, match="holds disp_0; choose another --submission"):
        new_folder(tmp_path)
