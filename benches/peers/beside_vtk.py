"""Chronoxel and VTK's CPU ray caster side by side, in one run, on one series:

    python beside_vtk.py SERIES.npy [--chronoxel PATH] [--rounds 3] [--folder FOLDER]

For each scene the two programs take turns; the table shows each one's median processor time per frame over the rounds (of all
threads, in ms) and their ratio. Scenes: the transfer functions `sparse` and `filled`, unlit and lit, a still step
turning by 15 degrees a frame, and a new step each frame. Needs the PyPI packages vtk and numpy.
"""

import argparse
import json
import math
import pathlib
import statistics
import subprocess
import sys

import numpy as np

HERE = pathlib.Path(__file__).parent
DISTANCE_IN_EDGES = 4.0561


def run_json(command):
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}\n{done.stderr}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def camera_file(path, dims):
    centre = [(n - 1) / 2 for n in dims]
    distance, elevation = DISTANCE_IN_EDGES * max(dims), math.radians(20)
    position = [centre[0], centre[1] + distance * math.sin(elevation), centre[2] + distance * math.cos(elevation)]
    path.write_text(json.dumps({"position": position, "look_at": centre, "up": [0, 1, 0], "fov_y_deg": 30}))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("series")
    parser.add_argument("--chronoxel", default="target/release/chronoxel")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--folder", default="target/beside_vtk")
    args = parser.parse_args()
    folder = pathlib.Path(args.folder)
    folder.mkdir(parents=True, exist_ok=True)

    series = np.load(args.series, mmap_mode="r")
    low, high = float(series.min()), float(np.quantile(np.asarray(series).ravel()[::3], 0.999))
    subprocess.run([sys.executable, HERE / "transfer_functions.py", str(low), str(high), folder], check=True)
    store = folder / "series.cxl"
    run_json([args.chronoxel, "encode", args.series, "-o", store, "--bits", 8, "--overwrite", "--json"])
    camera_file(folder / "camera.json", series.shape[:0:-1])

    middle = len(series) // 2
    print(f"{series.shape[::-1]}, 512x512, half a voxel; median processor time per frame, ms")
    print(f"{'scene':<24}{'chronoxel':>12}{'VTK':>10}{'VTK / ours':>12}{'wall, ours':>12}{'wall, VTK':>12}")
    for name in ("sparse", "filled"):
        for lit in (False, True):
            for playing in (False, True):
                ours = [args.chronoxel, "play", store, "--size", "512x512", "--tf", folder / f"{name}.json", "--json"]
                ours += ["--camera", folder / "camera.json", "--lighting", "on" if lit else "off"]
                theirs = [sys.executable, HERE / "vtk_raycast.py", args.series, folder / f"{name}.json"]
                theirs += ["--shade"] if lit else []
                if playing:
                    # Less memory than the series takes decoded: every step is read and decoded anew.
                    ours += ["--frames", len(series), "--memory", "64MiB"]
                    theirs += ["--play", "--frames", len(series)]
                else:
                    ours += ["--steps", middle, "--frames", 24, "--orbit", 360]
                a, b = [], []
                for _ in range(args.rounds):
                    a.append(run_json(ours))
                    b.append(run_json(theirs))
                cpu = [statistics.median(r["cpu_ms"]["p50"] for r in a), statistics.median(r["cpu_ms_p50"] for r in b)]
                wall = [statistics.median(r["frame_ms"]["p50"] for r in a), statistics.median(r["wall_ms_p50"] for r in b)]
                scene = name + (", lit" if lit else "") + (", new steps" if playing else "")
                print(f"{scene:<24}{cpu[0]:>12.1f}{cpu[1]:>10.1f}{cpu[1] / cpu[0]:>12.2f}{wall[0]:>12.1f}{wall[1]:>12.1f}")


if __name__ == "__main__":
    main()
