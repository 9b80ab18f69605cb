"""Timings: warm-up, interleaved runs, median and spread."""

import math
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

Job = Callable[[], float]  # does its work once and returns the seconds that it took

FEWEST, MOST = 7, 101  # runs of a measurement
SLOW_S, FEWEST_SLOW = 1.0, 3  # a round of over SLOW_S runs only so often
SHORT_S = 0.01


@dataclass(frozen=True)
class Timing:
    """
    What a number of runs took.

    :param median_s: their median, seconds.
    :param spread_s: their interquartile range, seconds.
    :param runs: how many there were, warm-up not counted.
    """

    median_s: float
    spread_s: float
    runs: int

    @classmethod
    def of(cls, seconds: list[float]) -> 'Timing':
        """Summarize the seconds of at least two runs."""
        low, median, high = statistics.quantiles(seconds, n=4, method='inclusive')
        return cls(median, high - low, len(seconds))


def nothing() -> None:
    """Wait for nothing: the CPU's calls are done when they return."""


def synchronizer(device: str) -> Callable[[], None]:
    """Return what waits until everything that was asked of the device is done."""
    if device == 'cpu':
        return nothing
    import torch

    return torch.cuda.synchronize


def timed(call: Callable[[], Any], synchronize: Callable[[], None] = nothing) -> Job:
    """Return a job that takes the time of a call by the wall clock, as its user has it."""

    def job() -> float:
        synchronize()
        began = time.perf_counter()
        call()
        synchronize()
        return time.perf_counter() - began

    return job


def rounds_for(round_s: float, seconds: float) -> int:
    """Return how often to run a round that takes ``round_s``, to fill ``seconds``."""
    if round_s > SLOW_S:
        return FEWEST_SLOW
    return max(FEWEST, min(MOST, math.ceil(seconds / max(round_s, 1e-9))))


def measure(jobs: Mapping[str, Job], seconds: float = 0.5) -> dict[str, Timing]:
    """
    Run jobs in turn, A B C A B C, so that what slows the machine for a while slows all of them.

    Every job runs once to compile, and once more unless that took long, before anything counts. A short
    job runs once more directly before every run that counts: what another one left in the caches, and
    threads that it put to sleep, are no property of this one.

    :param jobs: what to run, by name.
    :param seconds: how long to run all of them together; between 7 and 101 rounds, 3 of rounds that take
        over a second.
    """
    round_s = 0.0
    for job in jobs.values():
        for _ in range(2):
            began = time.perf_counter()
            job()
            last = time.perf_counter() - began
            if last > SLOW_S:
                break
        round_s += last
    taken: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(rounds_for(round_s, seconds)):
        for name, job in jobs.items():
            first = job()
            taken[name].append(job() if first < SHORT_S else first)
    return {name: Timing.of(values) for name, values in taken.items()}


def events_seconds(call: Callable[[], Any], runs: int = FEWEST) -> float:
    """Return the median seconds between CUDA events recorded before and after a call."""
    import torch

    taken = []
    for _ in range(runs):
        before, after = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda.synchronize()
        before.record()
        call()
        after.record()
        torch.cuda.synchronize()
        taken.append(before.elapsed_time(after) / 1e3)
    return statistics.median(taken)
