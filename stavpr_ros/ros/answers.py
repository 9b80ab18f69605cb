"""Answers of services that reach clients whom the middleware is still getting to know."""

import threading
import time
import warnings
from typing import Any

from rclpy.service import Service

UNHEARD = 'failed to send response'  # what rclpy warns of when it gives an answer up
PATIENCE = 3.5  # seconds until it is given up; shorter than what callbacks have at the end
PAUSE = 0.05  # seconds between two attempts; each takes another 0.1, in which no other thread runs

_one_at_a_time = threading.Lock()  # filters of warnings are the process's


def wait_for_clients(service: Service) -> None:
    """
    Let a service repeat an answer until its client can hear it.

    A request may arrive before the middleware has found the way back: at the start, on a busy machine.
    rmw_fastrtps then gives the answer up after 0.1 s, and the client waits for ever; a transition that
    a lifecycle manager has asked for is made, and counts as not made.
    """
    send = service.send_response

    def send_patiently(response: Any, header: Any) -> None:
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            with _one_at_a_time, warnings.catch_warnings():
                warnings.filterwarnings('error', UNHEARD, RuntimeWarning)
                try:
                    return send(response, header)
                except (RuntimeWarning, SystemError) as error:  # the latter from C++, caused by the former
                    if UNHEARD not in str(error.__cause__ or error):
                        raise
            time.sleep(PAUSE)
        return send(response, header)  # if it is in vain again, rclpy says so

    service.send_response = send_patiently
