# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images as files, and numbers, for the tests of commands."""

import json

import cv2
import pytest


def write_images(folder, images):
    """Write RGB images as PNG files; returns the folder."""
    folder.mkdir(parents=True)
    for i, image in enumerate(images):
        cv2.imwrite(str(folder / f'{i:03}.png'), image[:, :, ::-1])
    return folder


def read_json(text):
    """Parse JSON as browsers do: without NaN and Infinity."""
    return json.loads(text, parse_constant=pytest.fail)
