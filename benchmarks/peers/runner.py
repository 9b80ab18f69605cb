# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Runner in the peers' own environment: aligns a sample of starts with one peer on request.

Standard input: a line of JSON for each run, ``{"peer": NAME, "window": FILE.npy, "starts": [...],
"columns": k}``. Standard output: a line of JSON for each, ``{"seconds": ..., "ends": [...]}``:
``ends`` is the accumulated distance in cell (l, k) of each start. The first line holds the
versions.
"""

from collections.abc import Callable
import importlib.metadata
import json
import sys
import time
from typing import Any

import numpy as np

PEERS = ('librosa', 'tslearn')


def aligner(peer: str) -> Callable[[np.ndarray], float]:
    """Return the function that aligns one l x k matrix of costs and returns S of its last cell."""
    if peer == 'librosa':
        from librosa.sequence import dtw  # type: ignore[import-not-found]

        return lambda costs: dtw(C=costs, backtrack=False)[-1, -1]
    if peer == 'tslearn':
        from tslearn.metrics import dtw_path_from_metric  # type: ignore[import-not-found]

        return lambda costs: dtw_path_from_metric(costs, metric='precomputed')[1]
    raise ValueError(f'peer {peer!r} is unknown: expected one of {", ".join(PEERS)}')


def run(request: dict[str, Any]) -> dict[str, Any]:
    """Align one sample."""
    window = np.load(request['window'], mmap_mode='r')
    width = request['columns']
    # the costs are cut out of the window before the clock starts
    costs = [np.array(window[:, start : start + width]) for start in request['starts']]
    align = aligner(request['peer'])
    began = time.perf_counter()
    ends = [align(matrix) for matrix in costs]
    seconds = time.perf_counter() - began
    return {'seconds': seconds, 'ends': [float(end) for end in ends]}


def main() -> None:
    """Serve requests until standard input ends."""
    print(json.dumps({peer: importlib.metadata.version(peer) for peer in PEERS}), flush=True)
    for line in sys.stdin:
        print(json.dumps(run(json.loads(line))), flush=True)


if __name__ == '__main__':
    main()
