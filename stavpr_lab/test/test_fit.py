# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The fit of the evidence: replayed as it is computed; numbers are set where they are compiled."""
# ruff: noqa: E402  (the modules of the benchmarks lie beside their commands, not in a package)

from pathlib import Path
import sys

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / 'benchmarks'
sys.path.insert(0, str(BENCHMARKS))
import fit_windows
from stavpr_ros.method import evidence, path, window
from stavpr_ros.method.model import MODEL


@pytest.fixture
def restore_numbers():
    before = {name: fit_windows.value_of(name) for name in ('CLOSE', 'start')}
    yield before
    for name, value in before.items():
        fit_windows.set_value(name, value)


def test_numbers_are_set_in_all_modules_and_in_kernels(restore_numbers):
    arguments = np.arange(9), np.full((1, 9), 0.1), np.array([4])
    assert path.close_sums(*arguments)[0] == pytest.approx(0.5)
    fit_windows.set_value('CLOSE', 4)
    fit_windows.set_value('start', 0.25)
    assert (MODEL.start, path.CLOSE, window.CLOSE) == (0.25, 4, 4)
    assert path.close_sums(*arguments)[0] == pytest.approx(0.9)


def test_half_and_double_of_every_number_differ_from_it():
    for name in (*fit_windows.RECORDED, *fit_windows.REPLAYED):
        half, double = fit_windows.half_and_double(name)
        assert fit_windows.value_of(name) not in (half, double)


def test_evidence_is_replayed_as_it_is_computed():
    """Over two drives, with early windows, and such of a camera at rest."""
    rng, n, values = np.random.default_rng(0), 300, fit_windows.values_now('g')
    x = rng.uniform((-9, 0, -0.1, 0, 0, 0, 0), (9, 0.5, 0.2, 1, 4, 3, 0), (n, 7))
    drive, early, kind = np.arange(n) // 150, rng.random(n) < 0.2, (rng.random(n) < 0.9) * 1.0
    kind[:: n // 2], early[:: n // 2] = 1, False
    scores = fit_windows.scores_of(x, drive, early, kind, *fit_windows.numbers_of(values, 'g'))
    recent, expected = {i: evidence.RecentWindows() for i in range(2)}, np.empty(n)
    newest = 0.0
    for i, (odds, uneven, excess, creep, lead, cells, _) in enumerate(x.tolist()):
        belief = 1 / (1 + np.exp(-odds))
        quantities = evidence.Quantities(
            belief, uneven, excess, np.expm1(lead), cells=np.expm1(cells), creep=creep
        )
        own, of_drive = quantities.own(values['g']), recent[int(drive[i])]
        expected[i] = evidence.probability_of(own, of_drive.share)
        if not early[i] and kind[i] == fit_windows.REPEATED:
            expected[i] = newest
        elif not early[i]:
            newest = expected[i]
            of_drive.add(own)
    np.testing.assert_allclose([fit_windows.probability(score) for score in scores], expected)
