"""Opens a store of cells with zarr-python 3 and decodes it by docs/format.md, knowing nothing of Chronoxel's code.

    pip install 'zarr>=3' vtk
    python check_cells.py STORE [STEP EXPORT.vtu]

Every group and array is opened and every chunk of it read; each finished step of each variable is decoded and held against the
ranges of its span. With EXPORT.vtu, what Chronoxel wrote of the first variable at STEP is compared bit by bit, and so is its geometry.
"""

import sys

import numpy
import zarr


def stage_values(data, stage, num_points, row):
    """What a stage gives each point at a row of its table."""
    offset, scale = numpy.frombuffer(data, "<f8", 2)
    table, at, entries = stage["table"], 16, None
    if table["kind"] == "listed":
        count = table["rows"] * table["entries"]
        entries = numpy.frombuffer(data, "<u2", count, at).reshape(table["rows"], table["entries"])
        at += 2 * count
    if stage["index_bits"] == 8:
        indices = numpy.frombuffer(data, "u1", num_points, at).astype(numpy.int64)
    else:
        high, low = numpy.frombuffer(data, "u1", 2 * num_points, at).reshape(2, num_points).astype(numpy.int64)
        indices = 256 * high + low
    assert at + num_points * stage["index_bits"] // 8 == len(data)
    numbers = indices if entries is None else entries[row >> stage["shift"]][indices]
    return offset + scale * numbers.astype(numpy.float64)


def decode(root, header, variable, step, spans):
    """Values at all points, NaN where there is none, and the span's fields."""
    entry, num_points = header["variables"][variable], header["num_points"]
    folder = entry["folder"]
    start = max(s for s in range(step + 1) if not numpy.isnan(spans[s, 0]))
    fields = dict(zip(root[f"{folder}/spans"].attrs["fields"], spans[start]))
    assert fields["start"] == start and start <= step < start + fields["len"]
    form = entry["classes"][int(fields["class"])]
    assert start % form["window"] == 0
    total = numpy.zeros(num_points)
    for number, stage in enumerate(form["stages"]):
        array = root[f"{folder}/C{int(fields['class'])}/S{number}"]
        data = array[start // form["window"], :].tobytes()
        total = total + stage_values(data, stage, num_points, step - start)
    values = total.astype(numpy.float32)
    if not numpy.isnan(fields["mask_row"]):
        mask = numpy.unpackbits(root[f"{folder}/mask"][int(fields["mask_row"]), :], bitorder="little")
        assert not mask[num_points:].any()
        values[mask[:num_points] != 0] = numpy.nan
    return values, fields


def check_export(path, points, tetrahedra, values):
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    reader = vtk.vtkXMLUnstructuredGridReader()
    reader.SetFileName(path)
    reader.Update()
    grid = reader.GetOutput()
    assert numpy.array_equal(vtk_to_numpy(grid.GetPoints().GetData()), points)
    cells = vtk_to_numpy(grid.GetCells().GetConnectivityArray()).reshape(-1, 4)
    assert numpy.array_equal(cells, tetrahedra)
    found = vtk_to_numpy(grid.GetPointData().GetScalars())
    assert numpy.array_equal(found, values, equal_nan=True), numpy.nanmax(abs(found - values))


def main():
    root = zarr.open_group(sys.argv[1], mode="r")
    header = root.attrs["chronoxel_cells"]
    points, tetrahedra = root["points"][:], root["tetrahedra"][:]
    assert points.shape == (header["num_points"], 3) and numpy.isfinite(points).all()
    assert tetrahedra.shape == (header["num_tetrahedra"], 4) and tetrahedra.max() < len(points)
    assert numpy.array_equal([points.min(0), points.max(0)], header["bounds"])
    for variable, entry in enumerate(header["variables"]):
        spans = root[f"{entry['folder']}/spans"][:]
        ranges = {}
        for step in range(header["num_steps_finished"]):
            values, fields = decode(root, header, variable, step, spans)
            ranges.setdefault(int(fields["start"]), (fields, []))[1].append(values)
        for fields, steps in ranges.values():
            count = int(numpy.isfinite(steps).sum())
            assert count == fields["count"], (count, fields)
            if count:
                assert numpy.nanmin(steps) == fields["drawn_min"] and numpy.nanmax(steps) == fields["drawn_max"]
    if len(sys.argv) > 2:
        entry = header["variables"][0]
        spans = root[f"{entry['folder']}/spans"][:]
        values, _ = decode(root, header, 0, int(sys.argv[2]), spans)
        check_export(sys.argv[3], points, tetrahedra, values)
    print(f"{sys.argv[1]}: {header['num_steps_finished']} steps of {len(header['variables'])} variables")


main()
