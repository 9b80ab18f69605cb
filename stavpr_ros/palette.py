# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The colors of all pictures, by Okabe and Ito: color-blind eyes distinguish them."""

BLUE = '#0072b2'  # a match, or a correct one
VERMILION = '#d55e00'  # a wrong match
SKY = '#56b4e9'  # a match without ground truth
ORANGE = '#e69f00'  # no match
YELLOW = '#f0e442'  # the true place
GREEN, PURPLE = '#009e73', '#cc79a7'  # other curves
GRAY = '#80848a'  # rightly no match
INK, QUIET = '#20242a', '#5f6670'  # text; axes and remarks
GRID, SHADE, PAPER = '#dddeda', '#e9e9e4', '#ffffff'


def rgb(color: str) -> tuple[int, int, int]:
    """Return red, green and blue of a color, 0 to 255."""
    red, green, blue = bytes.fromhex(color[1:])
    return red, green, blue
