"""Pack random boxes with exported ``plain`` agents: python drive_onnx.py FOLDER SEED."""

import sys

import numpy as np
from onnxruntime import InferenceSession

W = D = H = 10  # the bin, in cells
ORIENTATIONS = [[0, 1, 2], [1, 0, 2], [0, 2, 1], [2, 0, 1], [1, 2, 0], [2, 1, 0]]
orient, place = (InferenceSession(f"{sys.argv[1]}/{a}.onnx") for a in ("orientation", "placement"))


def _act(agent, item, *planes):  # the agent's most probable action
    inputs = zip(agent.get_inputs(), (heights, item, [H], *planes), strict=True)
    return agent.run(["action"], {i.name: np.asarray(v)[None] for i, v in inputs})[0][0]


(heights, empty), generator = np.zeros((2, W, D), int), np.random.default_rng(int(sys.argv[2]))
for sides in generator.integers(2, 6, (200, 3))[:, ORIENTATIONS]:  # an item's sides along x, y, z
    legal, rest, waste = np.zeros((6, W, D), bool), np.full((6, W, D), H), np.zeros((6, W, D), int)
    for o, (w, d, h) in enumerate(sides):
        for x, y in np.ndindex(W - w + 1, D - d + 1):
            window, z = np.s_[x : x + w, y : y + d], heights[x : x + w, y : y + d].max()
            rest[o, x, y], waste[o, x, y] = z, (z - heights[window]).sum()
            cells = np.argwhere((heights[window] == z) & (empty[window] == 0)) @ (1, 1j)
            corners = np.add.outer(cells, (0, 1, 1j, 1 + 1j)) - (w + 1j * d) / 2  # middle: 0
            angles = np.sort(np.angle(corners[corners != 0]))
            gap = np.diff(angles, append=angles[:1] + 2 * np.pi).max(initial=0)
            legal[o, x, y] = z + h <= H and 0 < gap < np.pi - 1e-9  # the hull contains the middle
    if not legal.any():
        break
    o = _act(orient, sides[0], legal.any((1, 2)), legal, rest, waste)
    cell = _act(place, sides[o], legal[o].ravel(), legal[[o]], rest[[o]], waste[[o]])
    (x, y), z, (w, d, h) = divmod(cell, D), rest[o].flat[cell], sides[o]
    window = np.s_[x : x + w, y : y + d]
    empty[window], heights[window] = empty[window] + z - heights[window], z + h
    print(x, y, z, w, d, h, f"filled {(heights - empty).mean() / H:.1%}")
