# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``stavpr warm``: compile the kernels and make the network's file now, not at the first use."""

from contextlib import suppress
import sys

from stavpr_ros.commands.program import make_parser, run_program, say

EPILOG = """The folder is NUMBA_CACHE_DIR, or else the package's or, if it cannot be
written, ~/.cache/stavpr.

exit codes: 0 done; 1 the folder cannot be written; 2 usage error; 130 interrupted
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    text = 'Compile the kernels of all packages into the cache, where they are missing.'
    parser = make_parser('warm', text, EPILOG)
    args = sys.argv[1:] if arguments is None else arguments
    return run_program('warm', lambda: _run(parser.parse_args(args)))


def _run(_: object) -> None:
    import numpy as np
    from stavpr_ros import kernel_cache, plugins
    from stavpr_ros.compilation import CACHE
    from stavpr_ros.errors import OutputError, UnavailableError
    from stavpr_ros.features import FeatureExtractor
    from stavpr_ros.features.efficientnet_lite_file import FILES, find_file
    from stavpr_ros.features.extractor import choose_kind
    from stavpr_ros.mapping import build_map, merge_maps
    from stavpr_ros.pipeline import PipelineSettings
    from stavpr_ros.pipeline.operations import LocalizationOperation, RouteCloser
    from stavpr_ros.pipeline.save_state import SaveState
    from stavpr_ros.relative_pose.offset import describe_columns, OffsetFilter
    from stavpr_ros.sources.frame import Frame

    if CACHE is None:
        raise OutputError('no cache folder can be written: set NUMBA_CACHE_DIR to one that can be')
    images = np.random.default_rng(0).integers(0, 256, (40, 96, 128, 3), np.uint8)
    frames = [Frame(image, number, str(number)) for number, image in enumerate(images)]
    for features in sorted({'gradient', choose_kind()[0]}):
        extractor = FeatureExtractor(features)
        route = build_map(frames, extractor, progress=False)
        both = merge_maps([route, route], ['a', 'b'])
        for precision in ('float32', 'int8'):
            for mode in ('robust', 'paper'):
                settings = PipelineSettings(mode=mode, precision=precision, backend='cpu')
                LocalizationOperation(settings, route, extractor, SaveState())
                RouteCloser(settings, None, extractor, SaveState())
                if mode == 'robust':  # maps of several sessions
                    LocalizationOperation(settings, both, extractor, SaveState())
    OffsetFilter().update(*[describe_columns(images[0])] * 2)
    for compile_kernels in plugins.load(plugins.KERNELS).values():
        compile_kernels()
    if reason := kernel_cache.failures.get(kernel_cache.WRITE_FAILED):
        raise OutputError(f'{CACHE} cannot be written: {reason}')
    with suppress(UnavailableError):  # its weights are not installed
        paths = ' and '.join(str(find_file(network)) for network in FILES)
        say(f'the networks of features hybrid, float and int8, are {paths}')
    say(f'the kernels are in {CACHE}')
