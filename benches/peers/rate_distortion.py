"""Rate and distortion of Chronoxel's codecs beside zfp, SZ3 and 8 bits with zstd, on the same values:

    python rate_distortion.py SERIES.npy FOLDER [--steps 24:32] [--margin 0] [--chronoxel PATH] [--only NAME…]
    python rate_distortion.py --plot FOLDER/NAME.json

SERIES.npy is [t, z, y, x]; it is scaled to [0, 1] by the range of the whole series first, and every error is on that scale. FOLDER gets
NAME.json with all points and NAME.png, the picture of them. Needs the PyPI packages numpy, matplotlib, zfpy, zstandard, h5py and hdf5plugin
(which brings SZ3); what is not installed is left out, and the JSON says so.

Bits per sample are those of every file of a store, all levels and aprons included; `bits_without_apron` leaves out
payload * apron / (core + apron): the bytes of payloads after zstd times the apron's share before it. Peers store one level without aprons.

Without --margin the steps are a series of their own. Windows of different bricks start at different steps, so that a series pays for one
more payload in most bricks than it has windows, but for one no longer than a window, which is one window; longer windows are left out. With --margin M, M
more steps before and after are encoded: the errors are those of the steps in between, and the bits are what the store of all of it takes more than one
that is shorter by as many steps. That is a long series in its
middle; windows longer than M are left out.
"""

import argparse
import json
import pathlib
import resource
import shutil
import subprocess
import sys
import tempfile

import numpy as np

WINDOWS = (2, 4, 8, 16)
MAX_ERRORS = (0.1, 0.05, 0.025, 0.012, 0.006, 0.003, 0.0015, 0.0007)
BITS = (0.25, 0.5, 1, 2, 4)
RATES = (0.5, 1, 2, 4, 8)
# zfp stays far below its tolerance.
ZFP_TOLERANCES = (2.0, 0.6, 0.2, 0.06, 0.02, 0.006, 0.002)
TOLERANCES = (0.1, 0.03, 0.01, 0.003, 0.001, 0.0003)


def our_runs(longest_window):
    """(family, label, options of encode) of everything that is encoded."""
    for bits in (8, 16):
        yield "raw", f"{bits} bits", ["--codec", "raw", "--bits", bits]
    windows = [w for w in WINDOWS if w <= longest_window]
    for codec, stages in (("palette", 1), ("palette", 2), ("palette-slice", 1), ("vq", 1), ("vq", 2)):
        for window in windows:
            options = ["--codec", codec, "--window", window]
            options += ["--stages", stages] if codec != "palette-slice" else []
            yield f"{codec}, {stages} stage{'s' * (stages > 1)}", str(window), options
    longest = ["--window", max(windows)]
    for error in MAX_ERRORS:
        yield "auto, max-error", f"{error:g}", ["--codec", "auto", "--max-error", error, "--range", "0:1", *longest]
    for bits in BITS:
        yield "auto, bits", f"{bits:g}", ["--codec", "auto", "--bits", bits, *longest]


def children_cpu_secs():
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def own_cpu_secs():
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def run_json(*command):
    """The JSON a program prints, and its processor time; or its message and None."""
    before = children_cpu_secs()
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    if done.returncode:
        return (done.stderr.strip().splitlines() or ["failed"])[-1], None
    return json.loads(done.stdout), children_cpu_secs() - before


def header_of(store):
    return json.loads((store / "zarr.json").read_text())["attributes"]["chronoxel"]


def bytes_of(store):
    """Bytes of all files, and of the apron's share of the payloads."""
    stored = sum(path.stat().st_size for path in store.rglob("*") if path.is_file())
    totals = header_of(store)["totals"]
    indices = max(1, totals["core_bytes"] + totals["apron_bytes"])
    return stored, totals["payload_bytes"] * totals["apron_bytes"] / indices


class Ours:
    """Runs the program on some steps of a series, scaled to [0, 1]."""

    def __init__(self, program, scaled, first, last, margin, folder):
        self.program, self.folder, self.margin = program, folder, margin
        self.num_steps = last - first
        self.num_samples = scaled[0].size * self.num_steps
        self.all = folder / "all.npy"
        np.save(self.all, scaled[first - margin : last + margin])
        if margin:
            self.less = folder / "less.npy"
            np.save(self.less, scaled[first - margin : first + margin])

    def encode(self, source, options):
        store = self.folder / "run.cxl"
        shutil.rmtree(store, ignore_errors=True)
        found, cpu_secs = run_json(self.program, "encode", source, "-o", store, "--json", *options)
        return store, found, cpu_secs

    def point(self, family, label, options):
        less, less_apron, less_cpu = 0, 0, 0
        if self.margin:
            store, found, less_cpu = self.encode(self.less, options)
            if less_cpu is None:
                return {"family": family, "label": label, "skipped": found}
            less, less_apron = bytes_of(store)
        store, found, cpu_secs = self.encode(self.all, options)
        if cpu_secs is None:
            return {"family": family, "label": label, "skipped": found}
        stored, apron = bytes_of(store)
        steps = f"{self.margin}:{self.margin + self.num_steps}"
        verified, _ = run_json(self.program, "verify", store, "--against", self.all, "--steps", steps, "--json")
        played, _ = run_json(self.program, "play", store, "--size", "16x16", "--lighting", "off", "--steps", steps, "--json")
        if isinstance(verified, str) or not verified["ok"]:
            sys.exit(f"{family} {label}: {verified}")
        header = header_of(store)
        variable = header["variables"][0]
        (errors,) = verified["variables"].values()
        # The store's errors are in units of the range of its own steps.
        width = variable["max"] - variable["min"]
        per_sample = 8 / self.num_samples
        point = {
            "family": family,
            "label": label,
            "options": " ".join(map(str, options)),
            "bits": (stored - less) * per_sample,
            "bits_without_apron": (stored - apron - less + less_apron) * per_sample,
            "mse": errors["mse"]["avg"] * width**2,
            "max_abs_error": errors["max_abs_error"] * width,
            "encode_cpu_secs_per_step": (cpu_secs - less_cpu) / self.num_steps,
        }
        if isinstance(played, dict):
            # A picture of 16x16 pixels: next to nothing but reading and decoding.
            point["new_step_cpu_ms"] = played["cpu_ms"]["p50"]
            point["new_step_bytes"] = played["bytes_from_disk"] / played["frames"]
        return point


def timed(work):
    before = own_cpu_secs()
    result = work()
    return result, own_cpu_secs() - before


def chunks_of(values, num_steps):
    """Single volumes for one step, [t, z, y, x] for several."""
    if num_steps == 1:
        return [np.ascontiguousarray(step) for step in values]
    return [np.ascontiguousarray(values[t : t + num_steps]) for t in range(0, len(values), num_steps)]


def peer_point(family, label, values, encode, decode):
    coded, encode_secs = timed(encode)
    decoded, decode_secs = timed(lambda: decode(coded))
    decoded = np.concatenate([np.asarray(part).reshape(-1) for part in decoded])
    error = decoded.astype(np.float64) - values.reshape(-1)
    bits = 8 * sum(map(len, coded)) / values.size
    return {
        "family": family,
        "label": label,
        "bits": bits,
        "bits_without_apron": bits,
        "mse": float(np.mean(error**2)),
        "max_abs_error": float(np.abs(error).max()),
        "encode_cpu_secs_per_step": encode_secs / len(values),
        "new_step_cpu_ms": 1e3 * decode_secs / len(values),
        "new_step_bytes": sum(map(len, coded)) / len(values),
    }


def zfp_points(values):
    import zfpy

    for name, num_steps in (("3-D", 1), ("4-D", 4)):
        chunks = chunks_of(values, num_steps)
        modes = [(f"zfp fixed rate, {name}", {"rate": r}, r) for r in RATES]
        modes += [(f"zfp fixed accuracy, {name}", {"tolerance": t}, t) for t in ZFP_TOLERANCES]
        for family, options, label in modes:
            yield peer_point(
                family,
                f"{label:g}",
                values,
                lambda: [zfpy.compress_numpy(c, write_header=True, **options) for c in chunks],
                lambda coded: [zfpy.decompress_numpy(c) for c in coded],
            )


def sz3_points(values):
    """SZ3 as the filter of an HDF5 data set, a chunk of a time; what counts is the chunk's bytes."""
    import h5py
    import hdf5plugin

    def through_hdf5(chunk, tolerance, number):
        file = h5py.File(f"{number}.h5", "w", driver="core", backing_store=False)
        file.create_dataset("a", data=chunk, chunks=chunk.shape, **hdf5plugin.SZ3(absolute=tolerance))
        file.flush()
        return file

    for name, num_steps in (("3-D", 1), ("4-D", 4)):
        chunks = chunks_of(values, num_steps)
        for tolerance in TOLERANCES:
            files, encode_secs = timed(lambda: [through_hdf5(c, tolerance, number) for number, c in enumerate(chunks)])
            coded = [file["a"].id.read_direct_chunk((0,) * chunks[0].ndim)[1] for file in files]

            decode = lambda _: [file["a"][...] for file in files]
            point = peer_point(f"SZ3, {name}", f"{tolerance:g}", values, lambda: coded, decode)
            point["encode_cpu_secs_per_step"] = encode_secs / len(values)
            for file in files:
                file.close()
            yield point


def u8_points(values):
    import zstandard

    codes = np.round(values * 255).astype(np.uint8)
    packer, unpacker = zstandard.ZstdCompressor(level=3), zstandard.ZstdDecompressor()

    def decode(coded):
        return [np.frombuffer(unpacker.decompress(c), np.uint8) / np.float32(255) for c in coded]

    yield peer_point("8 bits, zstd -3", "", values, lambda: [packer.compress(step.tobytes()) for step in codes], decode)


PEERS = {"zfp": zfp_points, "SZ3": sz3_points, "8 bits": u8_points}


def finished(point):
    if "mse" in point:
        point["psnr_db"] = float(-10 * np.log10(point["mse"])) if point["mse"] > 0 else None
    text = point.get("skipped") or f"{point['bits']:.4f} bits, {point['bits_without_apron']:.4f} without apron, {point['psnr_db'] or np.inf:.2f} dB"
    print(f"{point['family']:<28}{point['label']:<8}{text}", flush=True)
    return point


# Colour, marker, line: ours in colours, peers in black and grey.
LOOKS = {
    "vq, 1 stage": ("#d62728", "o", "-"),
    "vq, 2 stages": ("#d62728", "o", ":"),
    "palette, 1 stage": ("#1f77b4", "s", "-"),
    "palette, 2 stages": ("#1f77b4", "s", ":"),
    "palette-slice, 1 stage": ("#17becf", "^", "-"),
    "auto, max-error": ("#2ca02c", "D", "-"),
    "auto, bits": ("#9467bd", "P", "-"),
    "raw": ("#ff7f0e", "X", "none"),
    "zfp fixed rate, 4-D": ("black", "o", "-"),
    "zfp fixed rate, 3-D": ("black", "s", "--"),
    "zfp fixed accuracy, 4-D": ("#777777", "v", "-"),
    "zfp fixed accuracy, 3-D": ("#777777", "^", "--"),
    "SZ3, 4-D": ("#aaaaaa", "D", "-"),
    "SZ3, 3-D": ("#aaaaaa", "x", "--"),
    "8 bits, zstd -3": ("black", "*", "none"),
}
NAMES = {
    "vq, 1 stage": "vector palette",
    "vq, 2 stages": "vector palette, 2 stages",
    "palette, 1 stage": "product palette",
    "palette, 2 stages": "product palette, 2 stages",
    "palette-slice, 1 stage": "per slice (lum2001)",
    "auto, max-error": "auto, --max-error",
    "auto, bits": "auto, --bits",
    "raw": "raw, 8 and 16 bits",
}
PLOTTED_DB = (28, 92)


def plot(path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D
    from matplotlib.ticker import LogLocator

    report = json.loads(path.read_text())
    plt.rcParams.update({"font.size": 10, "font.family": "DejaVu Sans"})
    figure, axes = plt.subplots(figsize=(10.5, 6.4), dpi=100)
    handles = {"Chronoxel": [], "peers": []}
    for family, (color, marker, line) in LOOKS.items():
        points = [p for p in report["points"] if p["family"] == family and p.get("psnr_db")]
        points = sorted((p for p in points if PLOTTED_DB[0] <= p["psnr_db"] <= PLOTTED_DB[1]), key=lambda p: p["bits"])
        if not points:
            continue
        ours = family in NAMES
        bits, psnr = [p["bits"] for p in points], [p["psnr_db"] for p in points]
        style = {
            "color": color,
            "marker": marker,
            "linestyle": line,
            "markersize": 10 if marker == "*" else 6 if ours else 5,
            "markerfacecolor": "white" if line in (":", "--") and marker != "x" else color,
            "linewidth": 1.8 if ours else 1.1,
        }
        axes.plot(bits, psnr, zorder=3 if ours else 2, **style)
        for p in points if ours else ():
            axes.plot([p["bits_without_apron"], p["bits"]], [p["psnr_db"]] * 2, color=color, alpha=0.45, linewidth=1, zorder=1)
        if family in ("vq, 1 stage", "palette, 1 stage"):
            above = family.startswith("vq")
            for p in points:
                offset = (-4, 6) if above else (6, -12)
                axes.annotate(p["label"], (p["bits"], p["psnr_db"]), offset, textcoords="offset points", color=color, fontsize=9)
        handles["Chronoxel" if ours else "peers"].append(Line2D([], [], label=NAMES.get(family, family), **style))
    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_locator(LogLocator(base=2, numticks=24))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}" if value >= 1 else f"1/{1 / value:g}")
    axes.set_ylim(*PLOTTED_DB)
    axes.set_xlabel("stored bits per sample and time step")
    axes.set_ylabel("PSNR on [0, 1] (dB)")
    axes.set_title(report["title"], fontsize=11, loc="left")
    axes.grid(True, which="major", color="#dddddd", linewidth=0.7)
    axes.set_axisbelow(True)
    handles["Chronoxel"].append(Line2D([], [], color="#888888", alpha=0.6, linewidth=1, label="left of a mark: without apron"))
    outside = {"loc": "upper left", "frameon": False, "fontsize": 9, "alignment": "left"}
    first = axes.legend(handles=handles["Chronoxel"], title="Chronoxel (numbers: steps per window)", bbox_to_anchor=(1.01, 1.02), **outside)
    axes.add_artist(first)
    second = axes.legend(handles=handles["peers"], title="peers", bbox_to_anchor=(1.01, 0.5), **outside)
    figure.savefig(path.with_suffix(".png"), bbox_inches="tight", bbox_extra_artists=[first, second], pad_inches=0.1)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("series", nargs="?")
    parser.add_argument("folder", nargs="?")
    parser.add_argument("--steps", default=":", help="A:B, the end left out")
    parser.add_argument("--margin", type=int, default=0, help="steps encoded before and after those measured")
    parser.add_argument("--chronoxel", default="target/release/chronoxel")
    parser.add_argument("--only", nargs="+", help="families or peers whose names begin so; others are kept from NAME.json")
    parser.add_argument("--title", help="what the data are, for the picture")
    parser.add_argument("--plot", help="draw the points of this file again, and end")
    args = parser.parse_args()
    if args.plot:
        return plot(pathlib.Path(args.plot))
    if not args.folder:
        parser.error("SERIES.npy and FOLDER are needed")

    series = np.load(args.series, mmap_mode="r")
    low, high = (float(f(series)) for f in (np.min, np.max))
    first, last = slice(*(int(n) if n else None for n in args.steps.split(":"))).indices(len(series))[:2]
    if not args.margin <= first < last <= len(series) - args.margin:
        parser.error(f"--steps {args.steps} --margin {args.margin}: the series has {len(series)} steps")
    scaled = ((np.asarray(series, np.float32) - np.float32(low)) / np.float32(high - low)).astype(np.float32)
    values = np.ascontiguousarray(scaled[first:last])

    folder = pathlib.Path(args.folder)
    folder.mkdir(parents=True, exist_ok=True)
    name = f"rate_distortion_{pathlib.Path(args.series).stem}" + ("_steady" if args.margin else "")
    path = folder / f"{name}.json"

    def wanted(family):
        return not args.only or family.startswith(tuple(args.only))

    points = []
    if args.only and path.exists():
        points = [p for p in json.loads(path.read_text())["points"] if not wanted(p["family"])]
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        ours = Ours(args.chronoxel, scaled, first, last, args.margin, pathlib.Path(scratch))
        for family, label, options in our_runs(args.margin or last - first):
            if wanted(family):
                points.append(finished(ours.point(family, label, options)))
    for peer, points_of in PEERS.items():
        try:
            points += [finished(p) for p in points_of(values)] if wanted(peer) else []
        except ImportError as error:
            points.append(finished({"family": peer, "label": "", "skipped": f"not installed: {error}"}))
    shape = "×".join(map(str, series.shape[:0:-1]))
    of = "in the middle of a longer series" if args.margin else "as a series of their own"
    title = args.title or pathlib.Path(args.series).stem
    report = {
        "title": f"{title}: {shape}, steps {first} to {last - 1} {of}",
        "range": [low, high],
        "margin": args.margin,
        "points": points,
    }
    path.write_text(json.dumps(report, indent=1) + "\n")
    plot(path)
    print(path.with_suffix(".png"))


if __name__ == "__main__":
    main()
