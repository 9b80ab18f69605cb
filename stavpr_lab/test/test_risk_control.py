# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Risks of blocks by hand, the guarantee on simulated blocks, and ``evaluate --calibrate``."""

from dataclasses import replace
import stat
from unittest.mock import patch

import cv2
from evaluation_commands import read_json, write_images
from fixtures import disk_of, route_images
import numpy as np
import pytest
from stavpr_lab.commands import evaluate, evaluate_calibrate
from stavpr_lab.evaluation.drive import DriveChanges
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import ImageMatches
from stavpr_lab.evaluation.risk_control import add_risks, make_drives, measure_risks, PROBABILITIES
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, load_map, open_map, save_map
from stavpr_ros.mapping.place_map import ErrorRisks
from stavpr_ros.method.error_rate import least_probability
from stavpr_ros.prepare import prepared_map
from stavpr_ros.sources import open_source

PLACES, NAN = 60, float('nan')


def drive_of(truth, places, probabilities, **changes):
    """Return a drive, its matches, and their images; matches beyond are early ones, of image 0."""
    drive, none = DriveChanges(**changes).apply(truth), ImageMatches.none(len(places))
    matches = replace(none, places=np.array(places), probabilities=np.array(probabilities))
    images = np.arange(len(places))
    return drive, matches, np.where(images < len(drive.images), images, 0)


def risk_at(risks, probability):
    return risks.risks[np.searchsorted(PROBABILITIES, probability)]


def test_risks_of_two_blocks_by_hand():
    """Above .9 the only match of the first block at double speed is wrong: 1, and so below."""
    truth = GroundTruth.identity(5, 5)
    recorded = drive_of(truth, [0, 4, 2, 3, -1], [0.9, 0.5, 0.3, NAN, NAN])
    risks = measure_risks([recorded], 2, 'x')
    assert (risks.units, risks.method) == (2, 'x')
    assert [risk_at(risks, p) for p in (0.15, 0.4, 0.6, 0.95)] == [0.5, 0.5, 0, 0]
    double = drive_of(truth, [3, 2, 4], [0.99, 0.95, 0.99], speed=2)
    risks = measure_risks([recorded, double], 2, 'x')
    assert [risk_at(risks, p) for p in (0.15, 0.95, 0.995)] == [1, 1, 0]
    early = drive_of(truth, [0, 4, 2, 3, -1, 2], [0.9, 0.5, 0.3, NAN, NAN, 0.96])
    assert risk_at(measure_risks([early], 2, 'x'), 0.95) == 1


def test_risk_of_a_block_off_the_map_is_the_share_of_matched_images():
    truth = GroundTruth.from_pairs([0, 1], [0, 1], 4, 4)
    risks = measure_risks([drive_of(truth, [0, 1, 3, -1], [0.9, 0.9, 0.6, NAN])], 2, 'x')
    assert [risk_at(risks, p) for p in (0.5, 0.7)] == [0.5, 0]


def test_images_beside_a_removed_stretch_do_not_count():
    """Of images 10 .. 29 without a place, those matched with its edge are not wrong."""
    truth = GroundTruth.identity(40, 40)
    places = np.r_[:10, np.full(5, 9), np.full(15, -1), 10:20]
    for image, place, risk in ((20, -1, 0), (20, 3, 1 / 61)):
        places[image] = place
        recorded = drive_of(truth, np.arange(40), np.full(40, 0.9))
        matched = np.where(places < 0, NAN, 0.9)
        detour = drive_of(truth, places, matched, removed=((10, 30),))
        assert measure_risks([recorded, detour], 40, 'x').risks[0] == pytest.approx(risk, abs=1e-6)


def test_made_drives_leave_each_place_out_once():
    truth = GroundTruth.identity(130, 130)
    *drives, first, second, third = make_drives(truth, 40)
    assert [len(drive.images) for drive in drives][:3] == [130, 260, 65]
    assert not any(drive.removed for drive in drives)
    assert first.removed == ((0, 40), (120, 130))
    kept = np.bincount(np.concatenate([drive.places for drive in (first, second, third)]))
    assert kept.tolist() == [2] * 130
    assert not any(drive.removed for drive in make_drives(GroundTruth.identity(40, 40), 40))


def test_joined_risks_add_blocks_and_count_what_was_not_measured_as_wrong():
    one = ErrorRisks('x', 4, (0.2, 0.5, 0.9), (2.0, 1.0, 0.0))
    other = ErrorRisks('x', 3, (0.4, 0.6), (1.5, 0.5))
    assert add_risks(one, other) == ErrorRisks('x', 7, (0.2, 0.5, 0.9), (5.0, 2.5, 0.5))


def wrong_blocks(declared):
    """Return the risks of blocks of one image each, which is matched wrongly."""
    count = len(declared)
    truth = GroundTruth.identity(count + 1, count + 1).select(np.arange(count))
    return measure_risks([drive_of(truth, np.full(count, count), declared)], 1, 'x')


@pytest.mark.parametrize(('blocks', 'rate'), [(10, 0.1), (30, 0.2)])
def test_error_rate_of_a_new_block_is_kept_in_the_mean(blocks, rate):
    """The mean of as many blocks alone would choose a probability that does not keep it."""
    rng, result = np.random.default_rng(0), []
    for _ in range(1500):
        declared = 1 / (1 + np.exp(-rng.uniform(-1.5, 6.5, blocks + 1)))
        risks, new = wrong_blocks(declared[:-1]), declared[-1]
        by_mean = PROBABILITIES[np.argmax(np.array(risks.risks) / blocks <= rate)]
        result.append((new > least_probability(rate, risks), new > by_mean))
    kept, by_mean = np.mean(result, axis=0)
    error = 3 * np.sqrt(rate * (1 - rate) / len(result))
    assert rate / 2 < kept <= rate + error / 3
    assert by_mean > rate + error


@pytest.fixture(scope='module')
def traverses(tmp_path_factory):
    """Write the images of a map and a darker query with noise, and the saved map."""
    folder, rng = tmp_path_factory.mktemp('traverses'), np.random.default_rng(1)
    first = route_images(PLACES)
    second = [np.clip(0.5 * image + rng.normal(0, 40, image.shape), 0, 255) for image in first]
    write_images(folder / 'map', first)
    write_images(folder / 'query', [image.astype(np.uint8) for image in second])
    extractor = FeatureExtractor('gradient')
    place_map = build_map(open_source(folder / 'map'), extractor, progress=False)
    with patch.object(prepared_map, 'MIN_PLACES', 1):
        learned = prepared_map.statistics_of_map(place_map, 'float16')
        learned = prepared_map.with_codes(learned, place_map, 'float16')
    save_map(place_map, folder / 'route.stavpr', 'float16', statistics=learned)
    return folder


@pytest.fixture
def command(traverses, tmp_path, set_constants, runner):
    """Return the path of a copy of the map, and a function that evaluates the query on it."""
    path, run = tmp_path / 'route.stavpr', runner(evaluate)
    path.write_bytes((traverses / 'route.stavpr').read_bytes())
    pair = ['--map', path, '--query', traverses / 'query', '--truth', 'identity']
    set_constants(prepared_map, MIN_PLACES=1)
    return path, lambda *options: run(*pair, '--sequence-length', 5, *options)


def test_calibration_in_a_map_is_that_of_max_error(command, traverses, tmp_path):
    path, run = command
    before = open_map(path)
    code, output, errors = run('--calibrate')
    assert (code, ': 6 blocks of 10 images' in output) == (0, True), errors
    after = open_map(path)
    risks, statistics = after.error_risks, after.features.statistics
    assert (after.features.storage, after.features.has_codes) == ('float16', True)
    assert np.array_equal(statistics.changes, before.features.statistics.changes)
    assert tuple(after.thumbnails) == tuple(before.thumbnails)
    assert np.array_equal(after.features.strips, before.features.strips)
    assert (risks.units, f'id {after.map_id}' in output) == (6, True)
    assert after.map_id == before.map_id  # it names the places
    for options, probability, is_noted in (
        (['--max-error', 0.2], least_probability(0.2, risks), False),
        (['--max-error', 0.1], least_probability(0.1, risks), True),
        (['--max-error', 0.2, '--beta', 3], least_probability(0.2), True),
    ):
        code, output, errors = run(*options, '--json', tmp_path / 'out.json', '--force')
        assert (code, 'not kept by the calibration' in output) == (0, is_noted), errors
        result = read_json((tmp_path / 'out.json').read_text())['default_threshold']
        assert result['threshold'] == pytest.approx(1 - probability)
    assert least_probability(0.2, risks) != pytest.approx(least_probability(0.2))
    content = path.read_bytes()
    code, output, errors = run('--calibrate', 'add')  # the same recording counts once
    assert (code, 'is in the calibration already' in output) == (0, True), errors
    assert path.read_bytes() == content
    assert run('--calibrate')[0] == 0
    assert path.read_bytes() == content
    other = [cv2.imread(str(file))[..., ::-1] for file in sorted(traverses.glob('query/*'))]
    write_images(tmp_path / 'other', [image // 2 for image in other])
    code, output, errors = run('--query', tmp_path / 'other', '--calibrate', 'add')
    assert (code, '12 blocks in all keep 0.0769' in output) == (0, True), errors
    both = open_map(path)
    assert (both.map_id, both.error_risks.units) == (before.map_id, 12)
    assert (both.error_risks.recordings[0],) == risks.recordings
    code, output, errors = run('--calibrate', 'add')
    assert (code, 'is in the calibration already' in output) == (0, True), errors


def test_calibration_that_fails_leaves_the_map_as_it_is(command, monkeypatch, traverses):
    path, run = command
    content = path.read_bytes()
    with disk_of(1000):
        code, _, errors = run('--calibrate')
    assert (code, 'what was there is untouched' in errors) == (1, True), errors
    assert path.read_bytes() == content
    assert list(path.parent.iterdir()) == [path]
    path.chmod(0o444)
    code, _, errors = run('--calibrate')
    assert (code, 'is write-protected: chmod u+w' in errors) == (1, True), errors
    assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (content, 0o444)
    path.chmod(0o644)
    other = replace(load_map(path), threshold=0.5)

    def replace_map(*arguments):
        save_map(other, path, force=True)
        return measure_risks(*arguments)

    monkeypatch.setattr(evaluate_calibrate, 'measure_risks', replace_map)
    code, _, errors = run('--calibrate')
    assert (code, 'was replaced meanwhile' in errors) == (2, True), errors
    assert (open_map(path).threshold, open_map(path).error_risks) == (0.5, None)


@pytest.mark.parametrize(
    ('options', 'word'),
    [
        (['--speed', '2x'], 'leave --speed out'),
        (['--max-error', 0.1], 'leave --max-error out'),
        (['--json', 'x'], 'leave --json out'),
        (['--protocol'], '--protocol: leave --calibrate out'),
        (['--mode', 'paper'], 'and --mode robust'),
        (['--map', __file__], 'is no saved map'),
        (['--calibrate', 'add'], 'has no calibration of these settings'),
        (['--query', 'a', 'b'], '--calibrate goes with one --query'),
    ],
)
def test_options_that_contradict_a_calibration_are_rejected(command, options, word):
    path, run = command
    content = path.read_bytes()
    code, _, errors = run('--calibrate', *options)
    assert (code, word in errors) == (2, True), errors
    assert path.read_bytes() == content
