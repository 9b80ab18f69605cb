# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Videos as read by us beside FFmpeg: frames and times of ``ffprobe``, pixels of ``ffmpeg``.

Writes results/video.md. Without ffmpeg on the PATH it prints that and does nothing.
"""

from dataclasses import dataclass
import json
from pathlib import Path
import shutil
import subprocess
import sys
from tempfile import TemporaryDirectory

import numpy as np
from results import RESULTS
from stavpr_ros.sources import open_source

H264, H265, MPEG2 = '-c:v libx264 -pix_fmt yuv420p', '-c:v libx265', '-c:v mpeg2video -q:v 8'
FIELDS, BOTTOM_FIRST = '-flags +ildct+ilme', '-vf scale=720:576 -r 25'
PQ = '-x265-params colorprim=bt2020:transfer=smpte2084:colormatrix=bt2020nc'
VARIABLE = "-vf select='not(eq(mod(n\\,7)\\,3))' -vsync vfr"
ROTATED = '-metadata:s:v:0 rotate=90'
SECONDS = 2e-3  # containers round to milliseconds


@dataclass(frozen=True)
class File:
    """A file, and the options of ffmpeg that write it; ``copy`` changes it without encoding."""

    name: str
    options: str
    copy: str = ''
    kind: str = ''


FILES = (
    File('h264.mp4', f'{H264} -bf 0'),
    File('h264_b.mp4', f'{H264} -bf 2', kind='B frames'),
    File('h264.mkv', H264, kind='B frames'),
    File('h264.mov', H264, kind='B frames'),
    File('h264.avi', H264, kind='B frames'),
    File('h264.ts', H264, kind='B frames'),
    File('h264.MTS', f'{H264} -f mpegts', kind='B frames'),
    File('h264.flv', H264, kind='B frames'),
    File('h264.h264', H264, kind='no times'),
    File('h265.mp4', H265, kind='B frames'),
    File('h265.mkv', f'{H265} -pix_fmt yuv420p10le', kind='10 bit'),
    File('pq.mp4', f'{H265} -pix_fmt yuv420p10le {PQ}', kind='HDR'),
    File('av1.mp4', '-c:v libsvtav1 -preset 12'),
    File('av1.mkv', '-c:v libaom-av1 -cpu-used 8 -pix_fmt yuv420p10le', kind='10 bit'),
    File('vp8.webm', '-c:v libvpx'),
    File('vp9.webm', '-c:v libvpx-vp9 -deadline realtime'),
    File('mpeg2.mpg', f'{MPEG2} -bf 2', kind='B frames'),
    File('mpeg2.m2ts', f'{MPEG2} -bf 2 -f mpegts', kind='B frames'),
    File('mpeg4.avi', '-c:v mpeg4 -bf 2', kind='B frames'),
    File('xvid.avi', '-c:v libxvid -bf 2', kind='B frames'),
    File('wmv2.wmv', '-c:v wmv2'),
    File('theora.ogv', '-c:v libtheora'),
    File('mjpeg.avi', '-c:v mjpeg'),
    File('prores.mov', '-c:v prores_ks', kind='10 bit'),
    File('ffv1.mkv', '-c:v ffv1 -pix_fmt yuv444p10le', kind='10 bit'),
    File('dv.avi', f'{BOTTOM_FIRST} -c:v dvvideo -pix_fmt yuv420p', kind='interlaced'),
    File('interlaced.mp4', f'{H264} {FIELDS} -x264opts tff=1', kind='interlaced'),
    File('interlaced.mkv', f'{MPEG2} {FIELDS} -top 1', kind='interlaced'),
    File('rotated.mp4', H264, ROTATED, 'rotated'),
    File('trimmed.mp4', H264, '-ss 1.02', 'trimmed'),
    File('offset.mkv', H264, '-output_ts_offset 7.3', 'offset'),
    File('offset.ts', f'{H264} -f mpegts', '-output_ts_offset 95443', 'offset, clock wraps'),
    File('variable.mp4', f'{H264} {VARIABLE}', kind='variable rate'),
    File('variable.mkv', f'-c:v libvpx-vp9 -deadline realtime {VARIABLE}', kind='variable rate'),
)


def main() -> int:
    """Write the files, compare, write the table; return the number of differences."""
    if not (shutil.which('ffmpeg') and shutil.which('ffprobe')):
        print('left out: ffmpeg is not installed')
        return 0
    rows, different = [], 0
    with TemporaryDirectory() as folder:
        for file in FILES:
            path = write(file, Path(folder))
            row = compare(path)
            different += not row[-1].startswith('equal')
            rows.append(f'| {file.name} | {file.kind} | {" | ".join(row)} |')
            print(rows[-1], flush=True)
    version = subprocess.check_output(['ffmpeg', '-version'], text=True).split()[2]
    text = (
        f'# Videos beside FFmpeg {version}\n\nWritten by `python benchmarks/video.py`: frames and '
        'times after the first beside `ffprobe -show_frames`; mean difference of the pixels, of\n'
        '255, beside `ffmpeg` (interlaced: beside `bwdif`; HDR: `ffmpeg` shows the codes; 10 bit: '
        '`ffmpeg` interpolates chroma).\n\n| file | kind | frames | ffprobe | size | pixels | '
        'times |\n|---|---|--:|--:|---|--:|---|\n'
    )
    (RESULTS / 'video.md').write_text(text + '\n'.join(rows) + '\n', encoding='utf-8')
    print(f'{len(FILES) - different} of {len(FILES)} equal')
    return different


def write(file: File, folder: Path) -> Path:
    """Encode moving images, 3 s at 30 Hz."""
    path, run = folder / file.name, ['ffmpeg', '-v', 'quiet', '-y']
    first = path.with_stem(f'{path.stem}_whole') if file.copy else path
    scene = 'mandelbrot=size=160x120:rate=30:end_pts=90,trim=end_frame=90'
    run_quietly([*run, '-f', 'lavfi', '-i', scene, *file.options.split(), first])
    if file.copy:
        trim = file.copy.split() if file.copy.startswith('-ss') else []
        after = [] if trim else file.copy.split()
        run_quietly([*run, *trim, '-i', first, '-c', 'copy', *after, path])
    return path


def run_quietly(command: list[str | Path]) -> None:
    """Run a command; encoders print to the terminal."""
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)


def compare(path: Path) -> list[str]:
    """Return frames, frames of ffprobe, size, difference of pixels, and of times."""
    problems: list[Exception] = []
    frames = list(open_source(path, on_error=problems.append, fps=1000))
    times = np.array([frame.stamp - frames[0].stamp for frame in frames]) / 1e9
    command = ['ffprobe', '-v', 'quiet', '-select_streams', 'v:0', '-show_frames', '-of', 'json']
    shown = json.loads(subprocess.check_output([*command, path]))['frames']
    stated = np.array([float(each.get('best_effort_timestamp_time', 'nan')) for each in shown])
    # what has no time is continued by the frame rate
    start = np.nan_to_num(stated[0])
    stated = np.where(np.isnan(stated), start + np.arange(len(stated)) / 30, stated)
    height, width = frames[0].image.shape[:2]
    filters = ['-vf', 'bwdif=send_frame'] if shown[0]['interlaced_frame'] else []
    command = ['ffmpeg', '-v', 'quiet', '-i', path, *filters, '-vsync', 'passthrough']
    raw = subprocess.check_output([*command, '-f', 'rawvideo', '-pix_fmt', 'rgb24', '-'])
    pixels = np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)
    each = [
        np.abs(frame.image.astype(int) - other).mean()
        for frame, other in zip(frames, pixels, strict=False)
    ]
    result = 'equal'
    if len(frames) == len(shown):
        worst = np.abs(times - (stated - stated[0])).max()
        result = 'equal' if worst < SECONDS else f'differ by {worst:.3f} s'
    else:
        result = 'frames differ'
    notes = ''.join(f'; {problem}' for problem in problems)
    size = f'{width}x{height}'
    return [str(len(frames)), str(len(shown)), size, f'{np.mean(each):.2f}', result + notes]


if __name__ == '__main__':
    sys.exit(main())
