# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A verifier of one's own: what it receives, what it may return, and how it is named."""

from dataclasses import replace
import sys
from types import ModuleType

from map_examples import example_map
import numpy as np
import pytest
from stavpr_ros.errors import InputError, SettingsError, UnavailableError
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.mapping.place_map import decode_thumbnail
from stavpr_ros.parameters import BY_NAME
from stavpr_ros.relative_pose.estimator import EdgeEstimator
from stavpr_ros.relative_pose.pair import Edge, MatchedPair, Source
from stavpr_ros.relative_pose.verification import load_verifier, verified_edge

PLACE = 5
CAMERA = Camera(128, 96, (100.0, 100.0), (64.0, 48.0))
EDGE = Edge(Source.ALIGNED, 'no camera', np.array([1.0, 2, 0, 0, 0, 0, 1]), np.eye(6))


@pytest.fixture(scope='module')
def pair() -> MatchedPair:
    place_map = example_map()
    query = np.arange(24 * 32 * 3, dtype=np.uint8).reshape(24, 32, 3)
    thumbnails = {PLACE: place_map.thumbnails[PLACE]}
    poses = np.tile(EDGE.pose, (1, 1))
    return MatchedPair(
        place_map, PLACE, query, poses, 0, np.empty((0, 1)), PLACE, poses, thumbnails
    )


def verify(pair, answer):
    return verified_edge(lambda *_: answer, pair, CAMERA, None, EDGE)


def test_verifier_receives_images_cameras_and_edge(pair):
    calls = []

    def verifier(*arguments):
        calls.append(arguments)
        return True

    assert verified_edge(verifier, pair, CAMERA, None, EDGE) is EDGE
    ((query, place, *rest),) = calls
    np.testing.assert_array_equal(query, pair.query)
    np.testing.assert_array_equal(place, decode_thumbnail(pair.thumbnails[PLACE]))
    assert place.shape == (24, 32, 3)
    assert rest == [CAMERA, None, EDGE]


@pytest.mark.parametrize('answer', [False, np.False_])
def test_verifier_refutes(pair, answer):
    assert verify(pair, answer) is None


def test_pair_without_an_image_is_refuted(pair):
    assert verify(replace(pair, query=None), True) is None
    assert verify(replace(pair, thumbnails={PLACE: b''}), True) is None


def test_verifier_returns_edge_of_its_own(pair):
    own = Edge(Source.PNP, '', np.array([3.0, 0, 0, 0, 0, 0, 2]), np.diag([1.0, 2, 3, 4, 5, 6]))
    found = verify(pair, own)
    assert found.source is Source.PNP
    np.testing.assert_array_equal(found.pose, [3, 0, 0, 0, 0, 0, 1])
    np.testing.assert_array_equal(found.covariance, own.covariance)


@pytest.mark.parametrize(
    ('answer', 'message'),
    [
        (None, 'returned None: expected True, False, or an Edge'),
        (1.0, 'returned 1.0'),
        (Edge(Source.NONE), 'expected True, False, or an Edge with a pose'),
        (replace(EDGE, pose=np.full(7, np.nan)), 'not finite'),
        (replace(EDGE, covariance=np.zeros((6, 6))), 'positive definite'),
        (replace(EDGE, covariance=np.eye(3)), '6 x 6'),
    ],
)
def test_invalid_answer_of_verifier_fails(pair, answer, message):
    with pytest.raises(InputError, match=message):
        verify(pair, answer)


def test_estimator_without_time_does_not_call_verifier(pair):
    estimator = EdgeEstimator('aligned', lambda *_: pytest.fail('called'))
    edge = estimator.estimate(pair, None, None, 'many are waiting')
    assert (edge.source, edge.reason) == (Source.DROPPED, 'verifier: many are waiting')


def test_verifier_can_be_named_at_the_start_only():
    """Who can call services of the node cannot name code."""
    assert BY_NAME['verifier'].when == 'start'


def test_load_verifier_imports_by_name(monkeypatch):
    module = ModuleType('own_verification')
    module.accept, module.number = lambda *_: True, 3
    monkeypatch.setitem(sys.modules, 'own_verification', module)
    assert load_verifier('own_verification:accept') is module.accept
    for target, error, message in (
        ('own_verification', SettingsError, 'expected package.module:function'),
        ('own_verification:number', SettingsError, 'is int, no function'),
        ('own_verification:missing', UnavailableError, 'correct the name'),
        ('not_installed:accept', UnavailableError, 'install its package'),
    ):
        with pytest.raises(error, match=message):
            load_verifier(target)
