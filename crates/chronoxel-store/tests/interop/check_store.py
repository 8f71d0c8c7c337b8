"""Opens a store with zarr-python 3 and decodes it by docs/format.md, knowing nothing of Chronoxel's code.

    pip install 'zarr>=3'
    python check_store.py STORE [SAMPLES.json]

Every group and array is opened and every chunk of it read, and the last step of the finest level is decoded and held
against the drawn ranges. The statistics of the time tree, where there are any, are held against each other, the spans
and the decoded samples. With SAMPLES.json, decoded samples that Chronoxel
wrote (`cargo run -p chronoxel-store --example print_samples -- STORE`) are compared bit by bit.
"""

import json
import math
import sys

import numpy
import zarr


def read_stage(group, header, level, window, class_index, stage_index, row, node):
    """One stage of a payload: its indices over the full brick, and its table as a function of the row."""
    stage = group["classes"][class_index]["stages"][stage_index]
    path = f"{group['folder']}/L{level}/W{window}/C{class_index}/S{stage_index}"
    data = header["root"][path][row, node, :].tobytes()
    layout = header["bricks"]
    edge, full = layout["edge"], layout["low"] + layout["edge"] + layout["high"]
    offset, scale = numpy.frombuffer(data, "<f8", 2)
    table, at = stage["table"], 16
    rows = None
    if table["kind"] == "listed":
        count = table["rows"] * table["entries"]
        rows = numpy.frombuffer(data, "<u2", count, at).reshape(table["rows"], table["entries"])
        at += 2 * count
    core = numpy.zeros((full,) * 3, bool)
    inner = slice(layout["low"], layout["low"] + edge)
    core[inner, inner, inner] = True
    indices = numpy.zeros((full,) * 3, numpy.int64)
    for part in (core, ~core):
        n = int(part.sum())
        if stage["index_bits"] == 8:
            indices[part] = numpy.frombuffer(data, "u1", n, at)
        else:
            high, low = numpy.frombuffer(data, "u1", 2 * n, at).reshape(2, n).astype(numpy.int64)
            indices[part] = 256 * high + low
        at += n * stage["index_bits"] // 8
    assert at == len(data), f"{path}: {len(data)} bytes where {at} are due"

    def values(step_in_span):
        entries = indices if rows is None else rows[step_in_span >> stage["shift"]][indices]
        return offset + scale * entries.astype(numpy.float64)

    return values


def decode(header, variable, level, step):
    """The full bricks of all nodes of a level at a step: arrays [z, y, x], NaN where masked or empty."""
    group = header["variables"][variable]
    layout = header["bricks"]
    full = layout["low"] + layout["edge"] + layout["high"]
    bricks = {}
    for window in group["windows"]:
        folder = f"{group['folder']}/L{level}/W{window}"
        if f"{folder}/spans" not in header["root"]:
            assert header.get("sparse"), f"{folder}/spans is absent"
            continue
        spans = header["root"][f"{folder}/spans"]
        fields = {name: i for i, name in enumerate(spans.attrs["fields"])}
        first = math.ceil(max(step + 1 - window, 0) / window)
        for row in range(first, math.ceil(step / window) + 1):
            for node, span in enumerate(spans[row]):
                span = {name: span[i] for name, i in fields.items()}
                if not span["start"] <= step < span["start"] + span["len"]:
                    continue
                assert node not in bricks, "two spans hold a step"
                if span["kind"] == 0:
                    bricks[node] = numpy.full((full,) * 3, numpy.nan)
                elif span["kind"] == 1:
                    bricks[node] = numpy.full((full,) * 3, span["value"])
                else:
                    place = int(span["class"]), int(span["payload_row"]), int(span["payload_node"])
                    stages = range(len(group["classes"][place[0]]["stages"]))
                    total = None
                    for s in stages:
                        values = read_stage(group, header, level, window, place[0], s, place[1], place[2])
                        values = values(int(step - span["start"]))
                        total = values if total is None else total + values
                    low, high = span["drawn_min"], span["drawn_max"]
                    assert low <= total.min() and total.max() <= high, "decoded samples leave the drawn range"
                    bricks[node] = total
                if not math.isnan(span["mask_row"]):
                    mask = header["root"][f"{folder}/mask"][int(span["mask_row"]), int(span["mask_node"]), :]
                    bits = numpy.unpackbits(mask, bitorder="little")[: full**3].reshape((full,) * 3)
                    bricks[node] = numpy.where(bits == 1, numpy.nan, bricks[node])
    nodes = header["root"][f"nodes/L{level}"].shape[0]
    assert sorted(bricks) == list(range(nodes)), "a node has no span at the step"
    return [bricks[node] for node in range(nodes)]


def read_time_tree(header, group):
    """The statistics of a variable, one array [index, node, field] for each level of the time tree."""
    num_steps = len(header["times"]["times"])
    num_nodes = sum(level["num_nodes"] for level in header["levels"])
    levels = []
    while not levels or levels[-1].shape[0] > 1:
        array = header["root"][f"{group['folder']}/time/T{len(levels)}"]
        assert array.attrs["fields"] == ["min", "max", "mean", "std", "temporal_error", "facts"]
        assert array.shape == (math.ceil(num_steps / 2 ** len(levels)), num_nodes, 6), array.shape
        levels.append(array[...])
    assert f"{group['folder']}/time/T{len(levels)}" not in header["root"]
    return levels


def span_ranges(header, group):
    """Start, length, node and range of every span of level 0, rounded outward to single precision."""
    for window in group["windows"]:
        path = f"{group['folder']}/L0/W{window}/spans"
        if path not in header["root"]:
            continue
        spans = header["root"][path]
        fields = {name: i for i, name in enumerate(spans.attrs["fields"])}
        for row in spans[...]:
            for node, span in enumerate(row):
                if math.isnan(span[0]):
                    continue
                low, high = (span[fields[name]] for name in ("min", "max"))
                rounded = [numpy.float32(low), numpy.float32(high)]
                if rounded[0] > low:
                    rounded[0] = numpy.nextafter(rounded[0], numpy.float32(-math.inf))
                if rounded[1] < high:
                    rounded[1] = numpy.nextafter(rounded[1], numpy.float32(math.inf))
                yield int(span[0]), int(span[1]), node, rounded


def same(a, b):
    return numpy.array_equal(numpy.asarray(a, float), numpy.asarray(b, float), equal_nan=True)


def check_time_tree(header, variable):
    """Holds the statistics of a variable against each other, against its spans and against its decoded samples."""
    group = header["variables"][variable]
    levels = read_time_tree(header, group)
    for level in levels:
        low, high, mean, std, error, facts = numpy.moveaxis(level, 2, 0)
        static, uniform = facts.astype(int) & 2 > 0, facts.astype(int) & 1 > 0
        empty = numpy.isnan(mean)
        assert (empty | ((low <= mean) & (mean <= high) & (std >= 0))).all()
        assert (empty | (static == (error == 0))).all() and not (uniform & ~static).any()
    for finer, level in zip(levels, levels[1:]):
        for index, row in enumerate(level):
            halves = finer[2 * index : 2 * index + 2]
            assert same(row[:, 0], numpy.fmin.reduce(halves[..., 0])), "not the range of the halves"
            assert same(row[:, 1], numpy.fmax.reduce(halves[..., 1])), "not the range of the halves"
    # Nodes are numbered finest first, and those that share all bits but the last three have one parent.
    first = 0
    for l, entry in enumerate(header["levels"][:-1]):
        nodes, above = header["root"][f"nodes/L{l}"][:], header["root"][f"nodes/L{l + 1}"][:]
        parents = first + len(nodes) + numpy.searchsorted(above, nodes >> numpy.uint64(3))
        for level in levels:
            children = level[:, first : first + len(nodes)]
            outside = (children[..., 0] < level[:, parents, 0]) | (children[..., 1] > level[:, parents, 1])
            assert not outside.any(), "a child's range leaves its parent's"
        first += entry["num_nodes"]
    steps = levels[0]
    for start, length, node, due in span_ranges(header, group):
        rows = steps[start : start + length, node]
        assert same([numpy.fmin.reduce(rows[:, 0]), numpy.fmax.reduce(rows[:, 1])], due), (start, node, rows, due)
    # What is decoded is near the source: a twentieth of the variable's range at most.
    edge, low = header["bricks"]["edge"], header["bricks"]["low"]
    nodes = header["root"]["nodes/L0"][:]
    last = len(steps) - 1
    for node, brick in enumerate(decode(header, variable, 0, last)):
        base = [sum((int(nodes[node]) >> (3 * k + axis) & 1) << k for k in range(21)) * edge for axis in range(3)]
        inside = [slice(low, low + min(edge, n - b)) for n, b in zip(header["grid"]["dims"], base)]
        core = brick[inside[2], inside[1], inside[0]]
        assert numpy.isnan(core).all() == math.isnan(steps[last, node, 2])
        if not numpy.isnan(core).all():
            near = 0.05 * (group["max"] - group["min"])
            assert abs(numpy.nanmean(core) - steps[last, node, 2]) <= near
            assert abs(numpy.nanstd(core) - steps[last, node, 3]) <= near
    print(f"{group['name']}: statistics of {sum(level.shape[0] for level in levels)} runs of steps agree")


def read_all(root):
    """Opens everything in the group and reads every chunk."""
    num_arrays = 0
    for path, member in root.members(max_depth=None):
        if isinstance(member, zarr.Array):
            for first in range(member.shape[0] if member.ndim > 1 else 1):
                member[first] if member.ndim > 1 else member[...]
            num_arrays += 1
    return num_arrays


def main():
    root = zarr.open_group(sys.argv[1], mode="r")
    header = dict(root.attrs["chronoxel"])
    assert header["version"] == 1
    header["root"] = root
    print(f"{read_all(root)} arrays read")
    for level, entry in enumerate(header["levels"]):
        nodes = root[f"nodes/L{level}"][:]
        assert len(nodes) == entry["num_nodes"] and (numpy.diff(nodes.astype(numpy.int64)) > 0).all()
    for variable, entry in enumerate(header["variables"]):
        bricks = decode(header, variable, 0, header["num_steps_finished"] - 1)
        print(f"{entry['name']}: {len(bricks)} bricks of the last step lie within their drawn ranges")
        if "time_tree" in header and header["num_steps_finished"] == len(header["times"]["times"]):
            check_time_tree(header, variable)
    if len(sys.argv) < 3:
        return
    with open(sys.argv[2], encoding="utf-8") as file:
        samples = json.load(file)
    num_compared = 0
    for entry in samples:
        bricks = decode(header, entry["variable"], entry["level"], entry["step"])
        found = bricks[entry["node"]].ravel()
        for index, value in entry["samples"]:
            value = math.nan if value is None else value
            assert found[index] == value or (math.isnan(found[index]) and math.isnan(value)), (entry, index, found[index])
            num_compared += 1
    assert num_compared > 0
    print(f"{num_compared} samples are equal")


main()
