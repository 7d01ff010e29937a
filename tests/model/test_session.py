"""A session: one file, as many stages as fit, and no call that harms the next."""

import json
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from rts2.model.arch import Arch
from rts2.model.checkpoint import Network, build, load, save
from rts2.model.data.images import read_rgb
from rts2.model.errors import Rts2Error, UsageError
from rts2.model.export import export
from rts2.model.files import sha256
from rts2.model.graph import header_of, load_graph, save_graph
from rts2.model.predictor import TorchPredictor
from rts2.model.session import OPEN, REMEMBERED, Sessions, StereoSession, Times

Lively = Callable[[Network], Network]

RESOLUTION = (70, 50)
ARCH = Arch(c=1, d_max=4)


def pair(seed: int = 0, size: tuple[int, int] = RESOLUTION) -> tuple[np.ndarray, np.ndarray]:
    shape = (2, size[1], size[0], 3)
    images = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    return images[0], images[1]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A graph of three stages, with its checkpoint beside it."""
    folder = tmp_path_factory.mktemp("session")
    network = build(ARCH)
    save(network, folder / "a.safetensors", "a test")
    export(network, folder / "a.onnx", RESOLUTION, "a test")
    return folder / "a.onnx"


@pytest.fixture
def session(model: Path) -> StereoSession:
    return StereoSession(model)


def plant(session: StereoSession, *expected_ms: float) -> None:
    """Makes a session expect calls to take so long, stage by stage."""
    session._times = [Times() for _ in expected_ms]
    for times, ms in zip(session._times, expected_ms, strict=True):
        times.add(ms)


def nameless(path: Path) -> Path:
    """An ONNX file of another tool: the disparity is left less right, summed over the colours."""
    shapes = {"left": [1, 3, 64, 96], "right": [1, 3, 64, 96], "disparity": [1, 64, 96]}
    values = [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in shapes.items()]
    nodes = [
        helper.make_node("Sub", ["left", "right"], ["difference"]),
        helper.make_node("ReduceSum", ["difference", "axes"], ["disparity"], keepdims=0),
    ]
    axes = helper.make_tensor("axes", TensorProto.INT64, [1], [1])
    body = helper.make_graph(nodes, "g", values[:2], values[2:], [axes])
    opset = [helper.make_opsetid("", 13)]
    onnx.save(helper.make_model(body, opset_imports=opset, ir_version=8), path)
    return path


@pytest.mark.parametrize("stages", [1, 2, 3, None])
@pytest.mark.parametrize("name", ["a.onnx", "a.safetensors"])
def test_it_says_what_the_network_says(model: Path, name: str, stages: int | None) -> None:
    network = TorchPredictor(load(model.with_suffix(".safetensors"))[0])
    opened = StereoSession(str(model.with_name(name)), RESOLUTION)
    assert (opened.arch, opened.origin, opened.size) == (ARCH, "a test", (96, 64))
    found, wanted = opened.predict(*pair(), stages), network.predict(*pair(), stages)
    assert found.stage == wanted.stage == (stages or 3)
    assert found.disparity.dtype == np.float32
    assert found.disparity.shape == RESOLUTION[::-1]
    np.testing.assert_allclose(found.disparity, wanted.disparity, atol=1e-3)
    assert found.semantic is not None
    assert found.semantic.dtype == np.uint8
    assert (found.semantic == wanted.semantic).mean() > 0.999
    assert found.seconds > 0


def test_anynet_has_no_classes(tmp_path: Path) -> None:
    network = build(Arch(family="anynet", c=1))
    export(network, tmp_path / "a.onnx", RESOLUTION, "a test")
    found = StereoSession(tmp_path / "a.onnx").predict(*pair(), stages=2)
    wanted = TorchPredictor(network).predict(*pair(), 2)
    assert found.semantic is None
    np.testing.assert_allclose(found.disparity, wanted.disparity, atol=1e-3)


@pytest.mark.parametrize("stages", [1, 2, 3])
def test_the_network_in_the_box_on_real_images(real_data: Path, stages: int) -> None:
    from rts2.model.box import named_model

    folder = real_data / "kitti2015" / "training"
    images = [read_rgb(folder / f"image_{side}" / "000001_10.png") for side in (2, 3)]
    found = StereoSession("c1", (1242, 375)).predict(*images, stages=stages)
    wanted = TorchPredictor(load(named_model("c1"))[0]).predict(*images, stages)
    assert np.abs(found.disparity - wanted.disparity).max() < 0.01
    assert (found.semantic == wanted.semantic).mean() > 0.999


def test_a_bundle_runs_without_torch(model: Path, tmp_path: Path) -> None:
    """Of the heavy libraries OpenCV alone is loaded: it normalises images."""
    graph = tmp_path / "model.onnx"
    graph.write_bytes(model.read_bytes())
    described = {"name": graph.name, "sha256": sha256(graph)}
    known = {"schema": "rts2.deployment/1", "files": [described]}
    (tmp_path / "deployment.json").write_text(json.dumps(known))
    code = (
        "import sys, numpy as np\n"
        "from rts2.model.session import StereoSession\n"
        f"session = StereoSession({str(tmp_path)!r})\n"
        "blank = np.zeros((50, 70, 3), np.uint8)\n"
        "print([session.predict(blank, blank, k).stage for k in (1, 2, 3)])\n"
        "print(sorted({'torch', 'matplotlib', 'cv2'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[1, 2, 3]\n['cv2']\n"


@pytest.mark.parametrize(
    ("budget_ms", "wanted"), [(10, 1), (19.9, 1), (20, 2), (39, 2), (40, 3), (1e9, 3)]
)
def test_as_many_stages_as_fit(session: StereoSession, budget_ms: float, wanted: int) -> None:
    plant(session, 10, 20, 40)
    assert session.expected_ms == {1: 10, 2: 20, 3: 40}
    assert session.predict(*pair(), budget_ms=budget_ms).stage == wanted


def test_a_budget_within_a_number_of_stages(session: StereoSession) -> None:
    plant(session, 10, 20, 40)
    assert session.predict(*pair(), stages=2, budget_ms=1e9).stage == 2
    plant(session, 10, 20, 40)
    assert session.predict(*pair(), stages=2, budget_ms=15).stage == 1


def test_times_are_measured_at_the_start_and_by_every_call(session: StereoSession) -> None:
    assert all(ms > 0 for ms in session.expected_ms.values())
    plant(session, 1e6, 1e6, 1e6)
    for _ in range(REMEMBERED):
        session.predict(*pair(), stages=2)
    assert session.expected_ms[2] < 1e5
    assert session.expected_ms[1] == session.expected_ms[3] == 1e6
    assert session.predict(*pair(), budget_ms=1e5).stage == 2


@pytest.mark.parametrize("budget_ms", [1e-6, 0, -1, float("nan")])
def test_a_budget_below_the_first_stage(session: StereoSession, budget_ms: float) -> None:
    with pytest.raises(UsageError, match=r"the first stage, which takes \d+\.\d ms here") as error:
        session.predict(*pair(), budget_ms=budget_ms)
    assert "\n" not in str(error.value)
    assert session.predict(*pair(), budget_ms=1e9).stage == 3


def test_no_budget_is_refused_that_the_first_stage_holds_now(session: StereoSession) -> None:
    """Or the times of a busy start would refuse every call for ever."""
    plant(session, 1e6, 1e6, 1e6)
    assert session.predict(*pair(), budget_ms=1e5).stage == 1


def test_the_first_stage_runs_where_it_held_the_budget_once(session: StereoSession) -> None:
    """A busy moment ends no drive."""
    plant(session, 10, 20, 40)
    for _ in range(REMEMBERED):
        session._times[0].add(1000)
    assert session.expected_ms[1] == 1000
    assert session.predict(*pair(), budget_ms=11).stage == 1


def test_a_stage_that_was_slow_once_gets_another_chance(session: StereoSession) -> None:
    plant(session, 10, 20, 30)
    session._times[2].add(1000)
    assert session.expected_ms[3] > 100
    assert [session.predict(*pair(), budget_ms=100).stage for _ in range(2)] == [2, 3]


def test_what_is_forgotten_is_the_slowest_but_never_the_last() -> None:
    times = Times()
    for ms in (3, 5, 4):
        times.add(ms)
    found = []
    for _ in range(4):
        times.forget_slowest()
        found.append(times.expected_ms)
    assert found == [pytest.approx(3.9), 3, 3, 3]


def test_nine_of_ten_calls_do_not_exceed_what_is_expected() -> None:
    times = Times()
    for ms in range(11):
        times.add(ms)
    assert times.expected_ms == 9


LEFT, RIGHT = pair()


@pytest.mark.parametrize(
    ("images", "words"),
    [
        ((LEFT.astype(np.float32), RIGHT), r"left is float32 \(50, 70, 3\)"),
        ((LEFT, RIGHT.astype(np.int8)), r"right is int8"),
        ((LEFT[..., 0], RIGHT), r"left is uint8 \(50, 70\)"),
        ((LEFT, RIGHT[..., :2]), r"right is uint8 \(50, 70, 2\)"),
        ((LEFT[None], RIGHT[None]), r"left is uint8 \(1, 50, 70, 3\)"),
        ((LEFT.tolist(), RIGHT), "left is list"),
        ((None, RIGHT), "left is NoneType"),
        ((LEFT, RIGHT[1:]), "it is 70x50 and 70x49"),
        (pair(size=(97, 50)), "pad to 96x64, and 97x50 pads to 128x64"),
        (pair(size=(50, 70)), "pad to 96x64, and 50x70 pads to 64x96"),
    ],
)
def test_a_wrong_pair_is_refused_and_the_next_is_served(
    session: StereoSession, images: tuple[np.ndarray, np.ndarray], words: str
) -> None:
    before = session.expected_ms
    with pytest.raises(UsageError, match=words) as error:
        session.predict(*images)
    assert "\n" not in str(error.value)
    assert session.expected_ms == before, "what did not run was not timed"
    assert session.predict(LEFT, RIGHT).stage == 3


def test_other_images_that_pad_to_its_size_are_welcome(session: StereoSession) -> None:
    assert session.predict(*pair(size=(96, 33))).disparity.shape == (33, 96)


def test_views_need_not_lie_in_one_piece(session: StereoSession) -> None:
    left, right = pair()
    both = np.concatenate([left, right], axis=1)
    found = session.predict(both[:, :70], both[:, 70:])
    assert np.array_equal(found.disparity, session.predict(left, right).disparity)


@pytest.mark.parametrize("stages", [0, 4, -1])
def test_stages_that_there_are_not(session: StereoSession, model: Path, stages: int) -> None:
    with pytest.raises(UsageError, match=f"runs 1 or 2 or 3 stages here, not {stages}"):
        session.predict(*pair(), stages=stages)
    assert session.predict(*pair(), stages=1).stage == 1
    with pytest.raises(UsageError, match="stages must be 1 to 3"):
        StereoSession(model, stages=stages)


def test_at_most_so_many_stages(model: Path) -> None:
    session = StereoSession(model, stages=2)
    assert session.predict(*pair()).stage == 2
    assert session.arch == ARCH
    with pytest.raises(UsageError, match="runs 1 or 2 stages here, not 3"):
        session.predict(*pair(), stages=3)


@pytest.mark.parametrize("stages", [2, None])
def test_a_session_that_stops_at_one_place_alone(model: Path, stages: int | None) -> None:
    session = StereoSession(model, stages=stages, early=False)
    own = stages or 3
    assert list(session.expected_ms) == [own]
    assert session.predict(*pair(), budget_ms=1e9).stage == own
    with pytest.raises(UsageError, match=f"runs {own} stages here, not 1"):
        session.predict(*pair(), stages=1)


def test_threads_share_a_session(session: StereoSession) -> None:
    """Whoever asks gets the answer to his own pair, in his own stages."""
    asked = [(seed, 1 + (seed + turn) % 3) for turn in range(4) for seed in range(6)]
    wanted = {key: session.predict(*pair(key[0]), stages=key[1]) for key in asked}
    with ThreadPoolExecutor(6) as threads:
        found = list(threads.map(lambda key: session.predict(*pair(key[0]), stages=key[1]), asked))
    for key, estimate in zip(asked, found, strict=True):
        assert estimate.stage == key[1]
        assert np.array_equal(estimate.disparity, wanted[key].disparity)
        assert np.array_equal(estimate.semantic, wanted[key].semantic)


def test_threads_share_a_budget(session: StereoSession) -> None:
    plant(session, 1e-9, 1e-9, 1e9)
    with ThreadPoolExecutor(4) as threads:
        found = threads.map(lambda seed: session.predict(*pair(seed), budget_ms=1e6), range(40))
    assert {estimate.stage for estimate in found} == {2}


def test_a_graph_of_another_tool_runs_as_it_is(tmp_path: Path) -> None:
    session = StereoSession(nameless(tmp_path / "a.onnx"))
    assert (session.arch, session.origin) == (None, None)
    found = session.predict(*pair(), budget_ms=1e9)
    assert (found.stage, found.semantic) == (None, None)
    with pytest.raises(UsageError, match="runs its own number of stages here, not 1"):
        session.predict(*pair(), stages=1)
    with pytest.raises(UsageError, match="not 1"):
        StereoSession(tmp_path / "a.onnx", stages=1)


def test_a_graph_that_tells_no_answers_cannot_stop(model: Path, tmp_path: Path) -> None:
    graph = load_graph(model)
    header = header_of(graph, model).model_copy(update={"answers": None})
    save_graph(graph, header, tmp_path / "a.onnx")
    assert StereoSession(tmp_path / "a.onnx").predict(*pair(), stages=3).stage == 3
    with pytest.raises(UsageError, match=r"runs 3 stages here, not 1; .* give the checkpoint"):
        StereoSession(tmp_path / "a.onnx", stages=1)


def test_a_graph_for_another_size(model: Path) -> None:
    with pytest.raises(UsageError, match="pad to 96x64, and 1242x375 pads to 1248x384"):
        StereoSession(model, (1242, 375))


def test_a_checkpoint_needs_a_size(model: Path) -> None:
    with pytest.raises(UsageError, match=r"a checkpoint needs the size of the images") as error:
        StereoSession(model.with_suffix(".safetensors"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["none.onnx", "nothing"])
def test_a_model_that_there_is_not(name: str) -> None:
    with pytest.raises(UsageError):
        StereoSession(name, RESOLUTION)


@pytest.mark.parametrize("content", [b"", b"junk", b"\x08"])
def test_a_broken_graph(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.onnx"
    path.write_bytes(content)
    with pytest.raises(Rts2Error, match=r"a\.onnx is truncated or no ONNX file"):
        StereoSession(path)


def test_a_changed_bundle(model: Path, tmp_path: Path) -> None:
    (tmp_path / "model.onnx").write_bytes(model.read_bytes())
    known = {"schema": "rts2.deployment/1", "files": [{"name": "model.onnx", "sha256": "0" * 64}]}
    (tmp_path / "deployment.json").write_text(json.dumps(known))
    with pytest.raises(Rts2Error, match="is not the file that"):
        StereoSession(tmp_path)


def test_sessions_of_sizes_that_pad_alike_are_one(model: Path) -> None:
    sessions = Sessions(model.with_suffix(".safetensors"))
    assert sessions.of((70, 50)) is sessions.of((96, 64)) is sessions.of((65, 33))
    assert sessions.of((70, 50)) is not sessions.of((97, 50))


def test_the_last_sessions_stay_open(model: Path) -> None:
    sessions = Sessions(model.with_suffix(".safetensors"), stages=1, early=False)
    sizes = [(64, 64 + 32 * index) for index in range(OPEN + 1)]
    first = sessions.of(sizes[0])
    for size in sizes[1:]:
        assert sessions.of(size).size == size
        assert sessions.of(sizes[0]) is first, "what was asked for last goes last"
    kept = sessions.of(sizes[-1])
    assert sessions.of(sizes[-1]) is kept
    assert len(sessions._open) == OPEN
