"""The pipeline without ROS: what changes while it runs, errors in the middle of images, questions, saving."""

import itertools
import os
from dataclasses import replace

import numpy as np
import pytest
from pipelines import (
    LENGTH,
    SECOND,
    answers,
    as_if_saved,
    localizing,
    message,
    one_thread,
    settings_of,
    show,
    stamps_of,
)

from stavpr_ros.errors import FeatureMismatchError, ImageError, InputError, MapFileError
from stavpr_ros.mapping import load_map, save_map
from stavpr_ros.mapping.keyframes import KeyframeSettings
from stavpr_ros.pipeline import OPERATIONS, Pipeline, Status, read_map
from stavpr_ros.recognition.verification import GeometricSettings


@pytest.fixture(scope='module', autouse=True)
def _one_thread():
    with one_thread():
        yield


def test_the_threshold_and_the_number_of_candidates_change_with_a_full_window(map_file, route):
    pipeline = localizing(map_file, candidates=3)
    outcome = show(pipeline, route[:LENGTH])[-1]
    assert (outcome.status, len(outcome.candidates)) == (Status.MATCH, 3)
    assert outcome.candidates[0].place == outcome.sequence.middle
    pipeline.change(replace(pipeline.settings, threshold=1e-9, candidates=0))
    outcome = show(pipeline, route[5:6], first=5)[0]
    assert (outcome.status, outcome.threshold, outcome.candidates) == (Status.NO_MATCH, 1e-9, ())
    pipeline.change(replace(pipeline.settings, threshold=None, candidates=1))  # mode robust has a default
    outcome = show(pipeline, route[6:7], first=6)[0]
    assert (outcome.status, outcome.newest_index, outcome.threshold) == (Status.MATCH, 6, 1.0)
    assert len(outcome.candidates) == 1


def test_the_threshold_of_a_route_changes_with_a_full_window(route):
    pipeline = Pipeline(settings_of(), 'loop_closure')
    assert show(pipeline, route[:20] * 2)[-1].status is Status.MATCH
    pipeline.change(replace(pipeline.settings, threshold=1e-9))
    outcome = show(pipeline, route[:1])[0]
    assert (outcome.status, outcome.recognition.threshold) == (Status.NO_MATCH, 1e-9)
    assert len(pipeline.places) == 41


def test_changes_leave_a_growing_map_alone(route):
    """In mode paper without a threshold, which mapping does not ask for; the last keyframe stays as well."""
    pipeline = Pipeline(settings_of(mode='paper', keyframes=KeyframeSettings(change=0.01)), 'mapping')
    show(pipeline, route[:3])
    growing = pipeline.places
    for threshold in (None, 0.2, 0.3, None):
        pipeline.change(replace(pipeline.settings, threshold=threshold, candidates=3))
        assert pipeline.places is growing
        assert answers(show(pipeline, route[2:3], first=2)) == [Status.SKIPPED]
    assert pipeline.unsaved == len(growing) == 3


def test_a_threshold_that_comes_and_goes_loses_no_route(route):
    pipeline = Pipeline(settings_of(mode='paper', threshold=0.1), 'loop_closure')
    show(pipeline, route[:7])
    pipeline.change(replace(pipeline.settings, threshold=None))
    assert answers(show(pipeline, route[:1])) == [Status.NOT_READY]
    assert 'threshold' in pipeline.missing
    assert stamps_of(pipeline.places_as_map()) == list(range(1, 8))


def test_keyframes(map_file, route):
    """Each rule; an image that is none changes nothing, and rules change with the last keyframe kept."""
    rules = KeyframeSettings(change=0.01)
    pipeline = localizing(map_file, keyframes=rules)
    still = [route[0]] * 3 + route[1:LENGTH]
    outcomes = show(pipeline, still, poses=True)
    assert answers(outcomes) == [
        Status.WARMING_UP, Status.SKIPPED, Status.SKIPPED, *[Status.WARMING_UP] * 3, Status.MATCH
    ]  # fmt: skip
    assert outcomes[1].cause == 'not a keyframe'
    assert 'differs by 0.0000' in outcomes[1].reason
    assert outcomes[-1].window == tuple(stamp * SECOND for stamp in (1, 4, 5, 6, 7))
    pipeline.change(replace(pipeline.settings, keyframes=KeyframeSettings(interval=2.0)))
    outcomes = show(pipeline, route[5:7], first=7)
    assert answers(outcomes) == [Status.SKIPPED, Status.MATCH]
    assert 'less than 2 s' in outcomes[0].reason
    pipeline.change(replace(pipeline.settings, keyframes=KeyframeSettings(distance=3.0)))
    outcomes = show(pipeline, route[7:9], first=9) + show(pipeline, route[8:14], first=10, poses=True)
    assert outcomes[0].cause == outcomes[1].cause == 'no odometry'
    # the last keyframe had no pose, which cannot object; then it is every third meter
    assert [outcome.status is Status.SKIPPED for outcome in outcomes[2:]] == [False, True, True] * 2
    assert 'of 3 m' in outcomes[3].reason


@pytest.mark.parametrize('operation', ['localization', 'loop_closure'])
def test_the_geometric_check(operation, small_map, route, tmp_path):
    """Accepts, rejects by its parameter, and rejects where there is no picture; it is changed live."""
    pipeline = Pipeline(settings_of(candidates=2), 'mapping')
    show(pipeline, route[:30])
    as_if_saved(pipeline)
    pipeline.set_operation(operation)
    if operation == 'loop_closure':
        show(pipeline, route[:30])
    assert {outcome.inliers for outcome in show(pipeline, route[:LENGTH])} == {-1}
    least = GeometricSettings(min_inliers=100)
    pipeline.change(replace(pipeline.settings, geometric=least))
    accepted = show(pipeline, route[5:6], first=5)[0]
    assert (accepted.status, accepted.reason, accepted.newest_index) == (Status.MATCH, '', 5)
    assert accepted.inliers >= 100
    for more, answer in ((0, Status.MATCH), (1, Status.NO_MATCH)):  # the same images once more
        pipeline.reset()
        show(pipeline, route[:LENGTH])
        just = replace(least, min_inliers=accepted.inliers + more)
        pipeline.change(replace(pipeline.settings, geometric=just))
        outcome = show(pipeline, route[5:6], first=5)[0]
        assert (outcome.status, outcome.inliers) == (answer, accepted.inliers)
    pipeline.change(replace(pipeline.settings, geometric=replace(least, min_inliers=5000)))
    rejected = show(pipeline, route[6:7], first=6)[0]
    assert (rejected.status, rejected.place_index) == (Status.NO_MATCH, -1)
    assert rejected.sequence.middle == 4
    assert f'{rejected.inliers} inliers are fewer than 5000' in rejected.reason
    assert len(rejected.candidates) == 2
    pipeline.change(replace(pipeline.settings, geometric=None))
    assert answers(show(pipeline, route[7:8])) == [Status.MATCH]


def test_the_geometric_check_of_a_map_without_pictures(small_map, route, tmp_path):
    save_map(replace(small_map, thumbnails=()), tmp_path / 'blind.stavpr')
    pipeline = Pipeline(settings_of(geometric=GeometricSettings()))
    pipeline.use(read_map(str(tmp_path / 'blind.stavpr'), pipeline.settings))
    outcome = show(pipeline, route[:LENGTH])[-1]
    assert (outcome.status, outcome.inliers) == (Status.NO_MATCH, -1)
    assert 'keeps no pictures' in outcome.reason


# ------------------------------------------------ errors in the middle, resets, questions


class Stumbles:
    """A extractor, or a thumbnail maker, that does not do when it is asked to."""

    def __init__(self, wrapped):
        self.wrapped, self.error = wrapped, None

    def __call__(self, *arguments):
        if self.error is not None:
            raise self.error
        return self.wrapped(*arguments)


@pytest.mark.parametrize('operation', OPERATIONS)
def test_an_error_in_the_middle_of_an_image_changes_nothing(operation, route, monkeypatch):
    """Another pipeline does not see the bad images: both say the same of the good ones."""
    pipeline, other = (
        Pipeline(settings_of(keyframes=KeyframeSettings(change=0.01)), 'mapping') for _ in range(2)
    )
    for each in (pipeline, other):
        show(each, route[:30], poses=True)
        as_if_saved(each)
        each.set_operation(operation)
    describe = Stumbles(pipeline.extractor.describe)
    monkeypatch.setattr(pipeline.extractor, 'describe', describe)
    thumbnail = Stumbles(lambda image, width: b'')
    monkeypatch.setattr('stavpr_ros.pipeline.operations.encode_thumbnail', thumbnail)
    cut_off = message(route[0])
    object.__setattr__(cut_off, 'data', cut_off.data[:100])
    for i, image in enumerate(route[:30] if operation != 'mapping' else route[30:40]):
        broken = pipeline.process(cut_off, i)
        assert (broken.status, broken.cause) == (Status.INVALID_IMAGE, 'invalid: cut off')
        describe.error = ImageError('not finite', kind='features')
        broken = pipeline.process(message(route[59]), i)
        assert (broken.cause, broken.reason) == ('invalid: features', 'not finite')
        describe.error = FeatureMismatchError('another kind')
        assert pipeline.process(message(route[59]), i).cause == 'invalid: FeatureMismatchError'
        describe.error = None
        if operation != 'localization':
            thumbnail.error = InputError('no JPEG')
            assert pipeline.process(message(route[59]), i).cause == 'invalid: InputError'
            thumbnail.error = None
        with pytest.raises(InputError, match='quaternion of zeros'):
            pipeline.process(message(route[59]), i, np.zeros(7))
        (good,), (expected,) = (show(each, [image], first=50 + i, poses=True) for each in (pipeline, other))
        assert (good.status, good.window_stamps, good.image_index) == (expected.status, expected.window_stamps, expected.image_index)
        assert repr(good.candidates) == repr(expected.candidates)
        if good.recognition is not None:
            assert repr(good.sequence) == repr(expected.sequence)
    assert stamps_of(pipeline.places_as_map()) == stamps_of(other.places_as_map())
    assert good.status is not Status.WARMING_UP


@pytest.mark.parametrize('operation', ['localization', 'loop_closure'])
def test_a_reset_empties_the_window_and_keeps_the_places(operation, route):
    pipeline = Pipeline(settings_of(keyframes=KeyframeSettings(change=0.01)), 'mapping')
    show(pipeline, route[:30])
    as_if_saved(pipeline)
    pipeline.set_operation(operation)
    if operation == 'loop_closure':
        show(pipeline, route[:30])
    show(pipeline, route[:LENGTH])
    assert pipeline.window_fill == LENGTH
    places = len(pipeline.places)
    pipeline.reset()
    assert (pipeline.window_fill, len(pipeline.places)) == (0, places)
    outcomes = show(pipeline, route[4 : 4 + LENGTH], first=100)  # the first looks like the last keyframe
    assert answers(outcomes) == [Status.WARMING_UP] * 4 + [Status.MATCH]
    assert outcomes[-1].window == tuple((101 + i) * SECOND for i in range(LENGTH))
    if operation == 'loop_closure':
        assert outcomes[-1].first_image_index == places
    assert outcomes[-1].newest_index == 8


def test_relocalize_answers_for_the_window_as_it_is(map_file, route):
    pipeline = Pipeline(settings_of())
    with pytest.raises(InputError, match='map_path'):
        pipeline.relocalize(3)
    pipeline.set_operation('mapping')
    with pytest.raises(InputError, match='mapping recognizes nothing'):
        pipeline.relocalize(3)
    pipeline = localizing(map_file, candidates=2)
    for i in range(LENGTH):
        with pytest.raises(InputError, match=f'{i} of 5 images in the window'):
            pipeline.relocalize(3)
        outcome = show(pipeline, route[i : i + 1], first=i)[0]
    told, ranked = pipeline.relocalize(4)
    assert (told.status, told.recognition, told.window_stamps) == (Status.MATCH, outcome.recognition, outcome.window_stamps)
    assert len(ranked) == 4
    assert tuple(ranked[:2]) == outcome.candidates
    assert min(abs(a.place - b.place) for a, b in itertools.combinations(ranked, 2)) > 5
    assert pipeline.relocalize(0)[1] == []
    pipeline.process(message(np.zeros((0, 0, 3), np.uint8)), 0)  # bad: the window is as it was
    assert pipeline.relocalize(4) == (told, ranked)
    pipeline.reset()
    with pytest.raises(InputError, match='0 of 5'):
        pipeline.relocalize(3)


# ------------------------------------------------ saving


def test_saving(route, tmp_path, monkeypatch):
    path = tmp_path / 'grown.stavpr'
    pipeline = Pipeline(settings_of(mode='paper'), 'loop_closure')
    with pytest.raises(InputError, match='threshold'):
        pipeline.save(str(path), overwrite=True)
    pipeline.set_operation('localization')
    with pytest.raises(InputError, match='map_path'):
        pipeline.save(str(path), overwrite=True)
    pipeline.set_operation('mapping')
    with pytest.raises(InputError, match='no places'):
        pipeline.save(str(path), overwrite=True)
    assert not path.exists()
    show(pipeline, route[:3])
    with pytest.raises(MapFileError, match='make it first'):
        pipeline.save(str(tmp_path / 'missing' / 'grown.stavpr'), overwrite=True)
    assert (pipeline.save(str(path), overwrite=False), pipeline.path, pipeline.unsaved) == (3, str(path), 0)
    assert stamps_of(load_map(path)) == [1, 2, 3]
    show(pipeline, route[3:4], first=3)
    with pytest.raises(MapFileError, match='is there already'):
        pipeline.save(str(path), overwrite=False)
    assert pipeline.unsaved == 1
    content = path.read_bytes()

    def fails(*arguments):
        raise OSError('the disk is full')

    with monkeypatch.context() as disk:
        disk.setattr(os, 'replace', fails)
        with pytest.raises(MapFileError, match='what was there is untouched'):
            pipeline.save(str(path), overwrite=True)
    assert (path.read_bytes(), pipeline.unsaved) == (content, 1)
    assert [file.name for file in tmp_path.iterdir()] == ['grown.stavpr']
    assert pipeline.save(str(path), overwrite=True) == 4
    assert stamps_of(load_map(path)) == [1, 2, 3, 4]
    assert show(pipeline, route[4:5], first=4)[0].image_index == 4  # and it goes on
