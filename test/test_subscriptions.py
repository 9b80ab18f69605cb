# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The subscription to images follows its publishers; it delivers every image once and in order."""

import time

from processes import TIMEOUT
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from stavpr_ros.ros.input import AdaptiveSubscription
from stavpr_ros.ros.rclpy_workarounds import ManagedNode

RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
OVERRIDE = 'qos_overrides./image.subscription.reliability'
DEPTH = 10


class Setup:
    """A subscription and its publishers; ``received`` holds the numbers of the images."""

    def __init__(self, context, **overrides):
        options = [Parameter(name, value=value) for name, value in overrides.items()]
        self.node = ManagedNode('subscriber', context=context, parameter_overrides=options)
        self.cameras = rclpy.create_node('cameras', context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.received: list[int] = []
        self.refused: list[str] = []
        self.lost = self.sent = 0
        self.subscription = AdaptiveSubscription(
            self.node, Image, 'image', DEPTH, self._on_image, self._on_lost, self.refused.append
        )

    def _on_image(self, message):
        self.received.append(message.width)

    def _on_lost(self, count):
        self.lost += count

    def publisher(self, reliability):
        return self.cameras.create_publisher(
            Image, 'image', QoSProfile(depth=50, reliability=reliability)
        )

    def publish(self, publisher, count=1):
        for _ in range(count):
            self.sent += 1
            publisher.publish(Image(width=self.sent))

    def until(self, condition):
        end = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < end, (self.subscription.choice, self.received, self.lost)
            self.executor.spin_once(timeout_sec=0.01)

    def until_chosen(self, *words):
        self.until(lambda: all(word in self.subscription.choice for word in words))

    def until_matched(self, *publishers):
        """Wait until exactly one subscription is left, and a probe of each publisher arrives."""

        def arrives(publisher):
            self.publish(publisher)
            self.executor.spin_once(timeout_sec=0.05)
            return publisher.get_subscription_count() == 1 and self.received[-1:] == [self.sent]

        self.until(lambda: all(map(arrives, publishers)))

    def close(self):
        self.subscription.close()
        self.executor.shutdown()
        self.node.destroy_node()
        self.cameras.destroy_node()


@pytest.fixture
def setup(context, request):
    def setup(**overrides):
        made = Setup(context, **overrides)
        request.addfinalizer(made.close)
        return made

    return setup


def test_subscription_follows_publishers_that_come_and_go(setup):
    test = setup()
    first = test.publisher(BEST_EFFORT)
    test.until_chosen('best effort, 1 of 1 publishers')
    test.until_matched(first)
    second = test.publisher(RELIABLE)
    test.until_chosen('best effort, 1 of 2 publishers')
    test.cameras.destroy_publisher(first)
    test.until_chosen('reliable, every publisher')
    test.until_matched(second)
    test.cameras.destroy_publisher(second)
    test.until_chosen('reliable, no publisher')
    assert test.refused == []


def test_subscription_without_publishers_any_more_keeps_its_choice(setup):
    test = setup()
    camera = test.publisher(BEST_EFFORT)
    test.until_matched(camera)
    test.cameras.destroy_publisher(camera)
    test.until_chosen('best effort, no publisher')
    test.until_matched(test.publisher(BEST_EFFORT))
    assert test.subscription.qos.reliability == BEST_EFFORT


def test_subscription_that_changes_delivers_every_image_once_and_in_order(setup):
    test = setup()
    camera = test.publisher(RELIABLE)
    test.until_matched(camera)
    test.received.clear()
    start = test.sent
    for words in ('best effort', 'reliable', 'best effort', 'reliable'):
        if words == 'best effort':
            other = test.publisher(BEST_EFFORT)
        else:
            test.cameras.destroy_publisher(other)
        changed = []
        # on until some images after the change
        while len(changed) < 20:
            test.publish(camera)
            test.executor.spin_once(timeout_sec=0.02)
            changed += [words] * test.subscription.choice.startswith(words)
    test.until(lambda: test.received[-1] == test.sent)
    assert test.received == list(range(start + 1, test.sent + 1))
    assert test.lost == 0


def test_overridden_reliability_takes_precedence(setup):
    test = setup(**{OVERRIDE: 'best_effort'})
    test.until_matched(test.publisher(RELIABLE))
    assert test.subscription.choice == f'best effort, set by {OVERRIDE}'
    assert test.subscription.loss_remedy == f'remove {OVERRIDE}'


@pytest.mark.parametrize('reliability', [RELIABLE, BEST_EFFORT])
def test_images_displaced_in_the_queue_are_counted_as_lost(setup, reliability):
    test = setup()
    camera = test.publisher(reliability)
    test.until_matched(camera)
    test.received.clear()
    start = test.sent
    test.publish(camera, DEPTH + 7)
    test.publish(camera)
    test.until(lambda: test.received[-1:] == [test.sent])
    assert test.received == list(range(test.sent - DEPTH + 1, test.sent + 1))
    assert test.lost == test.sent - start - DEPTH == 8


def test_sequence_of_another_publisher_is_no_loss(setup):
    test = setup()
    camera = test.publisher(RELIABLE)
    test.until_matched(camera)
    test.cameras.destroy_publisher(camera)
    test.until_chosen('no publisher')
    other = test.publisher(RELIABLE)
    test.publish(other, 100)  # nobody is there yet: the first image received may be the hundredth
    test.until_matched(other)
    assert test.lost == 0
