"""rts2-search as a person or a script meets it: what it prints, what it writes, how it refuses."""

import csv
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from rts2.model.arch import Arch
from rts2.model.files import write_json
from rts2.profiles.latency import predict_ms
from rts2.profiles.profile import Profile, names
from rts2.search.cli import search
from rts2.search.result import read
from rts2.search.space import Space

TX2 = ("--device", "tx2", "--target-fps", "10")
FILES = {"front.json", "front.csv", "front.png", "report.html", "deployment.json"}


class Run:
    """What one run of the command left behind."""

    def __init__(self, code: int, out: str, err: str, folder: Path) -> None:
        self.code, self.out, self.err, self.folder = code, out, err, folder

    @property
    def json(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.out)
        return found

    @property
    def files(self) -> set[str]:
        if not self.folder.is_dir():
            return set()
        return {str(path.relative_to(self.folder)) for path in self.folder.rglob("*")}


Command = Callable[..., Run]


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs the command in this process with `--out` set to a fresh folder."""

    def command(*arguments: str, out: Path | None = None) -> Run:
        folder = out or tmp_path / "out"
        code = search([*arguments, "--out", str(folder)])
        printed = capsys.readouterr()
        return Run(code, printed.out, printed.err, folder)

    return command


def one_line(text: str) -> bool:
    return text.count("\n") == 1 and text.endswith("\n") and "Traceback" not in text


def test_the_json_has_the_keys_of_the_contract_and_no_others(run: Command) -> None:
    found = run(*TX2, "--json").json
    assert list(found) == [
        "schema",
        "device",
        "target_fps",
        "resolution",
        "task",
        "objective",
        "confidence",
        "space",
        "front",
        "selected",
        "prospect",
        "nearest",
        "left_out",
        "elapsed_s",
    ]
    assert found["schema"] == "rts2.search/1"
    assert found["device"] == "tx2"
    assert found["target_fps"] == 10.0
    assert found["resolution"] == [1242, 375]
    assert found["task"] == "semantic-stereo"
    assert found["space"] == {"size": 1_882_368, "evaluated": 1_882_368, "exhaustive": True}
    assert found["nearest"] is None
    assert found["elapsed_s"] > 0
    for point in (*found["front"], found["selected"], found["prospect"]):
        over = point["evidence"]["accuracy"] == "extrapolated" and "ranges" in point
        assert point.keys() - ({"ranges"} if over else set()) == {
            "arch",
            "precision",
            "runtime",
            "latency_ms",
            "fps",
            "fps_low",
            "fps_high",
            "d1_all",
            "epe",
            "miou",
            "pacc",
            "params",
            "size_bytes",
            "macs",
            "evidence",
        }
        assert point["arch"].keys() == {
            "family",
            "c",
            "stages",
            "d_max",
            "conv3d",
            "semantic",
            "refinement",
            "classes",
        }
        assert len(point["arch"]["conv3d"]) == point["arch"]["stages"]
        assert point["evidence"].keys() == {"latency", "accuracy"}
    assert all(entry.keys() == {"reason", "count"} for entry in found["left_out"])
    assert found["selected"] in found["front"]
    assert found["prospect"] in found["front"]
    rates = [point["fps"] for point in found["front"]]
    assert rates == sorted(rates, reverse=True)


def test_json_is_one_object_on_stdout_and_stderr_is_silent(run: Command) -> None:
    done = run(*TX2, "--json")
    assert done.code == 0
    assert done.err == ""
    assert done.out.count("\n") == 1
    assert done.out.startswith('{"schema"')
    assert json.loads((done.folder / "front.json").read_text()) == done.json


def test_without_json_there_is_a_table(run: Command) -> None:
    done = run(*TX2)
    assert done.code == 0
    assert done.err == ""
    assert "Jetson TX2" in done.out
    assert sum("▶" in line for line in done.out.splitlines()) == 1
    assert all(name in done.out for name in FILES)
    assert f"--front{done.folder}/front.json--prospect" in "".join(done.out.split())


def test_the_files_agree_with_one_another(run: Command) -> None:
    done = run(*TX2, "--json")
    assert done.files == FILES
    found = done.json
    stored = read(done.folder / "front.json")
    assert stored.model_dump(mode="json", by_alias=True) == found
    with (done.folder / "front.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [float(line["fps"]) for line in lines] == [point["fps"] for point in found["front"]]
    (picked,) = (line for line in lines if line["selected"] == "True")
    assert float(picked["latency_ms"]) == found["selected"]["latency_ms"]
    deployment = json.loads((done.folder / "deployment.json").read_text())
    for key in ("arch", "precision", "runtime"):
        assert deployment[key] == found["selected"][key]
    assert deployment["device"] == "tx2"
    assert deployment["target_fps"] == 10.0
    assert deployment["expected"]["fps"] == found["selected"]["fps"]
    assert deployment["input"]["shape"] == [1, 3, 384, 1248]
    shown = (done.folder / "report.html").read_text("utf-8")
    assert f"{found['selected']['fps']:.1f} <small>FPS" in shown
    with Image.open(done.folder / "front.png") as picture:
        picture.verify()
        assert picture.width > 500


def test_the_same_question_has_the_same_answer(run: Command, tmp_path: Path) -> None:
    first, second = (run(*TX2, "--json", out=tmp_path / name).json for name in ("a", "b"))
    assert {**first, "elapsed_s": 0} == {**second, "elapsed_s": 0}


def test_an_impossible_target_ends_with_3_and_names_the_nearest(run: Command) -> None:
    done = run("--device", "tx2", "--target-fps", "1000", "--json")
    assert done.code == 3
    nearest = done.json["nearest"]
    assert (done.json["selected"], done.json["prospect"]) == (None, None)
    assert one_line(done.err)
    assert "1000 FPS on Jetson TX2" in done.err
    assert f"{nearest['fps']:.1f} FPS" in done.err
    assert f"c={nearest['arch']['c']}" in done.err
    assert done.files == FILES - {"deployment.json"}


def test_a_target_that_only_a_promise_meets_names_the_way_to_take_it(run: Command) -> None:
    done = run("--device", "tx2", "--target-fps", "40")
    assert done.code == 3
    assert one_line(done.err)
    assert "--allow-extrapolated" in done.err
    taken = run("--device", "tx2", "--target-fps", "40", "--allow-extrapolated", "--json")
    assert taken.code == 0
    assert taken.json["selected"]["fps"] >= 40


def test_a_pick_of_yesterday_does_not_outlive_todays_search(run: Command) -> None:
    assert "deployment.json" in run(*TX2).files
    again = run("--device", "tx2", "--target-fps", "1000")
    assert again.files == FILES - {"deployment.json"}
    assert json.loads((again.folder / "front.json").read_text())["target_fps"] == 1000


def test_nothing_left_ends_with_3(run: Command) -> None:
    """A metre ahead with KITTI's cameras: 721 px · 0.54 m / 1 m = 389 px, and 24 planes see 384."""
    done = run(*TX2, "--min-depth", "1", "--focal", "721", "--baseline", "0.54", "--json")
    assert done.code == 3
    assert one_line(done.err)
    assert done.json["front"] == []
    assert any("d_max cannot see 389 px" in entry["reason"] for entry in done.json["left_out"])


def test_options_reach_the_search(run: Command) -> None:
    found = run(
        *TX2[:2],
        *("--target-fps", "5"),
        *("--task", "stereo"),
        *("--objective", "epe"),
        *("--confidence", "0.8"),
        *("--precision", "fp32"),
        *("--runtime", "pytorch"),
        *("--max-size-mb", "1.5"),
        *("--resolution", "1248x384"),
        *("--min-depth", "3", "--focal", "721", "--baseline", "0.54"),
        "--json",
    ).json
    assert found["target_fps"] == 5.0
    assert found["resolution"] == [1248, 384]
    assert (found["task"], found["objective"], found["confidence"]) == ("stereo", "epe", 0.8)
    assert found["space"]["size"] == 470_592
    assert {(p["precision"], p["runtime"]) for p in found["front"]} == {("fp32", "pytorch")}
    assert max(point["size_bytes"] for point in found["front"]) <= 1_500_000
    assert min(point["arch"]["d_max"] for point in found["front"]) >= 9  # 129.8 px
    assert found["selected"]["fps_low"] >= 5


def test_a_profile_file_and_an_accuracy_file_are_taken(run: Command, tmp_path: Path) -> None:
    profile = shipped()
    profile["name"], profile["title"] = "mine", "My [red]box [/b] $5^$"
    accuracy = {"schema": "rts2.accuracy/1", "rows": [{"arch": {"c": 4}, "d1_all": 3.5}]}
    device, table = tmp_path / "mine.json", tmp_path / "accuracy.json"
    device.write_text(json.dumps(profile))
    table.write_text(json.dumps(accuracy))
    arguments = ("--device", str(device), "--target-fps", "7", "--accuracy", str(table))
    found = run(*arguments, "--json").json
    assert found["device"] == "mine"
    assert found["selected"]["d1_all"] == 3.5
    assert found["selected"]["evidence"] == {"latency": "published", "accuracy": "measured"}
    assert profile["title"] in run(*arguments).out


def written(profile: Profile, path: Path) -> str:
    write_json(path, profile.model_dump(mode="json", by_alias=True, exclude_none=True))
    return str(path)


def test_a_profile_by_parts_is_searched_as_its_tables_say(
    run: Command, by_parts: Profile, tmp_path: Path
) -> None:
    """At a size that was timed, between the two sizes, and outside of them."""
    device = written(by_parts, tmp_path / "made-up.json")
    model = by_parts.calibrations[0].model
    timed = {(p.arch, p.resolution): p.latency_ms for p in by_parts.points}
    kinds = {
        (1242, 375): {"measured", "interpolated"},
        (960, 288): {"interpolated"},
        (320, 96): {"extrapolated"},
    }
    for (width, height), told in kinds.items():
        asked = ("--device", device, "--target-fps", "40", "--resolution", f"{width}x{height}")
        found = run(*asked, "--allow-extrapolated", "--json").json
        assert found["space"]["size"] == Space().size()
        assert {point["evidence"]["latency"] for point in found["front"]} == told
        assert found["selected"]["fps"] >= 40
        for point in found["front"]:
            arch = Arch.model_validate(point["arch"])
            predicted = predict_ms(model, arch, (width, height))
            expected = timed.get((arch, (width, height)), predicted)
            assert point["latency_ms"] == pytest.approx(expected, rel=1e-9)
            assert point["fps_low"] < point["fps"] < point["fps_high"]


def test_a_profile_of_this_machine_is_searched_in_silence(
    run: Command, by_parts: Profile, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    done = run("--device", written(by_parts, tmp_path / "x.json"), "--target-fps", "40", "--json")
    assert (done.code, done.err, caplog.text) == (0, "", "")


def test_a_profile_of_another_machine_is_searched_with_what_differs(
    by_parts: Profile, tmp_path: Path
) -> None:
    """On stderr alone, and without loading the runtime whose version it tells."""
    own = by_parts.machine
    assert own is not None
    machine = own.model_copy(
        update={
            "processor": "[red] Pentium",
            "threads": own.threads + 7,
            "versions": {**own.versions, "onnxruntime": "0.1"},
        }
    )
    other = by_parts.model_copy(update={"machine": machine})
    device = written(other, tmp_path / "x.json")
    asked = ["--device", device, "--target-fps", "40", "--json", "--out", str(tmp_path / "out")]
    done = in_a_fresh_process(LIGHT, asked)
    assert done.returncode == 0
    assert json.loads(done.stdout)["selected"]["fps"] >= 40
    processor, threads, version, remedy = done.stderr.splitlines()
    assert processor == f"note: the profile is of [red] Pentium; this is {own.processor}"
    assert threads == f"note: the profile is for {own.threads + 7} threads, not {own.threads}"
    now = own.versions["onnxruntime"]
    assert version == f"note: the profile was fitted with onnxruntime 0.1, not {now}"
    assert remedy.startswith(f"note: rts2-profile fit --device {device} --out ")


def test_a_pick_in_a_runtime_that_is_missing_names_what_brings_it(
    two_runtimes: Profile,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In bf16 OpenVINO is the fastest throughout."""
    from rts2.profiles.runtimes import ov
    from rts2.search import cli

    device = written(two_runtimes, tmp_path / "x.json")
    asked = ["--device", device, "--target-fps", "40", "--json", "--out", str(tmp_path / "out")]
    said = (
        "note: the pick needs what is missing here: OpenVINO is not installed; "
        "pip install 'rts2[openvino]' brings it; --runtime onnxruntime searches without"
    )
    for missing in (False, True):
        monkeypatch.setattr(ov, "find_spec", lambda _, gone=missing: None if gone else object())
        monkeypatch.setattr(
            cli,
            "installed",
            lambda name, gone=missing: "none" if gone and name == "openvino" else "1",
        )
        caplog.clear()
        assert search([*asked, "--runtime", "onnxruntime"]) == 0
        capsys.readouterr()
        assert said not in caplog.text
        assert search(asked) == 0
        assert json.loads(capsys.readouterr().out)["selected"]["runtime"] == "openvino"
        assert (said in caplog.text) is missing


def shipped() -> dict[str, Any]:
    text = (resources.files("rts2.profiles") / "devices" / "tx2.json").read_text("utf-8")
    found: dict[str, Any] = json.loads(text)
    return found


def test_help_shows_an_example_and_the_devices(capsys: pytest.CaptureFixture[str]) -> None:
    assert search(["--help"]) == 0
    printed = capsys.readouterr()
    assert "rts2-search --device tx2 --target-fps 10" in printed.out
    assert all(name in printed.out for name in names())
    assert printed.err == ""


WRONG_USE: dict[str, tuple[tuple[str, ...], str]] = {
    "unknown device": (("--device", "tx1", "--target-fps", "10"), "known are cpu, rtx2080ti, tx2"),
    "no device": (("--target-fps", "10"), "--device"),
    "missing profile": (("--device", "nowhere.json", "--target-fps", "10"), "nowhere.json"),
    "no target": (("--device", "tx2"), "--target-fps"),
    "target 0": (("--device", "tx2", "--target-fps", "0"), "--target-fps"),
    "target -1": (("--device", "tx2", "--target-fps", "-1"), "--target-fps"),
    "target nan": (("--device", "tx2", "--target-fps", "nan"), "--target-fps"),
    "target inf": (("--device", "tx2", "--target-fps", "inf"), "--target-fps"),
    "target -inf": (("--device", "tx2", "--target-fps=-inf"), "--target-fps"),
    "target abc": (("--device", "tx2", "--target-fps", "abc"), "'abc'"),
    "target empty": (("--device", "tx2", "--target-fps", ""), "--target-fps"),
    "resolution 0x0": ((*TX2, "--resolution", "0x0"), "'0x0'"),
    "resolution 12": ((*TX2, "--resolution", "12"), "'12'"),
    "resolution with a star": ((*TX2, "--resolution", "1242*375"), "1242x375"),
    "resolution with three sides": ((*TX2, "--resolution", "1242x375x3"), "--resolution"),
    "resolution negative": ((*TX2, "--resolution=-1242x375"), "--resolution"),
    "resolution of another planet": ((*TX2, "--resolution", "99999x99999"), "16384"),
    "resolution with other digits": ((*TX2, "--resolution", "١٢٤٢x٣٧٥"), "--resolution"),
    "confidence 1": ((*TX2, "--confidence", "1"), "--confidence"),
    "confidence 0": ((*TX2, "--confidence", "0"), "--confidence"),
    "confidence 90": ((*TX2, "--confidence", "90"), "below 1"),
    "more confidence than points": ((*TX2, "--confidence", "0.95"), "15 calibration points"),
    "only --focal": ((*TX2, "--focal", "721"), "--min-depth, --focal and --baseline"),
    "no --baseline": ((*TX2, "--focal", "721", "--min-depth", "2"), "--baseline"),
    "depth 0": ((*TX2, "--min-depth", "0"), "--min-depth"),
    "size 0": ((*TX2, "--max-size-mb", "0"), "--max-size-mb"),
    "int8 on a tx2": ((*TX2, "--precision", "int8"), "DP4A"),
    "unknown precision": ((*TX2, "--precision", "int4"), "'int4'"),
    "a runtime that it lacks": ((*TX2, "--runtime", "openvino"), "fp32 on pytorch"),
    "unknown task": ((*TX2, "--task", "mono"), "'mono'"),
    "unknown objective": ((*TX2, "--objective", "pacc"), "'pacc'"),
    "missing accuracies": ((*TX2, "--accuracy", "nowhere.json"), "nowhere.json"),
    "unknown option": ((*TX2, "--fast"), "--fast"),
    "an abbreviation": (("--dev", "tx2", "--target-fps", "10"), "--device"),
    "a loose word": ((*TX2, "please"), "please"),
}


@pytest.mark.parametrize("name", WRONG_USE)
@pytest.mark.parametrize("as_json", [False, True])
def test_wrong_use_is_one_line_and_2(name: str, as_json: bool, run: Command) -> None:
    arguments, told = WRONG_USE[name]
    done = run(*arguments, *(["--json"] if as_json else []))
    assert done.code == 2
    assert done.out == ""
    assert one_line(done.err)
    assert told in done.err
    assert done.files == set()


def _broken(change: Callable[[dict[str, Any]], object]) -> str:
    profile = shipped()
    change(profile)
    return json.dumps(profile)


BROKEN: dict[str, tuple[str, str]] = {
    "empty": ("", "the document"),
    "cut in half": (_broken(lambda _: None)[:2000], "the document"),
    "another document": ('{"schema": "rts2.search/1"}', "schema"),
    "a field missing": (_broken(lambda p: p.pop("points")), "points"),
    "a residual that is no number": (
        _broken(lambda p: p["calibrations"][0]["residuals"].__setitem__(0, float("nan"))),
        "residuals",
    ),
    "a residual beyond measure": (
        _broken(lambda p: p["calibrations"][0]["residuals"].__setitem__(0, 900.0)),
        "residuals",
    ),
    "a model of zeros": (
        _broken(lambda p: p["calibrations"][0]["model"].update(start_ms=0, ms_per={})),
        "calibrations",
    ),
    "a model beyond measure": (
        _broken(lambda p: p["calibrations"][0]["model"].update(start_ms=1e308)),
        "start_ms",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_profile_is_one_line_and_1(name: str, run: Command, tmp_path: Path) -> None:
    text, told = BROKEN[name]
    path = tmp_path / "broken.json"
    path.write_text(text)
    done = run("--device", str(path), "--target-fps", "10", "--json")
    assert done.code == 1
    assert done.out == ""
    assert one_line(done.err)
    assert told in done.err
    assert str(path) in done.err
    assert done.files == set()


def test_broken_accuracies_are_one_line_and_1(run: Command, tmp_path: Path) -> None:
    path = tmp_path / "accuracy.json"
    path.write_text('{"schema": "rts2.accuracy/1", "rows": [{"arch": {}, "d1_all": -1}]}')
    done = run(*TX2, "--accuracy", str(path))
    assert (done.code, done.out, done.files) == (1, "", set())
    assert one_line(done.err)
    assert "rows.0.d1_all" in done.err


@pytest.mark.parametrize("place", ["taken", "taken/inside"])
def test_a_file_in_the_place_of_the_folder_is_one_line_and_1(
    place: str, run: Command, tmp_path: Path
) -> None:
    (tmp_path / "taken").write_text("precious")
    done = run(*TX2, "--json", out=tmp_path / place)
    assert done.code == 1
    assert done.out == ""
    assert one_line(done.err)
    assert "cannot write" in done.err
    assert "--out" in done.err
    assert (tmp_path / "taken").read_text() == "precious"


@pytest.mark.parametrize("name", sorted(FILES))
def test_a_folder_in_the_place_of_a_file_leaves_nothing_half_written(
    name: str, run: Command, tmp_path: Path
) -> None:
    (tmp_path / "out" / name).mkdir(parents=True)
    for target in ("10", "1000"):
        done = run("--device", "tx2", "--target-fps", target, "--json")
        assert done.code == 1
        assert one_line(done.err)
        assert done.files <= FILES
        for other in done.files - {name}:
            assert (done.folder / other).stat().st_size > 1000


def in_a_fresh_process(code: str, arguments: Sequence[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code, *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


HEAVY = ("torch", "onnx", "onnxruntime", "optuna", "scipy", "pandas", "sklearn")


LIGHT = (
    "import sys; from rts2.search.cli import search; code = search();"
    f"loaded = [name for name in {HEAVY} if name in sys.modules];"
    "sys.exit(f'loaded: {loaded}' if loaded else code)"
)


def test_a_whole_search_loads_no_heavy_library_and_says_nothing_else(tmp_path: Path) -> None:
    """The main command answers at once because it never waits for what it does not use."""
    done = in_a_fresh_process(LIGHT, [*TX2, "--json", "--out", str(tmp_path / "out")])
    assert done.stderr == ""
    assert done.returncode == 0
    assert json.loads(done.stdout)["selected"]["d1_all"] <= 4.70
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


def test_importing_the_command_loads_no_library_of_pictures_either() -> None:
    wanted = (*HEAVY, "matplotlib", "PIL", "jinja2", "plotly")
    code = (
        "import sys, rts2.search.cli;"
        f"sys.exit(str([name for name in {wanted} if name in sys.modules]))"
    )
    done = in_a_fresh_process(code, [])
    assert done.stderr.strip() == "[]"


def test_wrong_use_in_a_fresh_process() -> None:
    code = "import sys; from rts2.search.cli import search; sys.exit(search())"
    done = in_a_fresh_process(code, ["--device", "tx1", "--target-fps", "10"])
    assert (done.returncode, done.stdout) == (2, "")
    assert one_line(done.stderr)
