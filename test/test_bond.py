# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The bond to a lifecycle manager, with a message built from its definition."""

from pathlib import Path
import sys
import threading
from types import ModuleType, SimpleNamespace

import pytest
from stavpr_ros.ros.bond import make_bond
from std_msgs.msg import Header

DEFINITION = Path(__file__).parent / 'data' / 'interfaces' / 'bond' / 'msg' / 'Status.msg'
TYPES = {'string': str, 'bool': bool, 'float32': float, 'std_msgs/Header': Header}
FIELDS = {name: TYPES[kind] for kind, name in map(str.split, DEFINITION.open())}


class Status:
    """``bond/msg/Status``: fields and types of the definition only."""

    def __init__(self, **values):
        for name, kind in FIELDS.items():
            value = values.pop(name, kind())
            assert type(value) is kind, name
            setattr(self, name, value)
        assert not values


class Node:
    """A node that keeps what is published on ``bond``, and receives a manager's."""

    def __init__(self):
        self.sent, self.destroyed, self.warnings = [], [], []
        self.received = threading.Semaphore(0)
        self.context = SimpleNamespace(ok=lambda: True)

    def get_name(self):
        return 'stavpr'

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)

    def create_publisher(self, kind, topic, depth):
        assert (kind, topic) == (Status, 'bond')

        def publish(message):
            self.sent.append(message)
            self.received.release()

        return SimpleNamespace(publish=publish)

    def create_subscription(self, kind, topic, callback, qos, **options):
        assert (kind, topic) == (Status, 'bond')
        self.receive = callback
        return callback

    def destroy_publisher(self, publisher):
        self.destroyed.append('publisher')

    def destroy_subscription(self, subscription):
        self.destroyed.append('subscription')

    def active(self):
        return [message.active for message in self.sent]

    def manager(self, active, name='stavpr', instance='manager'):
        """Receive the state of a manager of another period."""
        self.receive(Status(id=name, instance_id=instance, active=active, heartbeat_period=1.0))


@pytest.fixture
def node(monkeypatch):
    module = ModuleType('bond.msg')
    module.Status = Status
    monkeypatch.setitem(sys.modules, 'bond', ModuleType('bond'))
    monkeypatch.setitem(sys.modules, 'bond.msg', module)
    return Node()


def test_bond_beats_until_it_is_closed_each_time_anew(node):
    for first in range(2):  # activated, deactivated, activated
        start, node.received = len(node.sent), threading.Semaphore(0)
        bond = make_bond(node, 0.01, is_managed=True)
        for _ in range(3):
            assert node.received.acquire(timeout=60)
        node.manager(active=True)
        bond.close()
        *beats, last = node.sent[start:]
        assert len(beats) >= 3
        assert all(beat.active for beat in beats)
        assert not last.active
        assert {(m.id, m.heartbeat_timeout, m.heartbeat_period) for m in node.sent[start:]} == {
            ('stavpr', 4.0, 0.01)
        }
        assert len({message.instance_id for message in node.sent}) == first + 1
        assert node.destroyed == ['subscription', 'publisher'] * (first + 1)


def test_bond_that_the_manager_ends_is_acknowledged_and_stays_silent(node):
    bond = make_bond(node, 1000.0, is_managed=True)
    assert node.active() == [True]  # at once: the manager waits for it
    node.manager(active=False, name='amcl')
    node.manager(active=False, instance=node.sent[0].instance_id)  # our own message
    bond.beat()
    assert node.active() == [True, True]
    for _ in range(2):
        node.manager(active=False)
        bond.beat()
    assert node.active() == [True, True, False]
    bond.close()
    assert not any(node.active()[2:])


def test_bond_is_off_without_a_period_or_its_package(node, hide_module):
    assert make_bond(node, 0.0, is_managed=True) is None
    hide_module('bond.msg')
    assert make_bond(node, 0.25, is_managed=False) is None
    assert not node.warnings
    assert make_bond(node, 0.25, is_managed=True) is None
    assert 'the package bond is not installed' in node.warnings[0]
    assert not node.sent
