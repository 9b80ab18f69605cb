# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pipeline in operation: live settings, keyframes, invalid images, resets, saving."""

from dataclasses import replace

import cv2
import numpy as np
from pipelines import (
    LENGTH,
    localizing,
    message,
    process,
    recorded,
    SECOND,
    stamps_of,
    statuses,
)
import pytest
from stavpr_ros.errors import ImageError, InputError
from stavpr_ros.mapping import save_map, thumbnail_of
from stavpr_ros.mapping.keyframes import KeyframeSettings
from stavpr_ros.method import Status
from stavpr_ros.method.verification import (
    GeometricEvidence,
    GeometricSettings,
    PlaceVerifier,
)
from stavpr_ros.pipeline import OPERATIONS

pytestmark = pytest.mark.usefixtures('one_thread')

CERTAIN = 7  # images after which the place is probable, in loop closure, too
CONFIRMED = 11  # images after which its path is confirmed


@pytest.mark.parametrize('operation', ['localization', 'loop_closure'])
def test_min_probability_and_candidates_change_with_a_full_window(operation, route):
    pipeline = recorded(route, operation, candidates=3)
    result = process(pipeline, route[:CONFIRMED])[-1]
    assert (result.match.status, len(result.candidates)) == (Status.MATCH, 3)
    assert result.candidates[0].place == result.match.path.place
    strict = 1 - 1e-9
    pipeline.change(replace(pipeline.settings, min_probability=strict, candidates=0))
    result = process(pipeline, route[11:12], first=11)[0]
    assert (result.match.status, result.candidates) == (Status.NO_MATCH, ())
    assert result.match.threshold == 1 - strict
    pipeline.change(replace(pipeline.settings, min_probability=0.1, candidates=1))
    result = process(pipeline, route[12:13], first=12)[0]
    assert (result.match.newest, result.match.threshold) == (12, 0.9)
    assert len(result.candidates) == 1
    result = pipeline.operation.process(message(route[13]), 14, list_candidates=False)
    assert result.candidates == ()
    pipeline.change(replace(pipeline.settings, min_probability=0.5, max_error=0.01))
    result = process(pipeline, route[13:14], first=13)[0]
    assert result.match.threshold == pytest.approx(0.5)


def test_keyframe_rules_change_and_the_last_keyframe_stays(map_file, route):
    pipeline = localizing(map_file, keyframes=KeyframeSettings(change=0.01))
    matches = process(pipeline, [route[0]] * 3 + route[1:LENGTH], poses=True)
    skipped = [result.cause == 'not a keyframe' for result in matches]
    assert skipped == [False, True, True, *[False] * 4]
    assert matches[-1].match.window_stamps == tuple(stamp * SECOND for stamp in (1, 4, 5, 6, 7))
    pipeline.change(replace(pipeline.settings, keyframes=KeyframeSettings(interval=2.0)))
    matches = process(pipeline, route[5:7], first=7)
    assert statuses(matches) == [Status.SKIPPED, Status.MATCH]
    pipeline.change(replace(pipeline.settings, keyframes=KeyframeSettings(distance=3.0)))
    assert process(pipeline, route[7:8], first=9)[0].cause == 'no odometry'
    # the last keyframe has no pose, so that the next image is one; then it is every third meter
    matches = process(pipeline, route[8:14], first=10, poses=True)
    assert [result.match.status is Status.SKIPPED for result in matches] == [False, True, True] * 2


@pytest.mark.parametrize('operation', ['localization', 'loop_closure'])
def test_geometric_check_in_mode_paper_accepts_and_rejects(operation, route):
    pipeline = recorded(route, operation, candidates=2, mode='paper', threshold=1.0)
    assert {result.match.inliers for result in process(pipeline, route[:CERTAIN])} == {-1}
    check = GeometricSettings(min_inliers=100)
    pipeline.change(replace(pipeline.settings, geometric=check))
    # the middle of a window of 5: the images until then came without a check
    process(pipeline, route[7:9], first=7)
    accepted = process(pipeline, route[9:10], first=9)[0].match
    assert (accepted.status, accepted.reason, accepted.place) == (Status.MATCH, '', 7)
    found = PlaceVerifier(check).inliers(thumbnail_of(route[7]), pipeline.places, 7)
    assert accepted.inliers == found >= 100
    pipeline.operation.reset()
    process(pipeline, route[: CERTAIN + 2])  # the same images again
    pipeline.change(replace(pipeline.settings, geometric=replace(check, min_inliers=found + 1)))
    result = process(pipeline, route[9:10], first=9)[0]
    match = result.match
    assert (match.status, match.inliers, match.place) == (Status.NO_MATCH, found, -1)
    assert f'{found} inliers are fewer than {found + 1}' in match.reason
    assert result.candidates[0].place == match.path.place
    pipeline.change(replace(pipeline.settings, geometric=None))
    assert statuses(process(pipeline, route[10:11], first=10)) == [Status.MATCH]


@pytest.mark.parametrize('least', [8, 100_000])
def test_geometric_check_in_mode_robust_weighs_doubtful_matches(map_file, route, least):
    rng = np.random.default_rng(0)
    noisy = [
        cv2.addWeighted(x, 0.75, rng.integers(0, 256, x.shape, np.uint8), 0.25, 0) for x in route
    ]
    plain = process(localizing(map_file, candidates=2), noisy[:LENGTH])[-1]
    limit = plain.match.probability  # just not above itself
    check = GeometricSettings(min_inliers=least)
    pipeline = localizing(map_file, geometric=check, min_probability=limit, candidates=2)
    result = process(pipeline, noisy[:LENGTH])[-1]
    assert 0.1 < plain.match.probability < 0.99
    assert result.match.inliers >= 8
    expected = GeometricEvidence().updated(plain.match.probability, least == 8)
    assert result.match.probability == pytest.approx(expected)
    assert result.match.status is (Status.MATCH if least == 8 else Status.NO_MATCH)
    assert bool(result.match.reason) == (least != 8)
    assert result.match.distance == result.candidates[0].distance == 1 - result.match.probability
    assert result.match.path.place == plain.match.path.place == result.candidates[0].place
    assert result.match.path.probability == plain.match.probability  # by the images alone


def test_geometric_check_decides_each_late_match(route, monkeypatch):
    """Where it rejects the match that they come with, too."""
    check = GeometricSettings(min_inliers=8)

    def closing(**changes):
        pipeline = recorded(route, 'loop_closure', **changes)
        (result,) = (each for each in process(pipeline, route[:12], first=30) if each.match.late)
        return pipeline.places, result

    places, result = closing(geometric=check)
    assert result.match.accepted
    for each in result.match.late:
        query = places.thumbnail(each.first_image + each.position)
        found = PlaceVerifier(check).inliers(query, places, each.place)
        assert each.inliers == found >= 8
    rejected = {result.match.place, result.match.late[0].place}
    monkeypatch.setattr(PlaceVerifier, 'inliers', lambda *given: 8 * (given[3] not in rejected))
    _, other = closing(geometric=check)
    assert not other.match.accepted
    left = [each.place for each in result.match.late if each.place not in rejected]
    assert [each.place for each in other.match.late] == left != []


def test_geometric_check_without_thumbnails_changes_nothing(small_map, route, tmp_path):
    save_map(replace(small_map, thumbnails=()), tmp_path / 'blind.stavpr')
    pipeline = localizing(str(tmp_path / 'blind.stavpr'), geometric=GeometricSettings())
    result = process(pipeline, route[:CERTAIN])[-1]
    assert (result.match.status, result.match.inliers) == (Status.MATCH, -1)


class Failing:
    """A function that raises ``error`` while that is set."""

    def __init__(self, function):
        self.function, self.error = function, None

    def __call__(self, *arguments):
        if self.error is not None:
            raise self.error
        return self.function(*arguments)


@pytest.mark.parametrize('operation', OPERATIONS)
def test_process_of_an_invalid_image_changes_nothing(operation, route, monkeypatch):
    """
    Another pipeline gets the valid images only: both return the same for these.

    Each image fails before it is valid: if it counted as a keyframe, it would then be skipped.
    """
    keyframes = KeyframeSettings(change=0.01)
    pipeline, other = (recorded(route, operation, keyframes=keyframes) for _ in range(2))
    extract = Failing(pipeline.operation.extractor.extract)
    monkeypatch.setattr(pipeline.operation.extractor, 'extract', extract)
    thumbnail = Failing(lambda image: b'')
    monkeypatch.setattr('stavpr_ros.pipeline.operations.encode_thumbnail', thumbnail)
    cut_off = message(route[0])
    object.__setattr__(cut_off, 'data', cut_off.data[:100])
    for i, image in enumerate(route[:12] if operation != 'mapping' else route[30:42]):
        broken = pipeline.operation.process(cut_off, i)
        assert (broken.match.status, broken.cause) == (Status.INVALID_IMAGE, 'invalid: cut off')
        extract.error = ImageError('not finite', kind='features')
        broken = pipeline.operation.process(message(image), i)
        assert (broken.cause, broken.match.reason) == ('invalid: features', 'not finite')
        extract.error = None
        if operation != 'localization':
            thumbnail.error = InputError('no JPEG')
            assert pipeline.operation.process(message(image), i).cause == 'invalid: InputError'
            thumbnail.error = None
        with pytest.raises(InputError, match='quaternion of norm 0'):
            pipeline.operation.process(message(image), i, np.zeros(7))
        good, expected = (
            process(each, [image], first=50 + i, poses=True)[0] for each in (pipeline, other)
        )
        for name in ('image_index', 'candidates'):
            assert getattr(good, name) == getattr(expected, name)
        assert repr(good.match) == repr(expected.match)
        if operation != 'mapping':
            assert good.match.window_stamps == expected.match.window_stamps
    assert stamps_of(pipeline.places) == stamps_of(other.places)
    assert good.match.status is not Status.WARMING_UP


@pytest.mark.parametrize('operation', ['localization', 'loop_closure'])
def test_reset_empties_the_window_and_keeps_the_places(operation, route):
    pipeline = recorded(route, operation, keyframes=KeyframeSettings(change=0.01))
    process(pipeline, route[:LENGTH])
    assert pipeline.operation.window_fill == LENGTH
    places = len(pipeline.places)
    pipeline.operation.reset()
    assert (pipeline.operation.window_fill, len(pipeline.places)) == (0, places)
    # the first equals the last keyframe
    matches = process(pipeline, route[4 : 4 + LENGTH], first=100)
    waiting = statuses(matches).count(Status.WARMING_UP)
    found = Status.NO_MATCH if operation == 'loop_closure' else Status.MATCH  # not confirmed yet
    assert statuses(matches) == [Status.WARMING_UP] * waiting + [found] * (5 - waiting)
    assert waiting == 4 if operation == 'loop_closure' else 1 <= waiting <= 4
    assert matches[-1].match.window_stamps == tuple((101 + i) * SECOND for i in range(LENGTH))
    if operation == 'loop_closure':
        assert matches[-1].match.first_image == places
    assert matches[-1].match.path.pairs[-1].tolist() == [4, 8]
