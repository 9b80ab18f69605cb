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

MIN_RUNS, MAX_RUNS = 7, 101  # runs of a measurement
SLOW_S, MIN_SLOW_RUNS = 1.0, 3  # fewer runs where one round takes more than SLOW_S
SHORT_S = 0.01


@dataclass(frozen=True)
class Timing:
    """Median and interquartile range of the runs of one job, seconds, warm-up excluded."""

    median_s: float
    spread_s: float
    runs: int


def timed_job(call: Callable[[], Any], clock: Callable[[], float] = time.perf_counter) -> Job:
    """Return a job that measures a call, by the wall clock or by processor time."""

    def job() -> float:
        began = clock()
        call()
        return clock() - began

    return job


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
    rounds = max(MIN_RUNS, min(MAX_RUNS, math.ceil(seconds / max(round_s, 1e-9))))
    seconds_of: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(MIN_SLOW_RUNS if round_s > SLOW_S else rounds):
        for name, job in jobs.items():
            first = job()
            seconds_of[name].append(job() if first < SHORT_S else first)
    timings = {}
    for name, values in seconds_of.items():
        low, median, high = statistics.quantiles(values, n=4, method='inclusive')
        timings[name] = Timing(median, high - low, len(values))
    return timings


def best_seconds(call: Callable[[], Any], seconds: float) -> float:
    """Return the shortest of at least three runs that fill ``seconds``, after one to warm up."""
    job = timed_job(call)
    job()
    end = time.perf_counter() + seconds
    durations = [job() for _ in range(3)]
    while time.perf_counter() < end:
        durations.append(job())
    return min(durations)
