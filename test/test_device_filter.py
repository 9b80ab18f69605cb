# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recognizer on devices of torch against the one on the CPU."""

import numpy as np
from places import features_of, map_of, route_strips
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping import Session
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.method.device import z_normalized_on_device
from stavpr_ros.method.settings import RobustOptions
from stavpr_ros.prepare.centering import z_normalized
import torch

pytestmark = pytest.mark.usefixtures('one_thread')


def test_z_normalized_equals_that_of_cpu(device):
    row = np.random.default_rng(0).uniform(0.2, 1, 150).astype(np.float32)
    row[[7, 149]] = np.inf
    flat, banned = np.full(5, 0.5, np.float32), np.full(3, np.inf, np.float32)
    for values in (row, row[:5], flat, banned):
        for counted in (np.ones(len(values), bool), np.arange(len(values)) % 3 > 0):
            arguments = (torch.from_numpy(each).to(device) for each in (values, counted))
            found = z_normalized_on_device(*arguments).cpu()
            np.testing.assert_allclose(found, z_normalized(values, counted=counted), atol=1e-5)


def drive_map(sessions):
    """Return a map of 120 places, of one session or of two, and the features of a drive."""
    strips = route_strips(0, 60)
    strips[:, 30:34] = strips[:, 30:31]  # the map's camera stood
    places, parts = features_of(strips), {}
    if sessions:
        places = features_of(np.concatenate([strips, strips], axis=1), 0.4, 1)
        same_as = np.arange(120, dtype=np.int32)
        same_as[60:] -= 60
        index = np.repeat(np.arange(2, dtype=np.int32), 60)
        parts = {
            'sessions': (Session('a'), Session('b')), 'session_index': index, 'same_as': same_as
        }  # fmt: skip
    driven = [*range(8, 20), *[20] * 9, *range(20, 60), *[59] * 3]  # it stands at 20, and leaves
    query = features_of(strips[:, driven], 0.3, 2)
    query.strips[:, 13:21] = query.strips[:, 12:13]
    query.strips[:, -3:] = features_of(route_strips(9, 3)).strips
    return map_of(places, **parts), query


@pytest.mark.parametrize('sessions', [False, True], ids=['session', 'sessions'])
@pytest.mark.parametrize(
    ('mode', 'precision'), [('robust', 'float32'), ('robust', 'int8'), ('paper', 'float32')]
)
def test_recognizer_equals_that_of_cpu(device, mode, precision, sessions):
    place_map, query = drive_map(sessions)
    settings = RecognizerSettings(
        0.8 if mode == 'paper' else None, sequence=SequenceSettings(8), nms_radius=5, mode=mode
    )
    cpu, one = (
        PlaceRecognizer(place_map, settings, backend, precision) for backend in ('cpu', device)
    )
    statuses = set()
    for i in range(len(query)):
        found, expected = (each.update(query[i : i + 1], i + 1) for each in (one, cpu))
        assert found.status == expected.status
        assert found.window_stamps == expected.window_stamps
        assert found.window_changes == expected.window_changes
        statuses.add(expected.status)
        np.testing.assert_allclose(one.newest_row(), cpu.newest_row(), atol=2e-5)
        if expected.path.place < 0:
            continue
        assert found.distance == pytest.approx(expected.distance, abs=1e-5)
        if mode == 'robust':
            assert found.probability == pytest.approx(expected.probability, abs=1e-5)
        if not expected.accepted:
            continue
        assert found.path.place == expected.path.place
        np.testing.assert_array_equal(found.path.pairs, expected.path.pairs)
        places = [[each.place for each in recognizer.ranked(2)] for recognizer in (one, cpu)]
        assert places[0] == places[1]
    assert {Status.WARMING_UP, Status.MATCH} <= statuses
    one.reset()
    assert one.update(query[:1]).status == Status.WARMING_UP


def test_settings_that_need_the_cpu_are_rejected(device):
    place_map, _ = drive_map(False)
    options = RobustOptions(place_filter=False)
    with pytest.raises(SettingsError, match='mode paper only'):
        PlaceRecognizer(place_map, RecognizerSettings(mode=options), device)
