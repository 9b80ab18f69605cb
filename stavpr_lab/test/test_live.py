# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Running node, replay and recorders as processes: failures are named at once."""

import cv2
from map_examples import VERSION2
import pytest
from stavpr_lab.demonstration.live import run_live
from stavpr_lab.demonstration.recordings import Recording
from stavpr_ros.errors import StavprError


def test_run_live_returns_why_the_node_cannot_start(tmp_path, route):
    (tmp_path / 'images').mkdir()
    cv2.imwrite(str(tmp_path / 'images/0.png'), route[0])
    parameters = {'map_path': VERSION2 / 'onnx.stavpr', 'model_path': tmp_path}
    with pytest.raises(StavprError, match=r'node cannot start: the model with sha256 [0-9a-f]'):
        run_live(parameters, Recording(str(tmp_path / 'images')), 1, tmp_path)
    assert 'copy the file that the map was built with there' in (tmp_path / 'node.log').read_text()
