"""Answers of services whose client the middleware does not know yet: repeated, and given up at last."""

import warnings

import pytest

from stavpr_ros.ros import answers

WARNING = 'failed to send response (timeout): client will not receive response'


class Service:
    """A service whose answers are in vain at first."""

    def __init__(self, failures, fail):
        self.failures, self.fail, self.sent = failures, fail, []

    def send_response(self, response, header):
        self.sent.append((response, header))
        if len(self.sent) <= self.failures:
            self.fail()


def warn():
    warnings.warn(WARNING, RuntimeWarning, stacklevel=1)


def warn_as_c_does():
    """What Python makes of a warning that became an error in a function that returns all the same."""
    try:
        warn()
    except RuntimeWarning as error:
        raise SystemError('returned a result with an exception set') from error


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    monkeypatch.setattr(answers, 'PAUSE', 0.001)
    monkeypatch.setattr(answers, 'PATIENCE', 0.2)


@pytest.mark.parametrize('fail', [warn, warn_as_c_does])
@pytest.mark.parametrize('failures', [0, 1, 5])
def test_an_answer_is_sent_until_it_is_heard(fail, failures, recwarn):
    service = Service(failures, fail)
    answers.wait_for_clients(service)
    service.send_response('yes', 7)
    assert service.sent == [('yes', 7)] * (failures + 1)
    assert not recwarn.list


def test_it_is_given_up_with_the_warning():
    service = Service(10**9, warn)
    answers.wait_for_clients(service)
    with pytest.warns(RuntimeWarning, match='client will not receive'):
        service.send_response('yes', 7)
    assert len(service.sent) > 3


def test_other_errors_are_passed_on():
    def fail():
        raise SystemError('something else')

    service = Service(1, fail)
    answers.wait_for_clients(service)
    with pytest.raises(SystemError, match='something else'):
        service.send_response('yes', 7)
    assert len(service.sent) == 1


def test_every_service_of_a_managed_node_waits(tmp_path):
    """Also those that rclpy makes: of the life cycle and of the parameters."""
    import rclpy

    from stavpr_ros.ros.node import PlaceRecognitionNode

    context = rclpy.Context()
    rclpy.init(context=context, args=['--ros-args', '-p', 'autostart:=false'])
    node = PlaceRecognitionNode(context=context)
    try:
        names = {service.srv_name.rpartition('/')[2] for service in node.services}
        assert {'change_state', 'get_state', 'set_parameters', 'load_map', 'relocalize'} <= names
        for service in node.services:
            assert service.send_response.__name__ == 'send_patiently', service.srv_name
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
