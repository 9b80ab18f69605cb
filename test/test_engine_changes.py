"""The engine without ROS: what changes while it runs, errors in the middle of images, questions, saving."""

import itertools
import os
from dataclasses import replace

import numpy as np
import pytest
from engines import (
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
from stavpr_ros.operation import OPERATIONS, Answer, Engine, read_map
from stavpr_ros.recognition.geometry import GeometricSettings


@pytest.fixture(scope='module', autouse=True)
def _one_thread():
    with one_thread():
        yield


def test_the_threshold_and_the_number_of_candidates_change_with_a_full_window(map_file, route):
    engine = localizing(map_file, candidates=3)
    outcome = show(engine, route[:LENGTH])[-1]
    assert (outcome.answer, len(outcome.candidates)) == (Answer.MATCH, 3)
    assert outcome.candidates[0].place == outcome.recognition.nearest.middle
    engine.change(replace(engine.settings, threshold=1e-9, candidates=0))
    outcome = show(engine, route[5:6], first=5)[0]
    assert (outcome.answer, outcome.threshold, outcome.candidates) == (Answer.NO_MATCH, 1e-9, ())
    engine.change(replace(engine.settings, threshold=None, candidates=1))  # mode robust has a default
    outcome = show(engine, route[6:7], first=6)[0]
    assert (outcome.answer, outcome.recognition.newest, outcome.threshold) == (Answer.MATCH, 6, 1.0)
    assert len(outcome.candidates) == 1


def test_the_threshold_of_a_route_changes_with_a_full_window(route):
    engine = Engine(settings_of(), 'loop_closure')
    assert show(engine, route[:20] * 2)[-1].answer is Answer.MATCH
    engine.change(replace(engine.settings, threshold=1e-9))
    outcome = show(engine, route[:1])[0]
    assert (outcome.answer, outcome.recognition.threshold) == (Answer.NO_MATCH, 1e-9)
    assert len(engine.places) == 41


def test_changes_leave_a_growing_map_alone(route):
    """In mode paper without a threshold, which mapping does not ask for; the last keyframe stays as well."""
    engine = Engine(settings_of(mode='paper', keyframes=KeyframeSettings(change=0.01)), 'mapping')
    show(engine, route[:3])
    growing = engine.places
    for threshold in (None, 0.2, 0.3, None):
        engine.change(replace(engine.settings, threshold=threshold, candidates=3))
        assert engine.places is growing
        assert answers(show(engine, route[2:3], first=2)) == [Answer.SKIPPED]
    assert engine.unsaved == len(growing) == 3


def test_a_threshold_that_comes_and_goes_loses_no_route(route):
    engine = Engine(settings_of(mode='paper', threshold=0.1), 'loop_closure')
    show(engine, route[:7])
    engine.change(replace(engine.settings, threshold=None))
    assert answers(show(engine, route[:1])) == [Answer.NOT_READY]
    assert 'threshold' in engine.missing
    assert stamps_of(engine.places_as_map()) == list(range(1, 8))


def test_keyframes(map_file, route):
    """Each rule; an image that is none changes nothing, and rules change with the last keyframe kept."""
    rules = KeyframeSettings(change=0.01)
    engine = localizing(map_file, keyframes=rules)
    still = [route[0]] * 3 + route[1:LENGTH]
    outcomes = show(engine, still, poses=True)
    assert answers(outcomes) == [
        Answer.WARMING_UP, Answer.SKIPPED, Answer.SKIPPED, *[Answer.WARMING_UP] * 3, Answer.MATCH
    ]  # fmt: skip
    assert outcomes[1].cause == 'not a keyframe'
    assert 'differs by 0.0000' in outcomes[1].reason
    assert outcomes[-1].window == tuple(stamp * SECOND for stamp in (1, 4, 5, 6, 7))
    engine.change(replace(engine.settings, keyframes=KeyframeSettings(seconds=2.0)))
    outcomes = show(engine, route[5:7], first=7)
    assert answers(outcomes) == [Answer.SKIPPED, Answer.MATCH]
    assert 'less than 2 s' in outcomes[0].reason
    engine.change(replace(engine.settings, keyframes=KeyframeSettings(metres=3.0)))
    outcomes = show(engine, route[7:9], first=9) + show(engine, route[8:14], first=10, poses=True)
    assert outcomes[0].cause == outcomes[1].cause == 'no odometry'
    # the last keyframe had no pose, which cannot object; then it is every third metre
    assert [outcome.answer is Answer.SKIPPED for outcome in outcomes[2:]] == [False, True, True] * 2
    assert 'of 3 m' in outcomes[3].reason


@pytest.mark.parametrize('operation', ['localization', 'loop_closure'])
def test_the_geometric_check(operation, small_map, route, tmp_path):
    """Accepts, rejects by its parameter, and rejects where there is no picture; it is changed live."""
    engine = Engine(settings_of(candidates=2), 'mapping')
    show(engine, route[:30])
    as_if_saved(engine)
    engine.set_operation(operation)
    if operation == 'loop_closure':
        show(engine, route[:30])
    assert {outcome.inliers for outcome in show(engine, route[:LENGTH])} == {-1}
    least = GeometricSettings(min_inliers=100)
    engine.change(replace(engine.settings, geometric=least))
    accepted = show(engine, route[5:6], first=5)[0]
    assert (accepted.answer, accepted.reason, accepted.recognition.newest) == (Answer.MATCH, '', 5)
    assert accepted.inliers >= 100
    for more, answer in ((0, Answer.MATCH), (1, Answer.NO_MATCH)):  # the same images once more
        engine.reset()
        show(engine, route[:LENGTH])
        just = replace(least, min_inliers=accepted.inliers + more)
        engine.change(replace(engine.settings, geometric=just))
        outcome = show(engine, route[5:6], first=5)[0]
        assert (outcome.answer, outcome.inliers) == (answer, accepted.inliers)
    engine.change(replace(engine.settings, geometric=replace(least, min_inliers=5000)))
    rejected = show(engine, route[6:7], first=6)[0]
    assert (rejected.answer, rejected.recognition.place) == (Answer.NO_MATCH, -1)
    assert rejected.recognition.nearest.middle == 4
    assert f'{rejected.inliers} inliers are fewer than 5000' in rejected.reason
    assert len(rejected.candidates) == 2
    engine.change(replace(engine.settings, geometric=None))
    assert answers(show(engine, route[7:8])) == [Answer.MATCH]


def test_the_geometric_check_of_a_map_without_pictures(small_map, route, tmp_path):
    save_map(replace(small_map, thumbnails=()), tmp_path / 'blind.stavpr')
    engine = Engine(settings_of(geometric=GeometricSettings()))
    engine.use(read_map(str(tmp_path / 'blind.stavpr'), engine.settings))
    outcome = show(engine, route[:LENGTH])[-1]
    assert (outcome.answer, outcome.inliers) == (Answer.NO_MATCH, -1)
    assert 'keeps no pictures' in outcome.reason


# ------------------------------------------------ errors in the middle, resets, questions


class Stumbles:
    """A describer, or a thumbnail maker, that does not do when it is asked to."""

    def __init__(self, wrapped):
        self.wrapped, self.error = wrapped, None

    def __call__(self, *arguments):
        if self.error is not None:
            raise self.error
        return self.wrapped(*arguments)


@pytest.mark.parametrize('operation', OPERATIONS)
def test_an_error_in_the_middle_of_an_image_changes_nothing(operation, route, monkeypatch):
    """Another engine does not see the bad images: both say the same of the good ones."""
    engine, other = (
        Engine(settings_of(keyframes=KeyframeSettings(change=0.01)), 'mapping') for _ in range(2)
    )
    for each in (engine, other):
        show(each, route[:30], poses=True)
        as_if_saved(each)
        each.set_operation(operation)
    describe = Stumbles(engine.describer.describe)
    monkeypatch.setattr(engine.describer, 'describe', describe)
    thumbnail = Stumbles(lambda image, width: b'')
    monkeypatch.setattr('stavpr_ros.operation.operations.encode_thumbnail', thumbnail)
    cut_off = message(route[0])
    object.__setattr__(cut_off, 'data', cut_off.data[:100])
    for i, image in enumerate(route[:30] if operation != 'mapping' else route[30:40]):
        broken = engine.process(cut_off, i)
        assert (broken.answer, broken.cause) == (Answer.INVALID_IMAGE, 'invalid: cut off')
        describe.error = ImageError('not finite', kind='features')
        broken = engine.process(message(route[59]), i)
        assert (broken.cause, broken.reason) == ('invalid: features', 'not finite')
        describe.error = FeatureMismatchError('another kind')
        assert engine.process(message(route[59]), i).cause == 'invalid: FeatureMismatchError'
        describe.error = None
        if operation != 'localization':
            thumbnail.error = InputError('no JPEG')
            assert engine.process(message(route[59]), i).cause == 'invalid: InputError'
            thumbnail.error = None
        with pytest.raises(InputError, match='quaternion of zeros'):
            engine.process(message(route[59]), i, np.zeros(7))
        (good,), (expected,) = (show(each, [image], first=50 + i, poses=True) for each in (engine, other))
        assert (good.answer, good.window, good.newest) == (expected.answer, expected.window, expected.newest)
        assert repr(good.candidates) == repr(expected.candidates)
        if good.recognition is not None:
            assert repr(good.recognition.nearest) == repr(expected.recognition.nearest)
    assert stamps_of(engine.places_as_map()) == stamps_of(other.places_as_map())
    assert good.answer is not Answer.WARMING_UP


@pytest.mark.parametrize('operation', ['localization', 'loop_closure'])
def test_a_reset_empties_the_window_and_keeps_the_places(operation, route):
    engine = Engine(settings_of(keyframes=KeyframeSettings(change=0.01)), 'mapping')
    show(engine, route[:30])
    as_if_saved(engine)
    engine.set_operation(operation)
    if operation == 'loop_closure':
        show(engine, route[:30])
    show(engine, route[:LENGTH])
    assert engine.window_fill == LENGTH
    places = len(engine.places)
    engine.reset()
    assert (engine.window_fill, len(engine.places)) == (0, places)
    outcomes = show(engine, route[4 : 4 + LENGTH], first=100)  # the first looks like the last keyframe
    assert answers(outcomes) == [Answer.WARMING_UP] * 4 + [Answer.MATCH]
    assert outcomes[-1].window == tuple((101 + i) * SECOND for i in range(LENGTH))
    if operation == 'loop_closure':
        assert outcomes[-1].first_image == places
    assert outcomes[-1].recognition.newest == 8


def test_relocalize_answers_for_the_window_as_it_is(map_file, route):
    engine = Engine(settings_of())
    with pytest.raises(InputError, match='map_path'):
        engine.relocalize(3)
    engine.set_operation('mapping')
    with pytest.raises(InputError, match='mapping recognises nothing'):
        engine.relocalize(3)
    engine = localizing(map_file, candidates=2)
    for i in range(LENGTH):
        with pytest.raises(InputError, match=f'{i} of 5 images in the window'):
            engine.relocalize(3)
        outcome = show(engine, route[i : i + 1], first=i)[0]
    told, ranked = engine.relocalize(4)
    assert (told.answer, told.recognition, told.window) == (Answer.MATCH, outcome.recognition, outcome.window)
    assert len(ranked) == 4
    assert tuple(ranked[:2]) == outcome.candidates
    assert min(abs(a.place - b.place) for a, b in itertools.combinations(ranked, 2)) > 5
    assert engine.relocalize(0)[1] == []
    engine.process(message(np.zeros((0, 0, 3), np.uint8)), 0)  # bad: the window is as it was
    assert engine.relocalize(4) == (told, ranked)
    engine.reset()
    with pytest.raises(InputError, match='0 of 5'):
        engine.relocalize(3)


# ------------------------------------------------ saving


def test_saving(route, tmp_path, monkeypatch):
    path = tmp_path / 'grown.stavpr'
    engine = Engine(settings_of(mode='paper'), 'loop_closure')
    with pytest.raises(InputError, match='threshold'):
        engine.save(str(path), overwrite=True)
    engine.set_operation('localization')
    with pytest.raises(InputError, match='map_path'):
        engine.save(str(path), overwrite=True)
    engine.set_operation('mapping')
    with pytest.raises(InputError, match='no places'):
        engine.save(str(path), overwrite=True)
    assert not path.exists()
    show(engine, route[:3])
    with pytest.raises(MapFileError, match='make it first'):
        engine.save(str(tmp_path / 'missing' / 'grown.stavpr'), overwrite=True)
    assert (engine.save(str(path), overwrite=False), engine.path, engine.unsaved) == (3, str(path), 0)
    assert stamps_of(load_map(path)) == [1, 2, 3]
    show(engine, route[3:4], first=3)
    with pytest.raises(MapFileError, match='is there already'):
        engine.save(str(path), overwrite=False)
    assert engine.unsaved == 1
    content = path.read_bytes()

    def fails(*arguments):
        raise OSError('the disk is full')

    with monkeypatch.context() as disk:
        disk.setattr(os, 'replace', fails)
        with pytest.raises(MapFileError, match='what was there is untouched'):
            engine.save(str(path), overwrite=True)
    assert (path.read_bytes(), engine.unsaved) == (content, 1)
    assert [file.name for file in tmp_path.iterdir()] == ['grown.stavpr']
    assert engine.save(str(path), overwrite=True) == 4
    assert stamps_of(load_map(path)) == [1, 2, 3, 4]
    assert show(engine, route[4:5], first=4)[0].newest == 4  # and it goes on
