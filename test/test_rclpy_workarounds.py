# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Workarounds for rclpy, and the failures of upstream without them.

A test of upstream that fails means that its workaround can go.
"""

from concurrent.futures import Future, ThreadPoolExecutor
import queue
import threading
import time

from processes import TIMEOUT
import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import DurabilityPolicy, QoSProfile
from stavpr_ros.errors import OutputError
from stavpr_ros.ros import process, rclpy_workarounds
from stavpr_ros.ros.rclpy_workarounds import (
    ManagedNode,
    PromptExecutor,
    ReceivedGroup,
    Receiver,
    repeat_responses,
)
from std_msgs.msg import Int32
from std_srvs.srv import Trigger

SPINS = 2000  # of at most 50 ms each: until an event counts as missing
LOST = 'failed to send response (timeout): client will not receive response'


@pytest.fixture
def node(context):
    node = rclpy.create_node('waiting', context=context)
    yield node
    node.destroy_node()


def spin_until(executor, done):
    for _ in range(SPINS):
        executor.spin_once(timeout_sec=0.05)
        if done():
            return
    raise AssertionError(f'not done after {SPINS} spins')


# the executor


@pytest.fixture
def submitted_tasks(monkeypatch):
    """Collect what executors submit to pools whose threads never begin."""
    tasks = []

    def submit(pool, function, *arguments):
        tasks.append(arguments[0] if arguments else function)
        return Future()

    monkeypatch.setattr(ThreadPoolExecutor, 'submit', submit)
    return tasks


def test_multi_threaded_executor_of_upstream_submits_a_waiting_callback_again(
    node, context, submitted_tasks
):
    executor = MultiThreadedExecutor(2, context=context)
    executor.add_node(node)
    node.create_timer(0.0, lambda: None)
    for _ in range(20):
        executor.spin_once(timeout_sec=0.05)
    assert len(submitted_tasks) > len({id(task) for task in submitted_tasks})
    for task in submitted_tasks:
        task()
    executor.shutdown()


@pytest.fixture
def prompt(node, context):
    executor = PromptExecutor(2, context=context)
    executor.add_node(node)
    yield executor
    executor.finish(10.0)
    executor.shutdown()


def test_prompt_executor_of_a_waiting_callback_submits_it_once(node, prompt, monkeypatch):
    ran, submissions, submit = [], [], ThreadPoolExecutor.submit

    def count(pool, function, *arguments):
        submissions.append(arguments)
        return submit(pool, function, *arguments)

    monkeypatch.setattr(ThreadPoolExecutor, 'submit', count)
    node.create_timer(0.0, lambda: ran.append(1))
    for _ in range(20):
        prompt.spin_once(timeout_sec=0.05)
    prompt.finish(10.0)
    assert len(submissions) == len(ran) > 0


def test_prompt_executor_with_a_blocked_callback_runs_others(node, prompt):
    blocked, ran = threading.Event(), threading.Event()
    group = ReentrantCallbackGroup()
    once = node.create_timer(0.0, lambda: (once.cancel(), blocked.wait(60)), callback_group=group)
    node.create_timer(0.0, ran.set, callback_group=group)
    try:
        spin_until(prompt, ran.is_set)
    finally:
        blocked.set()


def test_prompt_executor_after_a_failing_callback_goes_on(node, prompt, capfd):
    def fail():
        raise ValueError('defect')

    node.create_timer(0.0, fail)
    for _ in range(3):
        prompt.spin_once(timeout_sec=0.05)
    prompt.finish(10.0)
    assert 'ValueError: defect' in capfd.readouterr().err


def test_prompt_executor_calls_back_with_events_of_publishers(node, prompt):
    changes = []
    events = PublisherEventCallbacks(matched=lambda event: changes.append(event.current_count))
    node.create_publisher(Int32, 'watched', 1, event_callbacks=events)
    for _ in range(3):
        prompt.spin_once(timeout_sec=0.01)
    node.create_subscription(Int32, 'watched', lambda message: None, 1)
    spin_until(prompt, lambda: changes)
    assert changes == [1]


def test_prompt_executor_meeting_a_destroyed_entity_goes_on(prompt):
    def raise_destroyed(*_, **__):
        raise rclpy_implementation.InvalidHandle('destroyed')

    prompt.wait_for_ready_callbacks = raise_destroyed
    prompt.spin_once(0.1)


# subscriptions with a thread of their own


@pytest.fixture
def reception(node, context):
    """Return what `callback` raises errors for, events of matches, and the subscription."""
    messages, matches = queue.Queue(), queue.Queue()

    def callback(message):
        messages.put((message.data, threading.current_thread()))
        raise ValueError('defect')

    events = SubscriptionEventCallbacks(matched=lambda event: matches.put(event.current_count))
    subscription = node.create_subscription(
        Int32, 'received', callback, 10, callback_group=ReceivedGroup(), event_callbacks=events
    )
    Receiver(subscription, context)
    return messages, matches, subscription


def test_receiver_without_an_executor_calls_back_with_messages_and_events(node, reception, capfd):
    messages, matches, _ = reception
    publisher = node.create_publisher(Int32, 'received', 10)
    assert matches.get(timeout=60) == 1
    for number in range(2):
        publisher.publish(Int32(data=number))
    (first, thread), (second, same) = (messages.get(timeout=60) for _ in range(2))
    assert (first, second) == (0, 1)
    assert thread is same is not threading.current_thread()
    node.destroy_publisher(publisher)
    assert matches.get(timeout=60) == 0  # on the thread that has logged the errors
    assert capfd.readouterr().err.count('ValueError: defect') == 2


@pytest.mark.parametrize('by', ['subscription', 'node', 'context'])
def test_receiver_of_a_destroyed_subscription_node_or_context_ends(context, reception, by, node):
    messages, _, subscription = reception
    publisher = node.create_publisher(Int32, 'received', 10)
    while messages.empty():  # until the thread waits, and is matched
        publisher.publish(Int32(data=1))
        time.sleep(0.01)
    thread = messages.get()[1]
    end = {
        'subscription': lambda: node.destroy_subscription(subscription),
        'node': node.destroy_node,
        'context': context.try_shutdown,
    }
    end[by]()
    thread.join(60)
    assert not thread.is_alive()


def test_receiver_that_is_destroyed_by_its_callback_or_during_it_ends(node, context):
    waits, released = threading.Event(), threading.Event()

    def callback(message):
        waits.set()
        released.wait(60)
        node.destroy_subscription(subscription)

    subscription = node.create_subscription(
        Int32, 'received', callback, 10, callback_group=ReceivedGroup()
    )
    receiver = Receiver(subscription, context)
    publisher = node.create_publisher(Int32, 'received', 10)
    while not waits.is_set():
        publisher.publish(Int32(data=1))
        time.sleep(0.01)
    node.destroy_subscription(subscription)  # must not wait for the callback
    released.set()
    receiver.join(60)
    assert not receiver.is_alive()


def test_executor_does_not_wait_for_a_received_subscription(reception, prompt):
    *_, subscription = reception
    assert not any(map(prompt.can_execute, (subscription, *subscription.event_handlers)))


# responses to clients that are not matched yet


@pytest.fixture
def lost_response(context, node, monkeypatch):
    """
    Return a function that serves one request, whose response cannot be sent; it returns attempts.

    The request of a transient local client is received, but its reader never matches the volatile
    writer of the service: as a reader that is not discovered yet.
    """
    other = rclpy.create_node('other', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def serve(prepare=lambda service: None):
        attempts, handled = [], []

        def handle(request, response):
            handled.append(request)
            return response

        service = node.create_service(Trigger, '/lost', handle)
        send = service.send_response

        def count(response, header):
            attempts.append(header)
            return send(response, header)

        service.send_response = count
        prepare(service)
        qos = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        client = other.create_client(Trigger, '/lost', qos_profile=qos)
        client.call_async(Trigger.Request())
        with pytest.warns(RuntimeWarning, match='client will not receive'):
            spin_until(executor, lambda: bool(handled))
        return attempts

    yield serve
    executor.shutdown()
    other.destroy_node()


def test_service_of_upstream_with_an_unmatched_client_drops_the_response(lost_response):
    assert len(lost_response()) == 1


def test_service_with_an_unmatched_client_repeats_the_response(lost_response, set_constants):
    set_constants(rclpy_workarounds, RESPONSE_TIMEOUT=0.5)
    assert len(lost_response(repeat_responses)) > 2


def raised_within_c(error):
    """Return what Python raises for an error in a C function that returns a result."""
    outer = SystemError('returned a result with an exception set')
    outer.__cause__ = error
    return outer


class Service:
    """Its first responses cannot be sent."""

    def __init__(self, *errors):
        self.errors, self.sent = list(errors), []

    def send_response(self, *response):
        self.sent.append(response)
        if self.errors:
            raise self.errors.pop()


@pytest.mark.parametrize('error', [RuntimeWarning(LOST), raised_within_c(RuntimeWarning(LOST))])
@pytest.mark.parametrize('failures', [0, 1, 5])
def test_service_whose_client_is_matched_late_sends_the_response(error, failures):
    service = Service(*[error] * failures)
    repeat_responses(service)
    service.send_response('yes', 7)
    assert service.sent == [('yes', 7)] * (failures + 1)


def test_service_with_another_error_raises_it_at_once():
    service = Service(SystemError('something else'))
    repeat_responses(service)
    with pytest.raises(SystemError, match='something else'):
        service.send_response('yes', 7)
    assert len(service.sent) == 1


@pytest.fixture
def managed_node(context):
    node = ManagedNode('managed', context=context)
    yield node
    node.destroy_node()


def test_services_of_a_managed_node_repeat_responses(managed_node):
    names = {service.srv_name.rpartition('/')[2] for service in managed_node.services}
    assert {'change_state', 'get_state', 'set_parameters'} <= names
    for service in managed_node.services:
        assert service.send_response.__name__ == 'send_repeatedly', service.srv_name


# the life cycle


def test_lifecycle_node_of_upstream_raises_at_an_invalid_transition(context):
    node = LifecycleNode('upstream', context=context)
    with pytest.raises(rclpy_implementation.RCLError, match='not registered'):
        node.trigger_activate()
    node.destroy_node()


def test_managed_node_at_an_invalid_transition_stays_in_its_state(managed_node):
    assert not managed_node.advance(managed_node.trigger_activate)
    assert managed_node.state == 'unconfigured'
    assert managed_node.advance(managed_node.trigger_configure)
    assert managed_node.state == 'inactive'


def test_managed_node_destroyed_before_a_transition_logs_no_error(context, capfd):
    """As a signal right after the start does, before the timer that configures the node."""
    node = ManagedNode('managed', context=context)
    node.destroy_node()
    assert not node.advance(node.trigger_configure)
    assert 'no transition' not in capfd.readouterr().err


def test_destroyed_managed_node_has_no_services_of_its_life_cycle(node, context):
    """One of upstream keeps its state machine, and with it the services."""
    nodes = LifecycleNode('upstream', context=context), ManagedNode('managed', context=context)

    def wait_for(*names):
        end, services = time.monotonic() + TIMEOUT, set()
        while services != {f'/{name}/get_state' for name in names}:
            assert time.monotonic() < end, services
            services = {
                name for name, _ in node.get_service_names_and_types() if 'get_state' in name
            }

    wait_for('upstream', 'managed')
    for lifecycle_node in nodes:
        lifecycle_node.destroy_node()
    wait_for('upstream')


def test_spin_until_survives_errors_of_callbacks_except_its_own(node):
    errors = iter(
        [ValueError('a message of another node'), KeyError('another'), OutputError('full')]
    )

    def fail():
        raise next(errors)

    node.create_timer(0.01, fail)
    with pytest.raises(OutputError, match='full'):
        process.spin_until(node)
