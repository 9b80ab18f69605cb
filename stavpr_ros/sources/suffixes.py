# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Suffixes of image files."""

HEIF = frozenset({'.heic', '.heif', '.hif'})
SUFFIXES = HEIF | {
    '.jpg', '.jpeg', '.jpe', '.jfif', '.mpo', '.png', '.apng', '.bmp', '.tif', '.tiff', '.pgm',
    '.ppm', '.pnm', '.pbm', '.webp',
}  # fmt: skip
OTHER_IMAGES = frozenset({
    '.arw', '.avif', '.avifs', '.cr2', '.cr3', '.dng', '.exr', '.fits', '.gif', '.hdr', '.heics',
    '.heifs', '.ico', '.jp2', '.jps', '.jxl', '.nef', '.orf', '.pam', '.pfm', '.qoi', '.raf',
    '.raw', '.rw2', '.tga',
})  # fmt: skip
