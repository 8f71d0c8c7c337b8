"""Chronoxel's cells and VTK's mappers of tetrahedra side by side, in one run, on one series:

    python cells_beside_vtk.py SOURCE [--variable NAME] [--chronoxel PATH] [--rounds 3] [--folder FOLDER]

SOURCE is what `chronoxel encode` reads, such as 'sim:twist?dims=34&steps=24'. The series is encoded as cells and exported as .vtu, which VTK reads.
For each scene the programs take turns; the table shows each one's median processor time per frame over the rounds (of all threads, in ms), their ratio, and
wall times. Scenes: `filled`, unlit, 512x512, a new step each frame and a still step turning by 15 degrees a frame.
Needs the PyPI packages vtk and numpy.
"""

import argparse
import json
import math
import pathlib
import statistics
import subprocess
import sys

from beside_vtk import HERE, run_json

STEPS = 24
DISTANCE_IN_EDGES = 2.5


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("source", nargs="+")
    parser.add_argument("--variable")
    parser.add_argument("--chronoxel", default="target/release/chronoxel")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--mappers", default="projected,bunyk")
    parser.add_argument("--folder", default="target/cells_beside_vtk")
    args = parser.parse_args()
    folder = pathlib.Path(args.folder)
    folder.mkdir(parents=True, exist_ok=True)

    store = folder / "series.cxl"
    variable = ["--variable", args.variable] if args.variable else []
    encode = [args.chronoxel, "encode", *args.source, *variable, "-o", store, "--as", "cells"]
    run_json(encode + ["--overwrite", "--json"])
    info = run_json([args.chronoxel, "info", store, "--json"])
    name, variable = next(iter(info["variables"].items()))
    steps = min(STEPS, info["num_steps"])
    for old in folder.glob("step*.vtu"):
        old.unlink()
    for step in range(steps):
        export = [args.chronoxel, "export", store, "--steps", f"{step}:{step + 1}", "-o", folder / f"step{step:03}.vtu"]
        subprocess.run([str(word) for word in export + ["-q"]], check=True)
    files = sorted(folder.glob("step*.vtu"))

    low, high = bounds(files[0])
    sides = [b - a for a, b in zip(low, high)]
    unit, centre = max(sides) / 128, [(a + b) / 2 for a, b in zip(low, high)]
    distance, elevation = DISTANCE_IN_EDGES * max(sides), math.radians(20)
    position = [centre[0], centre[1] + distance * math.sin(elevation), centre[2] + distance * math.cos(elevation)]
    camera = folder / "camera.json"
    camera.write_text(json.dumps({"position": position, "look_at": centre, "up": [0, 1, 0], "fov_y_deg": 30}))
    functions = [sys.executable, HERE / "transfer_functions.py", str(variable["min"]), str(variable["max"]), folder]
    subprocess.run(functions, check=True)

    common = ["--tf", folder / "filled.json", "--opacity-unit", unit, "--lighting", "off", "--size", "512x512"]
    print(f"{info['grid'].get('num_cells', '?')} cells, 512x512, filled; median processor time per frame, ms")
    print(f"{'scene':<12}{'mapper':<12}{'k':>4}{'chronoxel':>12}{'VTK':>10}{'VTK / ours':>12}{'wall, ours':>12}{'wall, VTK':>12}")
    for turning in (False, True):
        for mapper in args.mappers.split(","):
            ours = [args.chronoxel, "play", store, "--method", "cells", "--k", 6, *common, "--camera", camera, "--json"]
            ours += ["--steps", "0:1", "--frames", STEPS, "--orbit", 360] if turning else ["--steps", f"0:{steps}", "--frames", STEPS]
            ours += ["--backend", "cpu"]
            theirs = [sys.executable, HERE / "vtk_cells.py", *files, "--array", name, "--transfer", folder / "filled.json"]
            theirs += ["--camera", camera, "--unit", unit, "--mapper", mapper, "--frames", STEPS if mapper == "projected" else 6]
            theirs += ["--turn"] if turning else []
            a, b = [], []
            for _ in range(args.rounds):
                a.append(run_json(ours))
                b.append(run_json(theirs))
            cpu = [statistics.median(r["cpu_ms"]["p50"] for r in a), statistics.median(r["cpu_ms_p50"] for r in b)]
            wall = [statistics.median(r["frame_ms"]["p50"] for r in a), statistics.median(r["wall_ms_p50"] for r in b)]
            scene = "turning" if turning else "new steps"
            print(f"{scene:<12}{mapper:<12}{6:>4}{cpu[0]:>12.1f}{cpu[1]:>10.1f}{cpu[1] / cpu[0]:>12.2f}{wall[0]:>12.1f}{wall[1]:>12.1f}", flush=True)


def bounds(path):
    import vtk

    reader = vtk.vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(path))
    reader.Update()
    box = reader.GetOutput().GetBounds()
    return box[0::2], box[1::2]


if __name__ == "__main__":
    main()
