# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the demonstration of the pose graph has around it: false closures, and a client."""

import numpy as np
from processes import DOMAIN, SECOND
import pytest
import rclpy
from stavpr_lab.demonstration.false_closures import FalseClosures
from stavpr_lab.demonstration.false_places import FalsePlaces, NEAR, RUN
from stavpr_lab.demonstration.graph_client import fetch_graph
from stavpr_msgs.msg import AlignedPlaces, LoopClosure
from stavpr_ros.errors import StavprError
from stavpr_ros.ros.messages import time_message


def offsets(share: float, coherent: bool) -> np.ndarray:
    """Return how far the chosen places of 200 closures are from their own."""
    false = FalsePlaces(share, coherent, 1)
    return np.array([false.place(i, range(2 * i + 1)) - i for i in range(200)])


def test_false_places_at_random_are_a_share_and_far():
    off = offsets(0.3, False)
    assert 0.15 < (off != 0).mean() < 0.45
    assert np.abs(off[off != 0]).min() > NEAR - 1
    assert not offsets(0.0, False).any()


def test_false_places_coherent_are_runs():
    off = offsets(0.5, True)
    assert (off != 0).any()
    changes = np.flatnonzero(np.diff(off != 0)) + 1
    assert not (changes % RUN).any()


def test_false_closure_is_relayed_with_the_stamps_of_its_place(default_context, monkeypatch):
    sent = []
    monkeypatch.setattr(
        rclpy.publisher.Publisher, 'publish', lambda _, message: sent.append(message)
    )
    monkeypatch.setattr(FalsePlaces, 'place', lambda *_: 7)
    node = FalseClosures(1.0, False, 1)
    (subscription,) = node.subscriptions
    message = LoopClosure(query_index=300, place_index=0)
    message.relative_pose.place_stamp = time_message(SECOND)
    message.pairs = [AlignedPlaces(place_index=7, place_stamp=time_message(8 * SECOND))]
    subscription.callback(message)
    node.destroy_node()
    relative = sent[-1].relative_pose
    assert sent[-1].place_index == relative.place_index == 7
    assert sent[-1].place_stamp == relative.place_stamp == time_message(8 * SECOND)


def test_fetch_graph_without_node_names_what_is_missing():
    with pytest.raises(StavprError, match=r'pose_graph: 3 closures not in 0\.3 s'):
        fetch_graph([], 3, DOMAIN, timeout=0.3)
