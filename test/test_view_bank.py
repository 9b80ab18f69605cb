# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A query by night whose camera is rolled or tilted against that of the map."""

from dataclasses import replace

import cv2
import numpy as np
from pipelines import localizing, process
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, save_map
from stavpr_ros.mapping.keyframes import KeyframeSettings
from stavpr_ros.pipeline.view_bank import IN_A_ROW, ViewBank, VIEWS, warped
from stavpr_ros.recognition import Match, Status
from stavpr_ros.sources.frame import Frame

pytestmark = pytest.mark.usefixtures('one_thread')
PLACES, STEP, MARGIN, HEIGHT, WIDTH = 80, 8, 32, 96, 128
LENGTH = 20
NIGHT = 160.0  # deviation of the noise, of 255
AS_THEY_ARE, LEFT, RIGHT, DOWN, UP = (
    'as they are',
    'rotated left by 8 degrees',
    'rotated right by 8 degrees',
    'moved down by a tenth of the height',
    'moved up by a tenth of the height',
)


def drive(street=0, roll=0.0, shift=0.0, noise=NIGHT):
    """Return images of a drive along a street, with real borders and noise of their own."""
    rng = np.random.default_rng(street)
    height, width = HEIGHT + 2 * MARGIN, PLACES * STEP + WIDTH + 2 * MARGIN
    texture = np.zeros((height, width, 3))
    for size in (4, 10, 24):
        coarse = rng.integers(0, 256, (height // size, width // size, 3), np.uint8)
        texture += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC) / 3
    texture, noisy = np.clip(1.6 * texture - 77, 0, 255).astype(np.uint8), []
    for x in range(0, PLACES * STEP, STEP):
        wide = texture[:, x : x + WIDTH + 2 * MARGIN]
        view = warped(wide, roll, shift * HEIGHT / height)[MARGIN:-MARGIN, MARGIN:-MARGIN]
        image = view + np.random.default_rng(x).normal(0, noise, view.shape)
        noisy.append(np.clip(image, 0, 255).astype(np.uint8))
    return noisy


@pytest.fixture(scope='module')
def night_map(tmp_path_factory):
    """Return the file of a map of street 0 by day."""
    frames = [Frame(image, i + 1, f'place {i}') for i, image in enumerate(drive(noise=10.0))]
    path = tmp_path_factory.mktemp('map') / 'street.stavpr'
    save_map(build_map(frames, FeatureExtractor(), progress=False), path)
    return str(path)


def localizer(path, other_views=True, **changes):
    changes = {'sequence': SequenceSettings(LENGTH), 'min_probability': 0.5} | changes
    return localizing(path, other_views=other_views, nms_radius=20, **changes)


def matched(matches):
    """Return how many images have a match; each is right."""
    found = [i for i, match in enumerate(matches) if match.accepted]
    for i in found:
        match = matches[i].match
        image = i - (len(match.window_stamps) - 1) + match.position
        assert abs(matches[i].place_index - image) <= 2
    return len(found)


@pytest.mark.parametrize(
    ('roll', 'shift', 'view'), [(10, 0, RIGHT), (-10, 0, LEFT), (0, 0.1, UP), (0, -0.1, DOWN)]
)
def test_rolled_or_tilted_camera_is_matched_by_the_view_that_undoes_it(
    night_map, roll, shift, view
):
    images, pipeline = drive(roll=roll, shift=shift), localizer(night_map)
    plain = matched(process(localizer(night_map, other_views=False), images))
    matches = process(pipeline, images)
    assert matched(matches) >= plain + 15
    assert pipeline.operation.view == view
    assert matches[-1].candidates[0].place == matches[-1].place_index


def test_camera_as_that_of_the_map_is_matched_as_without_other_views(night_map):
    found = []
    for other_views in (False, True):
        pipeline = localizer(night_map, other_views)
        matches = process(pipeline, drive())
        assert matched(matches) > 2 * LENGTH
        found.append([(match.place_index, match.probability) for match in matches])
    assert found[0] == found[1]
    assert pipeline.operation.view == AS_THEY_ARE


def test_other_street_is_matched_in_no_view(night_map):
    pipeline = localizer(night_map)
    assert matched(process(pipeline, drive(street=1))) == 0
    assert pipeline.operation.view == AS_THEY_ARE


def test_views_are_followed_again_after_two_windows_without_a_match(night_map):
    pipeline, images = localizer(night_map), drive(roll=10)
    process(pipeline, images)
    assert pipeline.operation.view == RIGHT
    process(pipeline, drive(street=1), first=PLACES)
    images = drive(roll=-10)
    assert matched(process(pipeline, images, first=2 * PLACES)) > LENGTH
    assert pipeline.operation.view == LEFT
    pipeline.operation.reset()
    assert pipeline.operation.view == AS_THEY_ARE
    assert matched(process(pipeline, drive(), first=3 * PLACES)) > 2 * LENGTH


def test_standing_camera_adopts_no_view(night_map):
    pipeline = localizer(night_map, keyframes=KeyframeSettings(change=0.0))
    images, adopted = drive(roll=10), 0
    while pipeline.operation.view == AS_THEY_ARE:
        process(pipeline, images[adopted : adopted + 1], first=adopted)
        adopted += 1
    pipeline.operation.reset()
    process(pipeline, images[: adopted - IN_A_ROW + 1])
    process(pipeline, images[adopted - IN_A_ROW : adopted - IN_A_ROW + 1] * 2 * IN_A_ROW, adopted)
    assert pipeline.operation.view == AS_THEY_ARE
    process(pipeline, images[adopted - IN_A_ROW + 1 : adopted], 3 * PLACES)
    assert pipeline.operation.view == RIGHT


def test_limits_apply_to_all_views(night_map):
    pipeline, strict = localizer(night_map), 1 - 1e-9
    pipeline.change(replace(pipeline.settings, min_probability=strict))
    matches = process(pipeline, drive(roll=10))
    assert pipeline.operation.view == RIGHT  # by the probability, whatever limit it has to exceed
    assert not any(match.accepted for match in matches)
    assert {match.match.min_probability for match in matches} == {strict}


FULL = 4  # images in a full window of a Scripted
NONE = np.nan


class Scripted:
    """A recognizer whose features are the probabilities of its matches."""

    is_standstill = False

    def __init__(self):
        self.reset()

    def another(self, place_map):
        return Scripted()

    def reset(self):
        self.window_fill = 0

    def update(self, features, stamp, pose):
        self.window_fill = min(self.window_fill + 1, FULL)
        return Match(Status.MATCH, probability=features[0])


def followed(bank):
    return len(bank.warped(np.zeros((8, 8, 3), np.uint8)))


def feed(bank, images, own=NONE, other=NONE):
    """Feed images with the probabilities of the present view and of the one rotated left."""
    for _ in range(images):
        one = {LEFT: other, bank.view: own}
        row = [one.get(view, NONE) for view in VIEWS] if followed(bank) > 1 else [own]
        bank.update(row, 0, None)


@pytest.mark.parametrize(
    ('own', 'other', 'view', 'count'),
    [
        (NONE, 0.51, LEFT, 1),
        (NONE, 0.50, AS_THEY_ARE, 5),
        (0.50, 0.51, LEFT, 1),
        (0.60, 0.80, AS_THEY_ARE, 1),  # odds 1.5 and 4
        (0.60, 0.85, LEFT, 1),  # 5.7
        (1.00, 1.00, AS_THEY_ARE, 1),
    ],
)
def test_most_probable_view_is_adopted_the_present_one_preferred(own, other, view, count):
    bank = ViewBank(Scripted(), None)
    feed(bank, IN_A_ROW - 1, own, other)
    assert (bank.view, followed(bank)) == (AS_THEY_ARE, 5)
    feed(bank, 1, own, other)
    assert (bank.view, followed(bank)) == (view, count)


@pytest.mark.parametrize('between', [NONE, 0.9])
def test_view_that_is_not_the_most_probable_one_in_a_row_is_not_adopted(between):
    bank = ViewBank(Scripted(), None)
    feed(bank, IN_A_ROW - 1, other=0.8)
    feed(bank, 1, between, 0.8 if between == 0.9 else NONE)
    feed(bank, IN_A_ROW - 1, other=0.8)
    assert (bank.view, followed(bank)) == (AS_THEY_ARE, 5)
    feed(bank, 1, other=0.8)
    assert (bank.view, followed(bank)) == (LEFT, 1)
