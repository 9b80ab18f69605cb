# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
STA-VPR place recognition: spatio-temporal alignment of image sequences, and a ROS 2 node for it.

Importing the package itself loads nothing heavy; import what you need from its folders:
``alignment`` (the mathematics), ``features`` (image to local features), ``mapping`` (the reference
map), ``method`` (frame by frame), ``sources`` (frames from folders, bags and messages),
``pipeline`` (one image message at a time), ``ros`` (the node).
"""

from stavpr_ros import former

__version__ = '0.9.0'

former.forward()
