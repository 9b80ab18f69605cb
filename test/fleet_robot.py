# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A robot of test_fleet: drives 60 places of the city, and waits half way. Prints its counts."""

import sys

from stavpr_ros.fleet import FleetRecognizer, open_city_map
from stavpr_ros.recognition import RecognizerSettings
from test_fleet import CITY, DRIVEN, seen_again, walk

address, first = sys.argv[1], int(sys.argv[2])
query = seen_again(walk(CITY)[first : first + DRIVEN])
recognizer = FleetRecognizer(
    open_city_map(address), RecognizerSettings(0.5, mode='robust'), timeout=60
)
accepted = right = 0
for i in range(DRIVEN):
    if i == DRIVEN // 2:
        print('half way', flush=True)
        sys.stdin.readline()
    match = recognizer.update(query[i : i + 1])
    if match.accepted:
        accepted += 1
        right += abs(match.sequence.middle - (first + i - 10)) <= 2
print(accepted, right, recognizer.problem)
