# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Days on the synthetic street: what changes on them, and a map that is updated through them."""

import numpy as np
from PIL import Image
import pytest
from stavpr_lab.demonstration.days import plot, run, table
from stavpr_lab.demonstration.street.days import Days

DAYS = Days(
    images=200, size=(96, 72), length=300.0, closed=(2, 4, 160.0, 200.0), built=(5, 20, 40)
)


@pytest.fixture(scope='module')
def results():
    return list(run(DAYS, 5))


def test_updated_map_knows_the_detour_and_keeps_four_drives(results):
    first, updated, int8 = np.array([day.recall for day in results]).T
    assert all('added the drive' in ' '.join(day.changes) for day in results)
    for day in (2, 3):  # the second and third day on which the road is closed
        assert updated[day] > first[day] + 0.05
    assert updated[4] >= first[4] - 0.03
    assert (int8 >= updated - 0.02).all()
    assert [day.places[1] / day.places[0] for day in results] == [2, 3, 4, 4, 4]
    assert [day.vanished > 0 for day in results] == [False] * 4 + [True]


def test_results_are_a_table_and_a_plot(results, tmp_path):
    assert len(table(results).splitlines()) == 7
    plot(results, tmp_path / 'days.png')
    with Image.open(tmp_path / 'days.png') as image:
        assert np.asarray(image).std() > 5


def test_days_change_light_shops_and_buildings():
    days = Days(length=100.0, images=20, built=(2, 20.0, 60.0), closed=(1, 1, 30.0, 50.0))
    lots = [days.street(day).lots for day in range(3)]
    assert np.any(lots[0]['red'] != lots[1]['red'])
    moved = lots[1]['height'] != lots[2]['height']
    assert moved.any()
    assert (lots[1]['start'] == lots[2]['start']).all()
    assert ((lots[1]['start'][moved] >= 20) & (lots[1]['start'][moved] < 60)).all()
    assert len({days.conditions(day) for day in range(5)}) == 5
    assert days.drive(1).detour.any()
    assert not days.drive(2).detour.any()
    assert (np.diff(days.drive(2).along) > 0).all()
