"""Segments for `bundlesdf run --segmenter "command:python3 adapter.py"` (protocol: docs/masks.md). Needs numpy.

Replace Segmenter by a network: `start` gets the first frame and its mask, `frame` answers the mask of every further one.
"""

import json
import sys

import numpy as np


class Segmenter:
    """A stand-in for a network: the pixels around the last mask with its colours and depth."""

    def start(self, color, depth, mask):
        self.mask = mask
        self.colors = np.bincount(bins(color)[mask], minlength=4096) / max(mask.sum(), 1)
        self.others = np.bincount(bins(color)[~mask], minlength=4096) / max((~mask).sum(), 1)
        return mask

    def frame(self, color, depth):
        known = depth[self.mask & (depth > 0)]
        near = np.abs(depth - (np.median(known) if known.size else 0)) < 0.1
        code = bins(color)
        self.mask = grow(self.mask, 6) & near & (self.colors[code] > self.others[code])
        return self.mask


def bins(color):
    """Colour as a number from 0 to 4095."""
    r, g, b = (color >> 4).astype(np.int64).transpose(2, 0, 1)
    return r * 256 + g * 16 + b


def grow(mask, pixels):
    """Adds everything within `pixels` of the mask, along rows and columns."""
    for axis in (0, 1):
        mask = np.logical_or.reduce([np.roll(mask, k, axis) for k in range(-pixels, pixels + 1)])
    return mask


def main():
    requests, replies = sys.stdin.buffer, sys.stdout.buffer
    segmenter = Segmenter()
    while line := requests.readline():
        header = json.loads(line)
        if header["masks"] != 1:
            sys.exit(f"this adapter speaks version 1 of the protocol, not {header['masks']}")
        w, h = header["width"], header["height"]
        color = np.frombuffer(requests.read(3 * w * h), np.uint8).reshape(h, w, 3)
        depth = np.frombuffer(requests.read(4 * w * h), "<f4").reshape(h, w)
        if header["type"] == "start":
            mask = np.frombuffer(requests.read(w * h), np.uint8).reshape(h, w) > 0
            mask = segmenter.start(color, depth, mask)
        else:
            mask = segmenter.frame(color, depth)
        reply = {"masks": 1, "width": mask.shape[1], "height": mask.shape[0], "confidence": 1.0}
        replies.write(json.dumps(reply).encode() + b"\n" + mask.astype(np.uint8).tobytes())
        replies.flush()


main()
