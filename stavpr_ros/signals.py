"""How our processes take signals."""

import signal


def obey_signals() -> None:
    """Make SIGINT and SIGTERM raise KeyboardInterrupt, whatever the parent process had in mind for them."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def ignore_signals() -> None:
    """Be deaf to both: ``ros2 launch`` sends a second SIGINT while the first is being obeyed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
