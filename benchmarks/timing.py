# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Timings: warm-up, interleaved runs, median and spread."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math
import statistics
import time
from typing import Any

Job = Callable[[], float]  # runs once and returns the seconds that it took

FEWEST, MOST = 7, 101  # runs of a measurement
SLOW_S, FEWEST_SLOW = 1.0, 3  # fewer runs where one round takes more than SLOW_S
SHORT_S = 0.01


@dataclass(frozen=True)
class Timing:
    """
    Summary of the runs of one job.

    :param spread_s: interquartile range, seconds.
    :param runs: number of runs, warm-up excluded.
    """

    median_s: float
    spread_s: float
    runs: int

    @classmethod
    def of(cls, seconds: list[float]) -> 'Timing':
        """Summarize at least two runs."""
        low, median, high = statistics.quantiles(seconds, n=4, method='inclusive')
        return cls(median, high - low, len(seconds))


def nothing() -> None:
    """Return at once: calls on the CPU are complete when they return."""


def synchronizer(device: str) -> Callable[[], None]:
    """Return a function that waits for all work queued on the device."""
    if device == 'cpu':
        return nothing
    import torch

    return torch.cuda.synchronize


def timed(call: Callable[[], Any], synchronize: Callable[[], None] = nothing) -> Job:
    """Return a job that measures a call by the wall clock, results complete."""

    def job() -> float:
        synchronize()
        began = time.perf_counter()
        call()
        synchronize()
        return time.perf_counter() - began

    return job


def rounds_for(round_s: float, seconds: float) -> int:
    """Return the number of rounds of ``round_s`` seconds that fill ``seconds``, within limits."""
    if round_s > SLOW_S:
        return FEWEST_SLOW
    return max(FEWEST, min(MOST, math.ceil(seconds / max(round_s, 1e-9))))


def measure(jobs: Mapping[str, Job], seconds: float = 0.5) -> dict[str, Timing]:
    """
    Run jobs in turn, A B C A B C, so that a slower machine slows all of them.

    Every job runs once to compile, and once more unless that took long, before any run counts. A
    job under 10 ms runs once more, uncounted, directly before each counted run: the caches and the
    sleeping threads that another job left behind are not a property of this one.

    :param seconds: total time of the counted rounds; 7 to 101 rounds, 3 where a round exceeds 1 s.
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


def best_seconds(call: Callable[[], Any], device: str, seconds: float) -> float:
    """Return the shortest of at least three runs that fill ``seconds``, after one to warm up."""
    job = timed(call, synchronizer(device))
    job()
    end = time.perf_counter() + seconds
    taken = [job() for _ in range(3)]
    while time.perf_counter() < end:
        taken.append(job())
    return min(taken)
