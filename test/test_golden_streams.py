# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Drives are answered as they were, and after a reset as by a new pipeline: test/shared/golden.py.

``python test/shared/golden.py`` renews the file, where a change of answers is meant.
"""

from itertools import pairwise
import json

from golden import DRIVES, FILE, IMAGES, plain, rows_of
import pytest

pytestmark = pytest.mark.usefixtures('one_thread')
TOLERANCE = 1e-4  # of a probability: processors add in another order
EXPECTED = json.loads(FILE.read_text())
BEFORE = 40  # images before a reset


@pytest.fixture(scope='module', params=DRIVES)
def drive(request):
    """Return a drive, its name and the results."""
    drive = DRIVES[request.param]()
    return drive, request.param, drive.process(drive.pipeline())


def numbers(row):
    """Return the probabilities of a row: its own, and of its late matches."""
    return [0 if row[9] is None else row[9], *(probability for _, probability in row[10])]


def others(row):
    return [*row[:9], row[9] is None, [place for place, _ in row[10]]]


def test_drive_is_answered_as_before(drive):
    _, name, results = drive
    rows, expected = rows_of(results), EXPECTED[name]
    assert len(rows) == IMAGES
    assert [others(row) for row in rows] == [others(row) for row in expected]
    for row, before in zip(rows, expected, strict=True):
        assert numbers(row) == pytest.approx(numbers(before), abs=TOLERANCE)


def test_drive_after_a_reset_is_answered_as_by_a_new_pipeline(drive):
    drive, _, results = drive
    if drive.places is None:
        pytest.skip('the route stays: test_loop_closure has it')
    pipeline = drive.pipeline()
    drive.images.reverse()
    drive.process(pipeline, BEFORE)
    drive.images.reverse()
    pipeline.operation.reset()
    assert json.dumps(plain(drive.process(pipeline))) == json.dumps(plain(results))


def test_streams_show_what_they_are_named_for():
    """A stream without matches, or without what it is of, would compare nothing."""
    for name, rows in EXPECTED.items():
        assert sum(row[0] == 'MATCH' for row in rows) > 10, name
    assert sum(len(row[10]) for row in EXPECTED['late']) > 2
    assert {row[6] for row in EXPECTED['both_directions']} == {1, -1}
    assert {row[8] for row in EXPECTED['geometric_check']} == {True, False}
    laps = [row[2] for row in EXPECTED['closed_route'] if row[0] == 'MATCH']
    assert any(place < before - 40 for before, place in pairwise(laps))
