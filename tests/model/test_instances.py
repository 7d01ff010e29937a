"""iIoU by hand, by a plain loop over objects, and its averages against the real frames."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rts2.model.data.kitti import open_2015
from rts2.model.data.labels import CATEGORIES, CLASS_NAMES, WITH_INSTANCES
from rts2.model.errors import Rts2Error
from rts2.model.instances import (
    CLASSES,
    PUBLISHED,
    Objects,
    class_iious,
    iiou,
    iiou_category,
    objects,
    published_sizes,
)
from rts2.model.metrics import IGNORED, confusion

ROAD, PERSON, RIDER, CAR, TRUCK = (
    CLASS_NAMES.index(name) for name in ("road", "person", "rider", "car", "truck")
)
SIZES = np.full(CLASSES, 10.0)


def row(*values: int) -> np.ndarray:
    return np.array([values], np.uint8)


def counted(
    prediction: np.ndarray, truth: np.ndarray, instances: np.ndarray
) -> tuple[np.ndarray, Objects]:
    return confusion(prediction, truth, CLASSES), objects(prediction, truth, instances)


def test_two_cars_by_hand() -> None:
    """A car of 4 pixels, half found; one of 1 pixel, lost; a pixel of road taken for a car."""
    truth = row(CAR, CAR, CAR, CAR, CAR, ROAD, ROAD)
    instances = row(1, 1, 1, 1, 2, 0, 0)
    prediction = row(CAR, CAR, TRUCK, TRUCK, ROAD, CAR, ROAD)
    labels, seen = counted(prediction, truth, instances)
    # Weights 10/4 and 10/1: 2 · 2.5 found, 2 · 2.5 + 1 · 10 missed, 1 false.
    ious = class_iious(labels, seen, SIZES)
    assert ious[CAR] == pytest.approx(100 * 5 / (5 + 15 + 1))
    assert ious[TRUCK] == 0, "two false pixels, and no truck"
    assert np.isnan(np.delete(ious, [CAR, TRUCK])).all()
    assert iiou(labels, seen, SIZES) == pytest.approx(100 * 5 / 21 / 2)
    # As vehicles: all 4 pixels of the large one found, the small one lost, 1 false.
    assert iiou_category(labels, seen, SIZES) == pytest.approx(100 * 10 / (10 + 10 + 1))


def test_every_object_weighs_the_same() -> None:
    """Of a car of 98 pixels and one of 2 only the large is found: half, where IoU says 98 %."""
    truth = np.full((1, 100), CAR, np.uint8)
    instances = np.where(np.arange(100) < 98, 1, 2)[None]
    prediction = np.where(instances == 1, CAR, ROAD).astype(np.uint8)
    labels, seen = counted(prediction, truth, instances)
    assert iiou(labels, seen, seen.average_sizes()) == pytest.approx(50)


def test_perfect_labels_are_100() -> None:
    truth = row(CAR, CAR, PERSON, RIDER, ROAD)
    labels, seen = counted(truth, truth, row(1, 2, 3, 4, 0))
    assert iiou(labels, seen, SIZES) == pytest.approx(100)
    assert iiou_category(labels, seen, SIZES) == pytest.approx(100)


def test_a_number_in_two_classes_is_two_objects() -> None:
    truth = row(CAR, CAR, PERSON, PERSON)
    seen = objects(truth, truth, row(1, 1, 1, 1))
    assert (seen.count[CAR], seen.count[PERSON]) == (1, 1)
    assert seen.pixels.sum() == 4


def test_crowds_and_stuff_are_no_objects() -> None:
    truth = row(CAR, ROAD, IGNORED)
    seen = objects(truth, truth, row(0, 1, 2))
    assert seen.count.sum() == 0
    assert np.isnan(seen.average_sizes()).all()
    assert iiou(confusion(truth, truth, CLASSES), seen, SIZES) is None


def test_sums_of_images_are_those_of_one_large_image() -> None:
    generator = np.random.default_rng(0)
    truth = generator.choice([ROAD, PERSON, CAR, TRUCK], (12, 20)).astype(np.uint8)
    prediction = generator.choice([ROAD, RIDER, CAR, TRUCK], (12, 20)).astype(np.uint8)
    instances = np.repeat(generator.integers(1, 7, (12, 5)), 4, axis=1)
    instances[6:] += 10  # no object lies in both halves
    whole = counted(prediction, truth, instances)
    halves = [
        counted(prediction[part], truth[part], instances[part])
        for part in (slice(0, 6), slice(6, 12))
    ]
    labels, seen = (one + other for one, other in zip(*halves, strict=True))
    sizes = whole[1].average_sizes()
    np.testing.assert_allclose(seen.average_sizes(), sizes)
    assert iiou(labels, seen, sizes) == pytest.approx(iiou(*whole, sizes))
    assert iiou_category(labels, seen, sizes) == pytest.approx(iiou_category(*whole, sizes))


def looped(
    prediction: np.ndarray, truth: np.ndarray, instances: np.ndarray, groups: np.ndarray
) -> np.ndarray:
    """The iIoU of each group of classes: weights pixel by pixel, then three sums."""
    hit, lost, false = (np.zeros(groups.max() + 1) for _ in range(3))
    for place in np.ndindex(*truth.shape):
        wanted, found = truth[place], prediction[place]
        if wanted == IGNORED:
            continue
        right = groups[wanted] == groups[found]
        if not right:
            false[groups[found]] += 1
        if instances[place] and wanted in WITH_INSTANCES:
            size = ((truth == wanted) & (instances == instances[place])).sum()
            (hit if right else lost)[groups[wanted]] += SIZES[wanted] / size
    whole = hit + lost + false
    return 100 * hit[whole > 0] / whole[whole > 0], np.flatnonzero(whole)


@pytest.mark.parametrize("seed", range(3))
def test_iiou_is_that_of_a_plain_loop(seed: int) -> None:
    generator = np.random.default_rng(seed)
    truth = generator.integers(9, CLASSES + 1, (10, 12)).astype(np.uint8)
    truth[truth == CLASSES] = IGNORED
    prediction = generator.integers(9, CLASSES, (10, 12)).astype(np.uint8)
    instances = generator.integers(0, 4, (10, 12))
    labels, seen = counted(prediction, truth, instances)
    expected, which = looped(prediction, truth, instances, np.arange(CLASSES))
    single = np.isin(which, WITH_INSTANCES)
    np.testing.assert_allclose(class_iious(labels, seen, SIZES)[which[single]], expected[single])
    expected, which = looped(prediction, truth, instances, np.array(CATEGORIES))
    single = np.isin(which, [CATEGORIES[PERSON], CATEGORIES[CAR]])
    assert iiou_category(labels, seen, SIZES) == pytest.approx(expected[single].mean())


@pytest.mark.parametrize("dataset", PUBLISHED)
def test_published_sizes_are_of_the_classes_with_objects(dataset: str) -> None:
    sizes = published_sizes(dataset)
    assert sizes is not None
    assert np.flatnonzero(np.isfinite(sizes)).tolist() == list(WITH_INSTANCES)
    assert sizes[CAR] == PUBLISHED[dataset]["car"]


def test_other_data_sets_publish_no_sizes() -> None:
    assert published_sizes("streets") is None


def test_kittis_objects_are_those_of_its_files(real_data: Path) -> None:
    """Counted from the codes, id · 256 + number; sizes are of the published order."""
    frames = open_2015(real_data / "kitti2015")
    total = Objects(*(np.zeros(CLASSES) for _ in range(4)))
    codes = []
    for frame in frames:
        scene = frame.read()
        assert scene.semantic is not None
        assert scene.instances is not None
        total += objects(scene.semantic, scene.semantic, scene.instances)
        file = real_data / "kitti2015" / "training" / "instance" / f"{frame.name}.png"
        codes += np.unique(np.asarray(Image.open(file))).tolist()
    for label, train_id in ((24, PERSON), (26, CAR), (27, TRUCK)):
        own = [code for code in codes if code // 256 == label and code % 256]
        assert total.count[train_id] == len(own)
    published = published_sizes("kitti2015")
    assert published is not None
    assert total.average_sizes()[CAR] == pytest.approx(published[CAR], rel=0.5)


def test_maps_of_two_shapes_are_refused() -> None:
    with pytest.raises(Rts2Error, match="instances and truth must have one shape"):
        objects(row(1, 2), row(1, 2), row(1))
