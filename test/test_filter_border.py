# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The public classes of the filter, with arguments that do not fit: an error, and no change."""

import numpy as np
from places import features_of, route_strips
import pytest
from stavpr_ros.alignment import best_match, SequenceDistances, SpatialSettings
from stavpr_ros.errors import InputError, SettingsError, StavprError
from stavpr_ros.filter import FilterSettings, PlaceFilter
from stavpr_ros.prepare import make_matcher, prepare_map, z_normalized

pytestmark = pytest.mark.usefixtures('one_thread')
N, LAG, V = 100, 4, len(FilterSettings().speeds)
SAME, Z, S = np.ones(V), np.zeros(N, np.float32), FilterSettings()
NAN, INF = float('nan'), float('inf')


def changed(values, *pairs):
    out = np.array(values)
    for index, value in pairs:
        out[index] = value
    return out


def driven(*gaps):
    one, rng = PlaceFilter(N, LAG, gaps=np.array(gaps, np.int64)), np.random.default_rng(0)
    for image in range(8):
        one.update(changed(rng.standard_normal(N, np.float32), (20 + image, -4)), 0.28, SAME)
    return one


STATE = driven().belief(N, 0).states[0]
WRONG_CALLS = [
    *(('update', z, 0.3, SAME) for z in (np.zeros(3 * N, np.float32), Z[None], Z.astype(int))),
    *(('update', changed(Z, (3, value)), 0.3, SAME) for value in (NAN, -INF)),
    *(('update', Z, change, SAME) for change in (NAN, -0.1, INF, '0.3')),
    *(('update', Z, 0.3, speeds) for speeds in (SAME[1:], changed(SAME, (1, -1)), 0 * SAME)),
    ('update', Z, 0.3, SAME, np.ones(3)), ('update', Z, 0.3, SAME, changed(SAME, (1, INF))),
    *(('update', Z, 0.3, SAME, SAME, np.array([place])) for place in (N, -1, True)),
    ('evict', N + 1), ('evict', -1), ('evict', 0.5), ('grow', N - 1), ('grow', N + 0.5),
    ('belief', 10 * N, 0), ('belief', N, LAG + 1), ('belief', N, -1), ('path', STATE, LAG + 1),
    *(('path', changed(STATE, wrong), 1) for wrong in ((0, 99), (1, V), (2, 10**9))),
    ('most_probable', np.array([5, 3])), ('move_back', slice(10, 20), 15),
    ('move_back', slice(90, 110), 30), ('move_back', slice(50, 70), 10),
]  # fmt: skip


@pytest.mark.parametrize('call', WRONG_CALLS)
def test_arguments_that_do_not_fit_are_an_error_and_change_nothing(call):
    """Kernels trust shapes: a place more than there is room for ends the process."""
    one, expected = driven(), driven()
    with pytest.raises(StavprError):
        getattr(one, call[0])(*call[1:])
    for each in (one, expected):
        each.update(Z, 0.3, SAME)
    np.testing.assert_array_equal(one.places_of_states(), expected.places_of_states())


def test_error_names_what_came_and_what_was_expected():
    with pytest.raises(InputError, match='z of 4 places: expected 11 to 100'):
        driven(9, 10).update(np.zeros(4, np.float32), 0.3, SAME)
    for arguments in (-1, LAG), (2.5, LAG), (N, 0), (N, LAG, S, np.array([5, 4])):
        with pytest.raises(StavprError):
            PlaceFilter(*arguments)


WRONG_VALUES = {
    'speeds': [(), (0.0, NAN), (-1.0, 1.0), (1.0, 1.0), (127.0,), ('a',)],
    'levels': [(), (1.0,), (-2.0, -1.0), (-INF,), ((-1.0,),)],
    **{name: [-1, NAN, '1'] for name in ('weight', 'standstill', 'speed_weight')},
    **{name: [1.5, NAN] for name in ('keep_level', 'start', 'spread', 'keep_speed')},
    **{'enter': [1.0, NAN], 'leave': [0.0, 1.0], 'most_change': [0.1, INF]},
    **{'least_change': [-1, 3.0], 'change_deviation': [0.0, NAN]},
}


@pytest.mark.parametrize('name', WRONG_VALUES)
def test_settings_that_are_no_model_are_rejected_by_name(name):
    for value in WRONG_VALUES[name]:
        with pytest.raises(SettingsError, match=name.replace('least', '(least|most)')):
            FilterSettings(**{name: value})


@pytest.mark.parametrize('speeds', [tuple(0.25 * v for v in range(17)), (0.0, 126.0)])
@pytest.mark.parametrize('kind', ['cpu', 'device'])
def test_models_of_many_or_fast_speeds_follow_the_camera(speeds, kind):
    """Paths, which pack place and speed on a device, and steps of almost a block of memory."""
    n, s, rng, as_z = 4200, FilterSettings(speeds=speeds), np.random.default_rng(2), np.asarray
    one = PlaceFilter(n, LAG, s)
    if kind == 'device':
        as_z = pytest.importorskip('torch').from_numpy
        from stavpr_ros.filter.device_filter import DevicePlaceFilter

        one = DevicePlaceFilter(n, LAG, s, device='cpu')
    places = 1000 + np.rint(speeds[-1] * np.arange(25)).astype(int)
    for place in places:
        z = changed(rng.standard_normal(n, np.float32), (place, -6))
        one.update(as_z(z), 0.5, np.ones(len(speeds)))
    belief = one.belief(n, LAG)
    best = belief.weights.argmax()
    assert one.path(belief.states[best], LAG)[::-1].tolist() == places[-1 - LAG :].tolist()
    with pytest.raises(InputError, match='z'):
        one.update(as_z(np.zeros(n + 1, np.float32)), 0.5, np.ones(len(speeds)))


@pytest.mark.parametrize(('precision', 'strategy'), [('float32', 'none'), ('int8', 'adaptive')])
def test_other_kernels_reject_arrays_of_other_shapes(precision, strategy):
    features = features_of(route_strips(0, 40))
    prepared = prepare_map(features, precision)
    matcher = make_matcher(prepared.features, SpatialSettings(strategy), 'cpu', precision)
    image, weights = features.strips[:, 0], features.weights[:, 0]
    for function, arguments, words in [
        (matcher.distances, (image[:, :-1], weights), r'strips: shape .*, expected \(7, n, 24\)'),
        (matcher.distances, (image, weights[:3]), r'weights: shape \(3, 1\)'),
        (prepared.centering.next_query, (image[:-1],), r'strips: shape .*, expected \(7, 24\)'),
        (z_normalized, (np.ones(9, np.float32), None, np.ones(3, bool)), 'counted: shape'),
        (best_match, (SequenceDistances(np.ones(9), np.ones(3, int)), 2), 'lengths: shape'),
    ]:
        with pytest.raises(InputError, match=words):
            function(*arguments)
