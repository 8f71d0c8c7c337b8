"""Writes the two transfer functions of the comparison with VTK: python transfer_functions.py LOW HIGH FOLDER

`sparse.json` shows nothing below 0.35 of the range and two sheets above; `filled.json` shows everything, thinly.
256 points each, so that both programs interpolate between the same ones.
"""

import json
import math
import sys


def bump(s, centre, width):
    return math.exp(-(((s - centre) / width) ** 2))


def sparse(s):
    return 0.0 if s < 0.35 else 0.04 * s + 0.28 * bump(s, 0.75, 0.05) + 0.10 * bump(s, 0.5, 0.03)


def filled(s):
    return 0.006 + 0.02 * s + 0.04 * bump(s, 0.75, 0.05) + 0.02 * bump(s, 0.2, 0.04)


low, high, folder = float(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
for name, opacity in (("sparse", sparse), ("filled", filled)):
    points = [
        {"x": s, "color": [s, 0.2 + 0.6 * bump(s, 0.5, 0.2), 1 - s], "opacity": opacity(s)}
        for s in (i / 255 for i in range(256))
    ]
    with open(f"{folder}/{name}.json", "w") as file:
        json.dump({"domain": [low, high], "points": points}, file)
