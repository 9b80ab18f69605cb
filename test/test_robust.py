# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mode robust: each option by itself, and all of them on real drives that change in speed, season and view."""

import math

import numpy as np
import pytest
from stavpr_ros.alignment import SequenceSettings, SpatialSettings
from stavpr_ros.demonstration.street import first_traverse, World
from stavpr_ros.errors import FeatureMismatchError, InputError, SettingsError
from stavpr_ros.evaluation.evaluate import recognize_all
from stavpr_ros.evaluation.ground_truth import GroundTruth
from stavpr_ros.evaluation.metrics import best_f1, counts_at, image_matches
from stavpr_ros.evaluation.warp import warp_indices
from stavpr_ros.features import FeatureExtractor, FeatureSettings, LocalFeatures
from stavpr_ros.mapping import build_map, extract_features
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.recognition.loop_closer import LoopCloser
from stavpr_ros.recognition.robust import (
    AHEAD,
    CHANCE,
    evidence,
    expected_second_best,
    FADING,
    Hysteresis,
    LOOP_THRESHOLD,
    MeanCentering,
    MEMORY,
    options_of,
    PAPER,
    PRIOR,
    ROBUST,
    RobustOptions,
    score,
    ZNormalization,
)
from stavpr_ros.recognition.route_features import GROWTH, ROOM, RouteFeatures
from stavpr_ros.sources import open_source
import torch

SHORT = SequenceSettings(length=5, beta=2.0)
WARPS = ('2x', '1.5x', '0.7x', '0.5x', 'vary', 'stop')


def robust(place_map, **changes) -> PlaceRecognizer:
    return PlaceRecognizer(place_map, RecognizerSettings(1.0, mode='robust', **changes))


# ------------------------------------------------ the robust_options


def test_choices_of_options():
    assert options_of('robust') == ROBUST == RobustOptions()
    assert options_of('paper') == PAPER
    assert not PAPER.any
    assert RobustOptions.only('velocity_search') == RobustOptions(
        False, False, False, True, False, False
    )
    assert not ROBUST.without('mean_centering', 'velocity_search').mean_centering
    assert ROBUST.without('mean_centering').velocity_search
    for wrong in (
        lambda: ROBUST.without('hope'),
        lambda: RobustOptions.only('hope'),
        lambda: options_of('hope'),
    ):
        with pytest.raises(SettingsError, match='hope'):
            wrong()
    with pytest.raises(SettingsError, match='chance'):
        RecognizerSettings(1.01, mode='robust')
    with pytest.raises(SettingsError, match='hopeful'):
        RecognizerSettings(0.5, mode='hopeful')


def test_evidence_and_distance():
    assert evidence(-2.0, -0.5) == -3.5
    assert evidence(-2.0, math.nan) == -4.0
    assert score(CHANCE) == score(5.0) == score(math.inf) == 1
    assert score(CHANCE - 2) == pytest.approx(math.exp(-1))
    assert 0 < score(-50) < 1e-9


def test_a_track_fades_and_ends_where_the_place_jumps():
    track = Hysteresis()
    assert track.follow(10, -4.0) == -4.0
    assert track.follow(11, 0.0) == pytest.approx(-4 + FADING)
    assert track.follow(11 + AHEAD, 0.0) == pytest.approx(-4 + 2 * FADING)
    assert track.follow(13 + AHEAD, -6.0) == -6.0
    assert track.follow(14 + 2 * AHEAD, 0.5) == 0.5
    assert track.follow(12 + 2 * AHEAD, 0.25) == 0.25  # two back


def test_centering_takes_the_mean_off_and_leaves_zeros():
    generator = torch.Generator().manual_seed(0)
    strips = torch.rand((3, 40, 8), generator=generator)
    strips /= strips.norm(dim=2, keepdim=True)
    strips[1, 5] = 0
    settings = FeatureSettings('gradient', None, 3)
    mean_centering = MeanCentering(LocalFeatures(strips, torch.ones(3, 40), settings))
    centered = mean_centering.places(LocalFeatures(strips, torch.ones(3, 40), settings)).strips
    mean = strips.mean(dim=1)
    for j in range(3):
        for y in (0, 5, 39):
            expected = strips[j, y] - mean[j] if strips[j, y].any() else torch.zeros(8)
            expected = expected / max(float(expected.norm()), 1e-12)
            torch.testing.assert_close(centered[j, y], expected)
    seen = strips[:, :2]
    mean_centering.next_query(seen[:, 0])
    second = mean_centering.next_query(seen[:, 1])
    query_mean = (PRIOR * mean + seen[:, 0] + seen[:, 1]) / (PRIOR + 2)
    expected = seen[:, 1] - query_mean
    torch.testing.assert_close(second, expected / expected.norm(dim=1, keepdim=True))
    mean_centering.reset()
    first = mean_centering.next_query(seen[:, 1])
    assert not torch.allclose(first, second)


def test_centering_forgets_no_image_of_a_long_query():
    """An image that stays the same is off the mean so far in one direction, however near the mean comes."""
    generator = torch.Generator().manual_seed(0)
    places = torch.rand((2, 3, 8), generator=generator)
    strips = torch.rand((2, 8), generator=generator)
    mean_centering = MeanCentering(
        LocalFeatures(places, torch.ones(2, 3), FeatureSettings('gradient', None, 2))
    )
    first = mean_centering.next_query(strips)
    for _ in range(5000):
        last = mean_centering.next_query(strips)
    torch.testing.assert_close(last, first, rtol=0, atol=1e-4)


def test_calibration_is_the_running_mean_and_variance():
    """Against a plain recursion: prior rows, then every row with weight 1 / count, at least 1 / MEMORY."""
    rng = np.random.default_rng(0)
    start, rows = rng.normal(3, 2, (6, 9)), rng.normal(1, 4, (MEMORY + 40, 9)).astype(np.float32)
    start[2, 2:5] = np.nan
    calibration = ZNormalization(9)
    calibration.start_from(start)

    normal = (start - np.nanmean(start, 1)[:, None]) / np.nanstd(start, 1)[:, None]
    mean, variance = np.nanmean(normal, 0), np.nanvar(normal, 0)
    count = float(PRIOR)
    for came in rows:
        row = (came.astype(float) - came.mean()) / came.std()
        count = min(count + 1, MEMORY)
        off = row - mean
        mean = mean + off / count
        variance = variance + (off * (row - mean) - variance) / count
        found = calibration.normalized(rows[0])
        calibration.observe(row.astype(np.float32))
    np.testing.assert_allclose(found, (rows[0] - rows[0].mean()) / rows[0].std(), atol=1e-5)
    shift, scale = calibration.shift_and_scale(9)
    np.testing.assert_allclose(shift, mean, atol=1e-4)
    np.testing.assert_allclose(scale, 1 / np.sqrt(variance), rtol=1e-4)
    calibration.reset()
    np.testing.assert_allclose(calibration.shift_and_scale(9)[0], np.nanmean(normal, 0), atol=1e-6)


def test_calibration_of_maps_too_small_to_know_themselves():
    calibration = ZNormalization(3)
    calibration.start_from(np.full((3, 3), np.nan))
    np.testing.assert_array_equal(calibration.shift_and_scale(3), ([0, 0, 0], [1, 1, 1]))
    flat = calibration.normalized(np.full(3, 0.5, np.float32))
    np.testing.assert_array_equal(flat, [0, 0, 0])


# ------------------------------------------------ the recognizer with them


def test_the_map_recognizes_itself(small_map):
    answers = recognize_all(robust(small_map, sequence=SHORT, nms_radius=5), small_map.features)
    for i, answer in enumerate(answers[4:], start=4):
        assert answer.status is Status.MATCH
        assert (answer.place_index, answer.newest_index) == (i - 2, i)
        assert answer.path.tolist() == [[row, i - 4 + row] for row in range(5)]
        assert 0 <= answer.sequence.distance < 0.5
        assert answer.sequence.second_best_distance > answer.sequence.distance


def test_a_reset_recognizer_is_a_new_one(small_map):
    one = robust(small_map, sequence=SHORT, nms_radius=5)
    first = [a.sequence for a in recognize_all(one, small_map.features[20:40])]
    recognize_all(one, small_map.features[:30])
    assert [a.sequence for a in recognize_all(one, small_map.features[20:40])] == first


def test_what_is_no_nearer_than_chance_is_no_answer(small_map, route):
    rng = np.random.default_rng(1)
    elsewhere = [rng.integers(0, 256, (96, 128, 3), np.uint8) for _ in range(40)]
    query = FeatureExtractor(projection=64).extract(elsewhere)
    answers = recognize_all(robust(small_map, sequence=SHORT, nms_radius=5), query)[4:]
    matched = [a for a in answers if a.status is Status.MATCH]
    assert len(matched) <= len(answers) / 10
    for answer in answers:
        if answer.status is not Status.MATCH:
            assert answer.sequence.distance == 1
            assert math.isinf(answer.score)
            assert answer.place_index == -1


@pytest.mark.parametrize(
    'without',
    [
        '',
        'mean_centering',
        'query_znorm',
        'reference_znorm',
        'velocity_search',
        'second_best_margin',
    ],
)
@pytest.mark.parametrize('strategy', ['adaptive', 'none'])
def test_every_choice_of_cures_works(small_map, without, strategy):
    robust_options = ROBUST.without(without) if without else ROBUST
    settings = RecognizerSettings(
        1e6, SpatialSettings(strategy), SHORT, 5, mode='robust', robust_options=robust_options
    )
    one = PlaceRecognizer(small_map, settings)
    answers = recognize_all(one, small_map.features[10:30])
    middles = [a.sequence.middle for a in answers[4:]]
    assert np.mean(np.abs(np.array(middles) - np.arange(12, 28)) <= 1) > 0.9
    assert int(np.argmin(one.newest_row())) == 29
    places, distances = one.candidates(7)
    assert places[0] == answers[-1].sequence.middle
    assert len(set(places.tolist())) == len(places) == 7
    assert (np.diff(distances) >= 0).all()


def test_candidates_in_mode_paper(small_map):
    one = PlaceRecognizer(small_map, RecognizerSettings(1.0, sequence=SHORT))
    answer = recognize_all(one, small_map.features[10:20])[-1]
    places, distances = one.candidates(3)
    assert (places[0], distances[0]) == (
        answer.sequence.middle,
        np.float32(answer.sequence.distance),
    )
    assert int(np.argmin(one.newest_row())) == 19


# ------------------------------------------------ loop closure


def features_of(strips):
    return LocalFeatures(
        strips, torch.ones(strips.shape[:2]), FeatureSettings('gradient', None, 7)
    )


@pytest.fixture(scope='module')
def laps():
    """Two laps and a half of a round of 150 places, seen with noise."""
    rng = np.random.default_rng(0)
    places = rng.standard_normal((7, 150, 16))
    strips = places[:, np.arange(375) % 150] + 0.4 * rng.standard_normal((7, 375, 16))
    strips /= np.linalg.norm(strips, axis=2, keepdims=True)
    return features_of(torch.from_numpy(strips).float())


@pytest.mark.parametrize('mode', ['paper', 'robust'])
def test_laps_are_closed(laps, mode):
    """Beyond the first room for images, so that growing is seen as well."""
    assert len(laps) > ROOM
    settings = RecognizerSettings(1.0 if mode == 'robust' else 0.9, mode=mode)
    closer = LoopCloser(settings, 30, laps.settings)
    answers = [closer.update(laps[i : i + 1]) for i in range(len(laps))]
    assert len(closer) == 375
    first_lap = [a for a in answers[:150] if a.status is Status.MATCH]
    assert not first_lap or mode == 'paper'
    for i in range(180, 375):
        assert (i - answers[i].newest_index) % 150 == 0
        assert answers[i].newest_index < i - 30
        assert answers[i].status is Status.MATCH


def test_the_latest_images_are_no_places(laps):
    closer = LoopCloser(RecognizerSettings(1.0, mode='robust'), 30, laps.settings)
    still = features_of(laps.strips[:, :1].repeat(1, 60, 1))
    for i in range(60):
        answer = closer.update(still[i : i + 1])
        if answer.sequence is not None:
            assert answer.path[:, 1].max() < i - 29
    assert len(closer.newest_row()) == 30


def test_route_features_grown_are_centered_by_a_mean_at_most_an_eighth_old(laps):
    route = RouteFeatures(laps.settings, True, None)
    for i in range(100):
        route.append(laps[i : i + 1])
    counts = [1]
    while counts[-1] < 100:
        counts.append(int(counts[-1] * GROWTH) + 1)
    last = max(count for count in counts if count <= 100)
    mean = laps.strips[:, :last].mean(dim=1, keepdim=True)
    expected = laps.strips[:, :100] - mean
    expected /= expected.norm(dim=2, keepdim=True)
    torch.testing.assert_close(route.strips[:, :100], expected, atol=1e-5, rtol=0)


def test_what_a_loop_closer_refuses(laps, small_map):
    settings = RecognizerSettings(1.0, mode='robust')
    closer = LoopCloser(settings, 30, laps.settings)
    with pytest.raises(SettingsError, match='exclude'):
        LoopCloser(settings, 0, laps.settings)
    with pytest.raises(SettingsError, match='none'):
        LoopCloser(RecognizerSettings(1.0, SpatialSettings('none')), 30, laps.settings)
    alone = RecognizerSettings(1.0, mode='robust', robust_options=ROBUST.without('query_znorm'))
    with pytest.raises(SettingsError, match='take both or neither'):
        LoopCloser(alone, 30, laps.settings)
    with pytest.raises(InputError, match='2 images'):
        closer.update(laps[:2])
    with pytest.raises(FeatureMismatchError):
        closer.update(small_map.features[:1])
    with pytest.raises(InputError, match='not finite'):
        closer.update(features_of(torch.full((7, 1, 16), math.nan)))
    assert len(closer) == closer.window_fill == 0


# ------------------------------------------------ real drives: the numbers that the README states


@pytest.fixture(scope='module')
def drives(data_folder):
    """The gradient features of every drive, by its folder."""
    extractor, known = FeatureExtractor(), {}

    def drive(name):
        if name not in known:
            known[name] = extract_features(
                open_source(data_folder / name), extractor, progress=False
            )
        return known[name]

    return drive


def as_map(features):
    n = len(features)
    from stavpr_ros.mapping import PlaceMap

    return PlaceMap(features, None, np.zeros(n, np.int64), ('',) * n)


def judged(reference, query, truth):
    """Best F1, and the precision at the default threshold."""
    answers = image_matches(recognize_all(robust(as_map(reference)), query), 20)
    correct = truth.accepts(answers.places)
    return best_f1(answers.distances, correct).f1, counts_at(
        1.0, answers.distances, correct
    ).precision


def taken(features, indices):
    rows = torch.from_numpy(np.asarray(indices))
    return LocalFeatures(features.strips[:, rows], features.weights[:, rows], features.settings)


def test_gardens_point_at_every_speed(drives):
    reference, query = drives('gardens_point/day_left'), drives('gardens_point/day_right')
    truth = GroundTruth.identity(200, 200, 2)
    f1, precision = judged(reference, query, truth)
    print(f'Gardens Point, robust, gradient: F1 {f1:.4f}, precision {precision:.4f}')
    assert f1 >= 0.99
    assert precision >= 0.95
    for kind in WARPS:
        indices = warp_indices(200, kind)
        f1, precision = judged(reference, taken(query, indices), truth.select(indices))
        print(f'Gardens Point {kind}: F1 {f1:.4f}, precision {precision:.4f}')
        assert f1 >= 0.95
        assert precision >= 0.93


def test_nordland_through_the_seasons(drives):
    reference, query = drives('nordland_64x32/summer'), drives('nordland_64x32/winter')
    f1, precision = judged(reference, query, GroundTruth.identity(1788, 1788, 3))
    print(f'Nordland 64x32, robust, gradient: F1 {f1:.4f}, precision {precision:.4f}')
    assert f1 >= 0.95
    assert precision >= 0.95


def test_a_corridor_that_looks_alike(drives, data_folder):
    truth = GroundTruth.from_file(data_folder / 'corridor' / 'ground_truth.csv', 111, 111, 0)
    f1, precision = judged(drives('corridor/ref'), drives('corridor/query'), truth)
    print(f'corridor, robust, gradient: F1 {f1:.4f}, precision {precision:.4f}')
    assert f1 >= 0.95
    assert precision >= 0.95


@pytest.mark.parametrize(
    'route', ['gardens_point/day_left', 'nordland_64x32/summer', 'corridor/ref']
)
@pytest.mark.parametrize(
    'query', ['gardens_point/day_right', 'nordland_64x32/winter', 'corridor/query']
)
def test_other_routes_are_not_matched(drives, route, query):
    if route.split('/')[0] == query.split('/')[0]:
        pytest.skip('the same route')
    answers = recognize_all(robust(as_map(drives(route))), drives(query))[19:]
    alarms = np.mean([answer.status is Status.MATCH for answer in answers])
    print(f'{query} on the map of {route}: {alarms:.3f} false alarms')
    assert alarms <= 0.05


def test_the_hallway_is_closed(drives, data_folder):
    features = drives('rtabmap_hallway_loop/samples')
    truth = GroundTruth.from_file(
        data_folder / 'rtabmap_hallway_loop' / 'samples_GT.bmp', 84, 84, 0
    )
    truth = truth.loop_closures(19)
    assert truth.has_match.sum() == 44
    closer = LoopCloser(RecognizerSettings(1.0, mode='robust'), 20, features.settings)
    answers = [closer.update(features[i : i + 1]) for i in range(84)]
    answered = image_matches(answers, 20)
    score = counts_at(1.0, answered.distances, truth.accepts(answered.places), truth.has_match)
    print(f'hallway: precision {score.precision:.3f}, recall {score.recall:.3f}')
    assert score.precision >= 0.95
    assert score.recall >= 0.8


@pytest.mark.parametrize('name', ['gardens_point', 'corridor'])
def test_with_a_network(data_folder, squeezenet_settings, name):
    extractor = FeatureExtractor('onnx', squeezenet_settings)
    if name == 'corridor':
        route, query = 'corridor/ref', 'corridor/query'
        truth = GroundTruth.from_file(data_folder / 'corridor' / 'ground_truth.csv', 111, 111, 0)
    else:
        route, query = 'gardens_point/day_left', 'gardens_point/day_right'
        truth = GroundTruth.identity(200, 200, 2)
    place_map = build_map(open_source(data_folder / route), extractor, progress=False)
    found = extract_features(open_source(data_folder / query), extractor, progress=False)
    f1, precision = judged(place_map.features, found, truth)
    print(f'{name}, robust, SqueezeNet: F1 {f1:.4f}, precision {precision:.4f}')
    assert f1 >= (0.99 if name == 'gardens_point' else 0.95)
    assert precision >= 0.94


@pytest.mark.parametrize(
    ('other', 'rivals', 'expected'),
    [(-0.3, 20, -0.3), (-0.3, 19, -0.8), (-1.4, 3, -1.4), (math.nan, 0, -0.8)],
)
def test_few_rivals_give_no_lead(other, rivals, expected):
    assert expected_second_best(other, rivals) == expected


def test_a_route_that_has_just_begun_closes_no_loops_by_chance():
    """Three streets of the made-up world, driven once: nothing can be right, and chance had a lead before."""
    extractor = FeatureExtractor()
    for seed in (3, 7, 11):
        images = [
            frame.image for frame, _ in zip(first_traverse(World(seed)), range(130), strict=False)
        ]
        features = extractor.extract(images)
        closer = LoopCloser(
            RecognizerSettings(LOOP_THRESHOLD, mode='robust'), 50, features.settings
        )
        found = [closer.update(features[i : i + 1]).place_index for i in range(len(images))]
        assert sum(place >= 0 for place in found) <= 2
