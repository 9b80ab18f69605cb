# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Tuned numbers of the pose graph.

Drives: chosen on KITTI 00 and 08 and the demonstration's world of seed 60, checked on KITTI 05, 06
and 09 and seed 61. Graphs of other programs: chosen on MIT, smallGrid3D, intel, parking-garage and
a city-like graph. benchmarks/results/pose_graph.md has half and double of them, and what fails
without each rule.
"""

import math

import numpy as np

# decision: the errors of the odometry, and the evidence of closures
SCALES = np.exp2(np.arange(-3, 3))  # factors on the errors of the odometry: 1/8 to 4
TIGHT = float(SCALES[0])  # the one that it is trusted by at first
PRECISE = TIGHT * TIGHT  # the smallest one of a solution
CERTAIN = math.log(20)  # odds of a closure that is accepted, and evidence of a factor
LOOSER = CERTAIN  # that of other errors of the odometry, and of each doubling of the settings'
GAP = 15.0  # meters between the queries and places of an event, and around a break, at most
PARTS = 10  # blocks of a drive that is decided anew, by time
SEARCH = 1.1  # times the closures of the last search of factors and breaks: it is made anew

# closures, in blocks by time
TAILS = 4.0  # times the limit of a chi-square: errors have long tails
INLIER = 0.99  # part of right closures whose residuals are below the limit
FIRST_STEPS = 4  # of Gauss and Newton with all closures that may be right
MAX_STEPS = 25  # of Gauss and Newton, and of expectation and maximization
CONVERGED = 1e-3  # change of the error, half the squared deviations, of a solution
LONGEST = 10  # keyframes of a run, which is one factor; neighbors of a closure
SPARE = 1.5  # times the active factors: a pattern of so many is used again
FILLED = 6  # blocks for each active factor: a pattern with more is used for 2 % more only

# sessions
JOINS = 8  # closures that join two sessions; half as many certain ones show a factor
AGREEING = 0.25  # part of the closures between sessions that agree at least
SAMPLE = 100  # closures between sessions that vote, and poses that they move, at most

# breaks of the odometry: the robot was carried
GAIN = 24  # closures more that agree if there is a break, beside the largest new event
SUPPORT = 32  # closures on each side of a break
SPREAD = 2.0  # meters, and deviations of two closures, that agreeing ones are apart
PAUSE = 1.5  # times the usual time between keyframes: the robot was carried then
SETS = 2  # of closures that agree on another path
COMPARED = 1500  # rejected closures of a session, evenly: 50 MB
MAX_BREAKS = 4  # that are searched

# graphs of other programs
BLOCKS = 20  # of a graph that comes at once, by time
WEAKEST = 12  # closures that are left out on trial
PLAUSIBLE = 50  # rejected closures that are tried in their place
FACTORS = np.exp2(np.arange(-13, 5, 0.5))  # on the errors that a file states
